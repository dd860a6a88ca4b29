"""How density control edits the rows of Parameters and of what their optimizers keep for them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

MOMENTS = ("exp_avg", "exp_avg_sq")


class Edit:
    """What an edit does to a parameter [N, ...], and to what is kept for its rows [N, ...]."""

    def __init__(self, param: Callable[[Tensor], Tensor], kept: Callable[[Tensor], Tensor]) -> None:
        self.param, self.kept = param, kept


def added(rows: Tensor) -> Edit:
    """Copies of these rows at the end, as growth and clone make them."""

    def kept(tensor: Tensor) -> Tensor:
        return torch.cat([tensor, torch.zeros_like(tensor[rows])])

    return Edit(lambda param: torch.cat([param, param[rows] + 0.1]), kept)


def removed(rows: Tensor) -> Edit:
    """These rows are gone, as pruning leaves it."""

    def left(tensor: Tensor) -> Tensor:
        there = torch.ones(len(tensor), dtype=torch.bool)
        there[rows] = False
        return tensor[there]

    return Edit(left, left)


def relocated(dead: Tensor, alive: Tensor) -> Edit:
    """Dead rows become copies of others, whose state is zeroed in place, as 3DGS-MCMC does it."""

    def moved(param: Tensor) -> Tensor:
        param[dead] = param[alive]
        return param[:]

    def zeroed(tensor: Tensor) -> Tensor:
        tensor[alive] = 0
        return tensor

    return Edit(moved, zeroed)


def forgotten() -> Edit:
    """Nothing is kept any more, as where opacities are reset."""
    return Edit(lambda param: param.clamp(max=0.1), torch.zeros_like)


@torch.no_grad()
def apply(
    edit: Edit, params: dict[str, Any], optimizers: Iterable[Any], names: Iterable[str], inria: bool
) -> None:
    """Edit Parameters and state in gsplat's way (every tensor), or INRIA's (Adam's moments)."""
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            old = group["params"][0]
            name = next(n for n, p in params.items() if p is old)
            if name not in names:
                continue
            state: Any = optimizer.state.pop(old, None)
            new = Parameter(edit.param(old.detach()))
            for key in set(state or ()) - {"step"}:
                if not inria or key in MOMENTS:
                    state[key] = edit.kept(state[key])
            group["params"] = [new]
            if state is not None:
                optimizer.state[new] = state
            params[name] = new
