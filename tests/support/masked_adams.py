"""Adams that step some rows only, without bias correction, as gsplat's and INRIA's do."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam


class MaskedAdam(Adam):
    """What the two have in common."""

    @torch.no_grad()
    def step_rows(self, visible: Tensor) -> None:
        for group in self.param_groups:
            (param,) = group["params"]
            if param.grad is None:
                continue
            state, (beta1, beta2) = self.state[param], group["betas"]
            if not state:
                state["step"] = torch.zeros(())
                state["exp_avg"] = torch.zeros_like(param)
                state["exp_avg_sq"] = torch.zeros_like(param)
            m, v, g = state["exp_avg"][visible], state["exp_avg_sq"][visible], param.grad[visible]
            m, v = beta1 * m + (1 - beta1) * g, beta2 * v + (1 - beta2) * g * g
            state["exp_avg"][visible], state["exp_avg_sq"][visible] = m, v
            param[visible] -= group["lr"] * m / (v.sqrt() + group["eps"])


class SelectiveAdam(MaskedAdam):
    """gsplat's."""

    def step(self, visibility: Tensor) -> None:  # pyright: ignore
        self.step_rows(visibility)


class SparseGaussianAdam(MaskedAdam):
    """INRIA's."""

    def step(self, visibility: Tensor, N: int) -> None:  # pyright: ignore
        assert len(visibility) == N
        self.step_rows(visibility)


def masked(kind: type[MaskedAdam], visible: Tensor) -> tuple[Any, ...]:
    """The arguments of its step."""
    return (visible,) if kind is SelectiveAdam else (visible, len(visible))
