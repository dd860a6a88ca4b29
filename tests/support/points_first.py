"""The halves of `lqn_direction`, points first: pairs that a test chooses, then the direction."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from opt3dgs_optim.lbfgs.history import Cells, cells_of, take_pairs
from opt3dgs_optim.lbfgs.pairs import columns, largest
from opt3dgs_optim.lbfgs.two_loop import direction as direction_of_columns


class Header(NamedTuple):
    """Views into a history: what the next pair is taken against."""

    position: Tensor  # [N, D] at the last visible step
    gradient: Tensor  # [N, D] at the last visible step
    steps: Tensor  # [N] in which the point was visible


def header(history: Tensor, history_size: int) -> Header:
    """The header where the docstring of `lbfgs.history` says that it lies, in either layout."""
    dim = history.shape[2] // 2 - 1
    if history_size > dim:
        position, gradient = history[:, :dim, dim], history[:, :dim, 2 * dim + 1]
        return Header(position, gradient, history[:, dim, dim])
    lanes = history[:, history_size]
    return Header(lanes[:, :dim], lanes[:, dim + 1 : 2 * dim + 1], lanes[:, dim])


def stored_pairs(history: Tensor, history_size: int) -> tuple[Tensor, Tensor]:
    """s and y of the stored pairs, [K, N, D] each, newest first."""
    dim = history.shape[2] // 2 - 1
    slots = history[:, :history_size].transpose(0, 1)
    return slots[..., :dim], slots[..., dim + 1 : 2 * dim + 1]


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
    accepted, candidates = torch.empty(2, len(visible), dtype=torch.bool).unbind()
    cells = cells_of(history)
    seen = columns(position, gradient)
    take_pairs(Cells(cells, history_size), seen, visible, min_cosine, accepted, candidates)
    history.copy_(cells.movedim(-1, 0))
    return accepted, candidates


def direction(grad: Tensor, history: Tensor, history_size: int, *, graft: bool) -> Tensor:
    """What Adam is fed, [N, D], from the pairs that are there."""
    (rows,) = columns(grad)
    cells = Cells(cells_of(history), history_size)
    return direction_of_columns(rows, largest(rows), cells, graft).T


def newest_gamma(history: Tensor, history_size: int) -> Tensor:
    """Gamma of the newest pair, [N]."""
    _, y = stored_pairs(history, history_size)
    return (y[0] ** 2).sum(1).reciprocal()
