"""gsplat's real strategies on a CPU, and a small trainer around them in simple_trainer's order.

gsplat is an optional guest: `pip install --no-deps gsplat==1.5.3`, and `jaxtyping rich ninja`.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import Any

import cpu_gsplat
import pytest
import torch
from torch import Tensor
from torch.nn import Parameter, ParameterDict

from opt3dgs_optim import PhaseScheduler

ADVICE = "pip install --no-deps gsplat==1.5.3 && pip install jaxtyping rich ninja"
VERSIONS = ("1.5.3", pytest.param("main", marks=pytest.mark.hosts))
ORDERS = ("step, strategy", "strategy, step")  # gsplat >= 1.5, and gsplat <= 1.4 and 2DGS
POINTS = 40
RATES = {"means": 1e-2, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 3e-3, "shN": 1e-4}
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3),
          "shN": (15, 3)}  # fmt: skip


def splats(seed: int = 0) -> ParameterDict:
    """Raw Gaussians, of which a sixth are dead: to be relocated or pruned."""
    torch.manual_seed(seed)
    made = ParameterDict({k: Parameter(torch.randn(POINTS, *s) * 0.3) for k, s in SHAPES.items()})
    made["opacities"].data[::6] = -9.0
    return made


def adams(of: ParameterDict) -> dict[str, torch.optim.Adam]:
    """gsplat's optimizers."""
    return {
        name: torch.optim.Adam([{"params": of[name], "lr": lr, "name": name}], eps=1e-15)
        for name, lr in RATES.items()
    }


def strategy(version: str, kind: str) -> Any:
    """A strategy of 1.5.3 (installed) or of main (among OPT3DGS_TRAINERS); skips without it."""
    import torch.utils.cpp_extension as extension

    extension._find_cuda_home = lambda: None  # no build of the kernels
    try:
        package: Any = importlib.import_module("gsplat.strategy")
        impl: Any = importlib.import_module("gsplat.cuda._torch_impl")
    except ImportError as error:
        pytest.skip(f"gsplat is not installed ({error}): {ADVICE}")
    if version == "main":
        package = _strategies_of_main()
    package.ops.compute_relocation = cpu_gsplat.relocation
    package.ops.quat_scale_to_covar_preci = impl._quat_scale_to_covar_preci
    often = {"refine_start_iter": 5, "refine_every": 7, "refine_stop_iter": 50, "verbose": False}
    if kind == "mcmc":
        return package.MCMCStrategy(cap_max=70, noise_lr=1.0, **often)
    sizes = {"grow_scale3d": 0.6, "prune_scale3d": 1e9}
    return package.DefaultStrategy(
        grow_grad2d=0.1, prune_opa=0.3, reset_every=1000, **sizes, **often
    )


def _strategies_of_main() -> Any:
    folder = Path(os.environ.get("OPT3DGS_TRAINERS", "/no/trainers"), "gsplat-main/gsplat/strategy")
    if not (folder / "__init__.py").is_file():
        pytest.skip(f"no {folder}: put gsplat's main branch there, set OPT3DGS_TRAINERS")
    name = "gsplat_main_strategy"
    if name not in sys.modules:
        places = [str(folder)]
        spec = importlib.util.spec_from_file_location(
            name, folder / "__init__.py", submodule_search_locations=places
        )
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


class Trainer:
    """simple_trainer's loop without its renderer: a loss of all parameters, by view."""

    def __init__(
        self, version: str, kind: str, order: str = ORDERS[0], *, total: int, seed: int = 0
    ) -> None:
        self.splats, self.order, self.is_mcmc = splats(seed), order, kind == "mcmc"
        self.optimizers: Any = adams(self.splats)
        self.strategy = strategy(version, kind)
        self.phases: PhaseScheduler | None = None
        self.strategy.check_sanity(self.splats, self.optimizers)
        scale = {} if self.is_mcmc else {"scene_scale": 1.0}
        self.strategy_state = self.strategy.initialize_state(**scale)
        self.gamma = 0.01 ** (1 / total)

    def upgrade(self, total: int, parts: Any = None) -> PhaseScheduler:
        """The lines of gsplat's page."""
        self.phases = PhaseScheduler(total, parts=parts)
        self.phases.upgrade(self.optimizers)
        return self.phases

    def run(self, first: int, last: int) -> None:
        """Iterations first .. last - 1; the random numbers of each follow from its number."""
        means = self.optimizers["means"]
        decay = torch.optim.lr_scheduler.ExponentialLR(means, gamma=self.gamma)
        for step in range(first, last):
            torch.manual_seed(step)
            loss, info = self.loss(step)
            if not self.is_mcmc:
                self.strategy.step_pre_backward(
                    self.splats, self.optimizers, self.strategy_state, step, info
                )
            loss.backward()
            if self.order == ORDERS[1]:
                self.edit(step, info)
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            decay.step()
            if self.order == ORDERS[0]:
                self.edit(step, info)

    def edit(self, step: int, info: dict) -> None:
        """The strategy's row edits."""
        rate = self.optimizers["means"].param_groups[0]["lr"]
        more = {"lr": rate} if self.is_mcmc else {"packed": False}
        self.strategy.step_post_backward(
            params=self.splats, optimizers=self.optimizers, state=self.strategy_state,
            step=step, info=info, **more,
        )  # fmt: skip

    def loss(self, step: int) -> tuple[Tensor, dict]:
        """A loss in which all matters, and what DefaultStrategy wants to know of the rendering."""
        s, view = self.splats, step % 5
        count = len(s["means"])
        seen = torch.arange(count) % 3 != view % 3
        means2d = (s["means"][None, :, :2] * (1 + 0.1 * view)).clone()
        render = means2d[0].sum(-1) + s["means"][:, 2] + torch.sigmoid(s["opacities"])
        render = render + s["scales"].exp().mean(-1) + s["sh0"].mean((1, 2))
        render = render + s["quats"].sum(-1) + s["shN"].mean((1, 2))
        loss = 0.1 * (render[seen] - 0.1 * view).abs().mean()
        loss = loss + 0.01 * torch.sigmoid(s["opacities"]).mean()
        radii = (seen[None, :, None] * torch.ones(1, 1, 2)) * 5
        info = {"width": 64, "height": 64, "n_cameras": 1, "gaussian_ids": None}
        return loss, {**info, "radii": radii, "means2d": means2d}
