"""gsplat's real strategies on a CPU, and a small trainer around them in simple_trainer's order.

gsplat is an optional guest: `pip install --no-deps gsplat==1.5.3`, and `jaxtyping rich`.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from splatting.relocation import relocated_values
from torch import Tensor
from torch.nn import Parameter

HOSTS = Path(os.environ.get("OPT3DGS_HOSTS", Path(__file__).resolve().parents[2] / "hosts"))
ADVICE = "pip install --no-deps gsplat==1.5.3 && pip install jaxtyping rich ninja"
VERSIONS = ("1.5.3", "main")
ORDERS = ("step, strategy", "strategy, step")  # gsplat >= 1.5, and gsplat <= 1.4 and 2DGS


def strategies(version: str) -> Any:
    """The package gsplat.strategy of 1.5.3 (installed) or of main (beside the project)."""
    import torch.utils.cpp_extension as extension

    extension._find_cuda_home = lambda: None  # no build of the kernels (HOSTS.md 16)
    try:
        package: Any = importlib.import_module("gsplat.strategy")
    except ImportError as error:
        pytest.skip(f"gsplat is not installed ({error}): {ADVICE}")
    if version == "main":
        package = _strategies_of_main()
    ops = package.ops
    torch_impl = importlib.import_module("gsplat.cuda._torch_impl")
    ops.compute_relocation = _relocation
    ops.quat_scale_to_covar_preci = torch_impl._quat_scale_to_covar_preci
    return package


def _relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, min_opacity: float = 0.0
) -> Any:
    new_opacities, new_scales = relocated_values(opacities.flatten(), scales, ratios)
    return new_opacities.clamp(min=min_opacity).reshape(opacities.shape), new_scales


def _strategies_of_main() -> Any:
    return load_package("gsplat_main_strategy", HOSTS / "gsplat-main/gsplat/strategy")


def load_package(name: str, folder: Path) -> Any:
    """Import a folder as a package of another name; skips where it is not there."""
    if name in sys.modules:
        return sys.modules[name]
    if not (folder / "__init__.py").is_file():
        pytest.skip(f"no {folder}: clone gsplat main there, or set OPT3DGS_HOSTS")
    spec = importlib.util.spec_from_file_location(
        name, folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None
    assert spec.loader is not None
    package = importlib.util.module_from_spec(spec)
    sys.modules[name] = package
    spec.loader.exec_module(package)
    return package


def scene_of_main(splats: Any) -> Any:
    """gsplat 1.6's real GaussianScene around a ParameterDict."""
    folder = HOSTS / "gsplat-main/gsplat/scene/components"
    if "gsplat_main_scene" not in sys.modules and folder.is_dir():
        package = types.ModuleType("gsplat_main_scene")
        package.__path__ = [str(folder)]
        sys.modules["gsplat_main_scene"] = package
    if not folder.is_dir():
        pytest.skip(f"no {folder}: clone gsplat main there, or set OPT3DGS_HOSTS")
    module = importlib.import_module("gsplat_main_scene.gaussian_scene")
    return module.GaussianScene.from_splats(splats, id="scene")


class Trainer:
    """simple_trainer's loop without its renderer: a loss of all parameters, by view."""

    def __init__(
        self,
        splats: dict[str, Parameter],
        optimizers: Any,
        strategy: Any,
        *,
        total: int,
        phases: Any = None,
        order: str = ORDERS[0],
        scene: Any = None,
    ) -> None:
        self.splats, self.optimizers, self.strategy = splats, optimizers, strategy
        self.phases, self.order, self.scene = phases, order, scene
        strategy.check_sanity(splats, optimizers)
        self.is_mcmc = hasattr(strategy, "cap_max")
        self.state = strategy.initialize_state(**({} if self.is_mcmc else {"scene_scale": 1.0}))
        self.decay = torch.optim.lr_scheduler.ExponentialLR(
            optimizers["means"], gamma=0.01 ** (1 / total)
        )

    def run(self, first: int, last: int) -> None:
        """Iterations first .. last - 1; the random numbers of each follow from its number."""
        for step in range(first, last):
            torch.manual_seed(step)
            self.iterate(step)

    def iterate(self, step: int) -> None:
        """One iteration."""
        loss, info = self.loss(step)
        if not self.is_mcmc:
            self.strategy.step_pre_backward(self.splats, self.optimizers, self.state, step, info)
        loss.backward()
        if self.phases is not None:
            self.phases.observe(loss)
        if self.order == ORDERS[0]:
            self.step()
            self.edit(step, info)
        else:
            self.edit(step, info)
            self.step()

    def step(self) -> None:
        """All optimizers, then the learning rate."""
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        self.decay.step()

    def edit(self, step: int, info: dict) -> None:
        """The strategy's row edits."""
        more = {"lr": self.decay.get_last_lr()[0]} if self.is_mcmc else {"packed": False}
        if self.scene is not None:
            more["scene"] = self.scene
        self.strategy.step_post_backward(
            params=self.splats,
            optimizers=self.optimizers,
            state=self.state,
            step=step,
            info=info,
            **more,
        )

    def loss(self, step: int) -> tuple[Tensor, dict]:
        """A loss in which all matters, and what DefaultStrategy wants to know of the rendering."""
        splats, view = self.splats, step % 5
        count = len(splats["means"])
        seen = torch.arange(count) % 3 != view % 3
        means2d = (splats["means"][None, :, :2] * (1 + 0.1 * view)).clone()
        render = means2d[0].sum(-1) + splats["means"][:, 2] + torch.sigmoid(splats["opacities"])
        render = render + splats["scales"].exp().mean(-1) + splats["sh0"].mean((1, 2))
        render = render + splats["quats"].sum(-1) + splats["shN"].mean((1, 2))
        target = torch.full_like(render, 0.1 * view)[seen]
        if self.phases is None:
            pixel = (render[seen] - target).abs().mean()
        else:
            pixel = self.phases.pixel_loss(render[seen], target)
        loss = 0.1 * pixel + 0.01 * torch.sigmoid(splats["opacities"]).mean()
        radii = (seen[None, :, None] * torch.ones(1, 1, 2)) * 5
        info = {"width": 64, "height": 64, "n_cameras": 1, "gaussian_ids": None}
        return loss, {**info, "radii": radii, "means2d": means2d}
