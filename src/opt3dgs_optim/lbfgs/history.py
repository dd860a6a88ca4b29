"""The history of every point: how curvature pairs lie in memory.

One point is one row, because density control edits optimizer state by rows; all zero means "no
history". Layout, [N, slots, 2 (D + 1)] for points of D coordinates and a history of K pairs:

    slot j, lanes 0 .. D-1        s, the parameter difference   } of the j-th newest pair, both
    slot j, lanes D+1 .. 2D       y, the gradient difference    } divided by |y|
    lanes D and 2D + 1            spare; the header below lives in them

The header holds the point's last visible position and gradient and a counter. With K > D it fits
into the spare lanes of slots 0 .. D (slots = K: 160 bytes per point in float32 for K = 5, D = 3);
otherwise it gets a slot of its own (slots = K + 1).

A new pair moves the older ones down: readers of a ring would have to gather. A history that torch
computes on has the strides of [slots, lanes, N], one of the CUDA kernel is contiguous; every
function here takes both.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from opt3dgs_optim.lbfgs.pairs import Pair, columns, normalised_pair, overwrite

MAX_HISTORY = 16


def history_shape(points: Tensor, history_size: int) -> tuple[int, int, int]:
    """Shape of the history of `points` [N, D] for `history_size` pairs of each."""
    rows, dim = points.shape
    return rows, history_size + (history_size <= dim), 2 * (dim + 1)


def new_history(points: Tensor, history_size: int, *, contiguous: bool = False) -> Tensor:
    """An empty history for `points` [N, D], of their float64 or of float32; see `laid_out`."""
    dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
    rows, *cells = history_shape(points, history_size)
    shape = (rows, *cells) if contiguous else (*cells, rows)
    zeros = torch.zeros(shape, dtype=dtype, device=points.device)
    return zeros if contiguous else zeros.movedim(-1, 0)


def laid_out(history: Tensor, *, contiguous: bool) -> Tensor:
    """`history` itself, or a copy if it is not laid out for the kernel (contiguous), or torch."""
    if contiguous:
        return history.contiguous()
    cells = history.movedim(0, -1)
    return history if cells.is_contiguous() else cells.contiguous().movedim(-1, 0)


class Header(NamedTuple):
    """Views into a history tensor: what the next pair is taken against."""

    position: Tensor  # [N, D] at the last visible step
    gradient: Tensor  # [N, D] at the last visible step
    counter: Tensor  # [N] 0: never visible; c: holds c - 1 pairs


def header(history: Tensor, history_size: int) -> Header:
    """The header's views into `history` [N, slots, 2 (D + 1)]."""
    dim = history.shape[2] // 2 - 1
    if history_size > dim:
        position, gradient = history[:, :dim, dim], history[:, :dim, 2 * dim + 1]
        return Header(position, gradient, history[:, dim, dim])
    lanes = history[:, history_size]
    return Header(lanes[:, :dim], lanes[:, dim + 1 : 2 * dim + 1], lanes[:, dim])


def check_history(call: str, grad: Tensor, history: Tensor, history_size: int) -> None:
    """ValueError unless `history` has the shape that `grad` [N, D] and `history_size` need."""
    needed = history_shape(grad, history_size)
    if history.shape != needed:
        raise ValueError(
            f"{call}: history has shape {tuple(history.shape)}, but {list(needed)} is needed for a "
            f"gradient of shape {tuple(grad.shape)} and history_size={history_size}"
        )


def stored_pairs(history: Tensor, history_size: int) -> tuple[Tensor, Tensor]:
    """s and y of the stored pairs, [K, D, N] each, newest first."""
    dim = history.shape[2] // 2 - 1
    cells = history[:, :history_size].permute(1, 2, 0)
    if cells.stride(2) != 1:
        cells = cells.contiguous()
    return cells[:, :dim], cells[:, dim + 1 : 2 * dim + 1]


def push(history: Tensor, history_size: int, pair: Pair, accept: Tensor) -> None:
    """Put a pair in front of the others, in the rows of `accept` [N] (bool), in place."""
    dim = pair.s.shape[0]
    halves = history[:, :history_size].permute(1, 2, 0).unflatten(1, (2, dim + 1))
    pairs = halves[:, :, :dim]  # [K, 2, D, N]
    first = pairs[0].unbind()
    overwrite(accept, (pairs[1:], pairs[:-1]), (first[0], pair.s), (first[1], pair.y))


def take_pairs(
    history: Tensor,
    head: Header,
    history_size: int,
    position: Tensor,
    gradient: Tensor,
    visible: Tensor,
    min_cosine: float,
) -> tuple[Tensor, Tensor]:
    """Accept a pair between two consecutive *visible* steps of each point; update the header.

    History and `head`, the views of its header, are changed in place; position and gradient are
    [D, N] before the step. Returns (accepted, candidates), [N] bool each.
    """
    last_position, last_gradient, counter = head.position.T, head.gradient.T, head.counter
    pair = normalised_pair(position - last_position, gradient - last_gradient)
    candidates = visible & (counter > 0)
    accepted = candidates & (pair.cosine > min_cosine)  # false where the pair is not finite
    push(history, history_size, pair, accepted)
    overwrite(visible, (last_position, position), (last_gradient, gradient))
    count = counter.maximum(visible.to(history.dtype)) + accepted
    counter.copy_(count.clamp(max=history_size + 1))
    return accepted, candidates


def history_from_pairs(s: Tensor, y: Tensor) -> Tensor:
    """A history for `two_loop(grad, history, K)` of K given pairs per point, oldest first.

    Args:
        s, y: [K, N, D] parameter and gradient differences, with s.y > 0.
    """
    size = s.shape[0]
    history = new_history(s[0], size)
    everywhere = torch.ones(s.shape[1], dtype=torch.bool, device=s.device)
    for k in range(size):
        pair = normalised_pair(columns(s[k], history.dtype), columns(y[k], history.dtype))
        push(history, size, pair, everywhere)
    header(history, size).counter.fill_(size + 1)
    return history
