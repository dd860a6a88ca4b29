"""gsplat's real strategies on a CPU, and simple_trainer's loop around them without its renderer.

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
from gaussians import adams_of, parameters
from torch import Tensor
from torch.nn import ParameterDict

from opt3dgs_optim import PhaseScheduler

ADVICE = "gsplat is not installed: pip install --no-deps gsplat==1.5.3, and jaxtyping rich ninja"
VERSIONS = ("1.5.3", pytest.param("main", marks=pytest.mark.hosts))
ORDERS = ("step, strategy", "strategy, step")  # gsplat >= 1.5, and gsplat <= 1.4 and 2DGS
POINTS, TOTAL = 40, 90


def splats(seed: int = 0) -> ParameterDict:
    """Raw Gaussians, of which a sixth are dead: to be relocated or pruned."""
    made = ParameterDict(parameters(POINTS, seed=seed))
    made["opacities"].data[::6] = -9.0
    return made


def strategy(version: str, kind: str) -> Any:
    """A strategy of 1.5.3 (installed) or of main (among OPT3DGS_TRAINERS); skips without it.

    It edits after every eighth iteration until 88: when the mean is in the parameters' place.
    """
    import torch.utils.cpp_extension as extension

    extension._find_cuda_home = lambda: None  # pyright: ignore  # no build of the kernels
    package: Any = pytest.importorskip("gsplat.strategy", reason=ADVICE)
    impl: Any = importlib.import_module("gsplat.cuda._torch_impl")
    if version == "main":
        package = _strategies_of_main()
    package.ops.compute_relocation = cpu_gsplat.relocation
    package.ops.quat_scale_to_covar_preci = impl._quat_scale_to_covar_preci
    often = {"refine_start_iter": 5, "refine_stop_iter": TOTAL - 1, "refine_every": 8}
    if kind == "mcmc":
        return package.MCMCStrategy(cap_max=70, noise_lr=1.0, **often)
    sizes = {"grow_grad2d": 1e-3, "grow_scale3d": 0.6, "prune_opa": 0.3, "prune_scale3d": 1e9}
    return package.DefaultStrategy(reset_every=40, **often, **sizes)


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
    """The loop, with a loss of all parameters."""

    def __init__(self, version: str, kind: str, order: str = ORDERS[0], *, seed: int = 0) -> None:
        self.splats, self.order, self.is_mcmc = splats(seed), order, kind == "mcmc"
        self.optimizers: Any = adams_of(dict(self.splats))
        self.strategy = strategy(version, kind)
        self.strategy.check_sanity(self.splats, self.optimizers)
        scale = {} if self.is_mcmc else {"scene_scale": 1.0}
        self.strategy_state = self.strategy.initialize_state(**scale)
        self.sizes: set[int] = set()

    def upgrade(self, parts: Any = None, total: int = TOTAL) -> PhaseScheduler:
        """The lines of gsplat's page."""
        phases = PhaseScheduler(total, parts=parts)
        phases.upgrade(self.optimizers)
        return phases

    def run(self, first: int, last: int) -> None:
        """Iterations first .. last - 1; the random numbers of each follow from its number."""
        means = self.optimizers["means"]
        decay = torch.optim.lr_scheduler.ExponentialLR(means, gamma=0.01 ** (1 / TOTAL))
        for step in range(first, last):
            torch.manual_seed(step)
            loss, info = self.loss(step)
            edited = (self.splats, self.optimizers, self.strategy_state, step, info)
            if not self.is_mcmc:
                self.strategy.step_pre_backward(*edited)
            loss.backward()
            if self.order == ORDERS[1]:
                self._edit(edited)
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            decay.step()
            if self.order == ORDERS[0]:
                self._edit(edited)
            self.sizes.add(len(self.splats["means"]))

    def _edit(self, edited: tuple) -> None:
        rate = self.optimizers["means"].param_groups[0]["lr"]
        own = {"lr": rate} if self.is_mcmc else {"packed": False}
        self.strategy.step_post_backward(*edited, **own)

    def loss(self, step: int) -> tuple[Tensor, dict]:
        """A loss in which all matters, and what DefaultStrategy asks of a rendering."""
        s, view = self.splats, step % 5
        seen = torch.arange(len(s["means"])) % 3 != view % 3
        means2d = (s["means"][None, :, :2] * (1 + 0.1 * view)).clone()
        render = means2d[0].sum(-1) + s["means"][:, 2] + torch.sigmoid(s["opacities"])
        render = render + s["scales"].exp().mean(-1) + s["quats"].sum(-1)
        render = render + s["sh0"].mean((1, 2)) + s["shN"].mean((1, 2))
        loss = 0.1 * (render[seen] - 0.1 * view).abs().mean()
        loss = loss + 0.01 * torch.sigmoid(s["opacities"]).mean()
        radii = seen[None, :, None].float().expand(1, -1, 2) * 5
        info = {"width": 64, "height": 64, "n_cameras": 1, "gaussian_ids": None}
        return loss, {**info, "radii": radii, "means2d": means2d}
