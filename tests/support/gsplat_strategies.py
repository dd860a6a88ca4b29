"""gsplat's own MCMCStrategy and DefaultStrategy on a CPU, in a small trainer's loop.

gsplat is an optional guest: `pip install --no-deps gsplat==1.5.3`, and `jaxtyping rich ninja`.
"""

from __future__ import annotations

import importlib
from typing import Any

import pytest
import torch
from splatting.relocation import relocated_values
from torch import Tensor


def gsplat_strategies() -> Any:
    """The package `gsplat.strategy`; the test is skipped where gsplat is not installed."""
    import torch.utils.cpp_extension as extension

    extension._find_cuda_home = lambda: None  # pyright: ignore  # no build of its kernels
    package: Any = pytest.importorskip("gsplat.strategy", reason="gsplat 1.5.3 is not installed")
    impl = importlib.import_module("gsplat.cuda._torch_impl")
    package.ops.compute_relocation = _relocation
    package.ops.quat_scale_to_covar_preci = impl._quat_scale_to_covar_preci
    return package


def _relocation(opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor) -> Any:
    found, new_scales = relocated_values(opacities.flatten(), scales, ratios)
    return found.reshape(opacities.shape), new_scales


class Training:
    """simple_trainer's loop without its renderer: backward, step, rates, strategy."""

    def __init__(self, strategy: Any, params: Any, optimizers: Any, total: int) -> None:
        self.strategy, self.params, self.optimizers = strategy, params, optimizers
        strategy.check_sanity(params, optimizers)
        self.mcmc = hasattr(strategy, "cap_max")
        self.state = strategy.initialize_state(**({} if self.mcmc else {"scene_scale": 1.0}))
        self.decay = torch.optim.lr_scheduler.ExponentialLR(
            optimizers["means"], 0.01 ** (1 / total)
        )
        self.sizes: set[int] = set()

    def run(self, first: int, last: int) -> None:
        """These iterations; the random numbers of each follow from its number."""
        for step in range(first, last):
            torch.manual_seed(step)
            loss, info = self._loss(step)
            if not self.mcmc:
                self.strategy.step_pre_backward(
                    self.params, self.optimizers, self.state, step, info
                )
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            self.decay.step()
            own = {"lr": self.decay.get_last_lr()[0]} if self.mcmc else {"packed": False}
            self.strategy.step_post_backward(
                self.params, self.optimizers, self.state, step, info, **own
            )
            self.sizes.add(len(self.params["means"]))

    def _loss(self, step: int) -> tuple[Tensor, dict[str, Any]]:
        """A loss in which all matters, and what DefaultStrategy asks of a rendering."""
        p, view = self.params, step % 5
        seen = torch.arange(len(p["means"])) % 3 != view % 3
        means2d = (p["means"][None, :, :2] * (1 + 0.1 * view)).clone()
        render = means2d[0].sum(-1) + p["means"][:, 2] + torch.sigmoid(p["opacities"])
        render = render + p["scales"].exp().mean(-1) + p["quats"].sum(-1)
        render = render + p["sh0"].mean((1, 2)) + p["shN"].mean((1, 2))
        loss = 0.1 * (render[seen] - 0.1 * view).abs().mean()
        loss = loss + 0.01 * torch.sigmoid(p["opacities"]).mean()
        radii = seen[None, :, None].float().expand(1, -1, 2) * 5
        info = {"width": 64, "height": 64, "n_cameras": 1, "gaussian_ids": None}
        return loss, {**info, "radii": radii, "means2d": means2d}
