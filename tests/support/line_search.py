"""The two-loop recursion with a line search, on many rows at once: what it can do without Adam."""

from __future__ import annotations

from collections.abc import Callable

import torch
from problems import gradient
from torch import Tensor

from opt3dgs_optim.lbfgs import lqn_direction, new_history

Function = Callable[[Tensor], Tensor]  # [N, D] -> [N]


def minimise(
    value: Function,
    x: Tensor,
    iterations: int,
) -> Tensor:
    """Where L-BFGS on every row of `x` [N, D] ends.

    That is early where no row can go down any further. The first step is a tenth of the start's
    own length: rows may be in any units, and the method has to go the same way in all of them.
    """
    history = new_history(x, 5)
    options = {"min_cosine": 1e-14, "graft": False}
    length = x.norm(dim=1, keepdim=True) * 0.1
    for _ in range(iterations):
        g = gradient(value, x)
        found = lqn_direction(x, g, history, 5, **options)[0]  # pyright: ignore
        unit = g / g.abs().amax(1, keepdim=True).clamp(min=1e-300)
        steepest = -unit / unit.norm(dim=1, keepdim=True).clamp(min=1e-300) * length
        own = (found == g).all(1)  # no pair, or no descent: the length of g says nothing
        down = torch.where(own[:, None], steepest, -found)
        lengths = weak_wolfe(value, x, g, down)
        x = x + lengths[:, None] * down
        if not bool(lengths.any()):
            break
    return x


def weak_wolfe(value: Function, x: Tensor, g: Tensor, down: Tensor) -> Tensor:
    """Steps [N] of sufficient decrease and rising slope, by bisection (Lewis and Overton 2013)."""
    start, slope = value(x), (g * down).sum(1)
    step = torch.ones_like(start)
    low, high = torch.zeros_like(step), torch.full_like(step, torch.inf)
    for _ in range(50):
        at = x + step[:, None] * down
        long = ~(value(at) <= start + 1e-4 * step * slope)
        short = ~long & ~((gradient(value, at) * down).sum(1) >= 0.9 * slope)
        if not bool((long | short).any()):
            break
        high = torch.where(long, step, high)
        low = torch.where(short, step, low)
        middle = torch.where(torch.isinf(high), 2 * low, (low + high) / 2)
        step = torch.where(long | short, middle, step)
    # Not found within rounding: where the function does not fall any more, stay.
    return torch.where(value(x + step[:, None] * down) <= start, step, torch.zeros_like(step))
