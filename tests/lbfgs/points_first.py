"""The halves of `lqn_direction`, points first: pairs that a test chooses, then the direction."""

from __future__ import annotations

from torch import Tensor

from opt3dgs_optim.lbfgs.history import header, stored_pairs, take_pairs
from opt3dgs_optim.lbfgs.pairs import columns, dot, largest
from opt3dgs_optim.lbfgs.two_loop import direction as direction_of_columns


def record(
    history: Tensor,
    history_size: int,
    position: Tensor,  # [N, D], as is the gradient
    gradient: Tensor,
    visible: Tensor,
    *,
    min_cosine: float,
) -> tuple[Tensor, Tensor]:
    """(accepted, candidates); `visible` [N] is the caller's, whatever the gradients are."""
    x, g = (columns(each, history.dtype) for each in (position, gradient))
    head = header(history, history_size)
    return take_pairs(history, head, history_size, x, g, visible, min_cosine)


def direction(grad: Tensor, history: Tensor, history_size: int, *, graft: bool) -> Tensor:
    """What Adam is fed, [N, D], from the pairs that are there."""
    head, rows = header(history, history_size), columns(grad, history.dtype)
    return direction_of_columns(rows, largest(rows), history, head, history_size, graft).T


def newest_gamma(history: Tensor, history_size: int) -> Tensor:
    """Gamma of the newest pair, [N]; 0 where there is none."""
    s, y = stored_pairs(history, history_size)
    return dot(s[0], y[0])
