"""The history of every point: how curvature pairs lie in memory.

One point is one row. Its history is a row of a single float tensor, because density control
edits optimizer state by rows (gathers, zeroes, appends zero rows): all zero means "no history".

Layout, [N, slots, 2 (D + 1)] for points of D coordinates and a history of K pairs:

    slot j, lanes 0 .. D-1        s, the parameter difference   } of the j-th newest pair, both
    slot j, lanes D+1 .. 2D       y, the gradient difference    } divided by |y|
    lanes D and 2D + 1            spare; the header below lives in them

The header holds the point's last visible position and gradient and a counter. With K > D it fits
into the spare lanes of slots 0 .. D (slots = K: no further memory, 160 bytes per point in float32
for K = 5, D = 3); otherwise it gets a slot of its own (slots = K + 1).

A new pair moves the older ones down a slot. A ring would write less, but every reader would have
to gather by row, which costs torch more than all the arithmetic; and the header dirties the same
memory sectors anyway. In memory, a history that torch computes on is transposed (strides of a
[slots, lanes, N] tensor), one that the CUDA kernel computes on is contiguous; every function here
takes both.

A history of half-size pairs has two dimensions instead of three: see `_packed`.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from opt3dgs_optim import _packed, _pairs
from opt3dgs_optim._pairs import Pair

MAX_HISTORY = 16

PairDtype = Literal["float32", "bfloat16"]
PAIR_DTYPES: tuple[PairDtype, ...] = ("float32", "bfloat16")


def num_slots(history_size: int, dim: int) -> int:
    """Slots of a history tensor for `history_size` pairs of points with `dim` coordinates."""
    return history_size if history_size > dim else history_size + 1


def history_shape(
    points: Tensor, history_size: int, pair_dtype: PairDtype = "float32"
) -> tuple[int, ...]:
    """Shape of the history of `points` [N, D]."""
    rows, dim = points.shape
    if pair_dtype == "bfloat16":
        return rows, _packed.num_lanes(history_size, dim)
    return rows, num_slots(history_size, dim), 2 * (dim + 1)


def new_history(
    points: Tensor,
    history_size: int,
    *,
    contiguous: bool = False,
    pair_dtype: PairDtype = "float32",
) -> Tensor:
    """An empty history for `points` [N, D]; float32, or float64 for float64 points.

    `contiguous` is for the CUDA kernel; otherwise the memory is laid out for torch.

    Raises:
        ValueError: half-size pairs for float64 points.
    """
    dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
    if pair_dtype == "bfloat16" and dtype == torch.float64:
        raise ValueError(
            "LQNAdam: pair_dtype='bfloat16' for a parameter of torch.float64, but one of "
            "torch.float32 or fewer bits is needed"
        )
    shape = history_shape(points, history_size, pair_dtype)
    if contiguous:
        return torch.zeros(shape, dtype=dtype, device=points.device)
    cells = torch.zeros((*shape[1:], shape[0]), dtype=dtype, device=points.device)
    return cells.movedim(-1, 0)


def laid_out(history: Tensor, *, contiguous: bool) -> Tensor:
    """`history` itself, or a copy of it if its memory is laid out for the other backend."""
    if contiguous:
        return history.contiguous()
    cells = history.movedim(0, -1)
    return history if cells.is_contiguous() else cells.contiguous().movedim(-1, 0)


class Header(NamedTuple):
    """Views into a history tensor: what the next pair is taken against."""

    position: Tensor  # [N, D] at the last visible step
    gradient: Tensor  # [N, D] at the last visible step
    counter: Tensor  # [N] 0: never visible; c: holds c - 1 pairs


def is_packed(history: Tensor) -> bool:
    """Whether these are half-size pairs."""
    return history.dim() == 2


def header(history: Tensor, history_size: int) -> Header:
    """The header's views into `history` [N, slots, 2 (D + 1)], or [N, lanes]."""
    if is_packed(history):
        return _whole_header(history, _packed.num_coordinates(history.shape[1], history_size))
    dim = history.shape[2] // 2 - 1
    if history_size > dim:
        position, gradient = history[:, :dim, dim], history[:, :dim, 2 * dim + 1]
        return Header(position, gradient, history[:, dim, dim])
    return _whole_header(history[:, history_size], dim)


def _whole_header(lanes: Tensor, dim: int) -> Header:
    return Header(lanes[:, :dim], lanes[:, dim + 1 : 2 * dim + 1], lanes[:, dim])


def check_history(call: str, grad: Tensor, history: Tensor, history_size: int) -> None:
    """ValueError unless `history` has the shape that `grad` [N, D] and `history_size` need."""
    packed = is_packed(history)
    needed = history_shape(grad, history_size, "bfloat16" if packed else "float32")
    if tuple(history.shape) != needed:
        raise ValueError(
            f"{call}: history has shape {tuple(history.shape)}, but {list(needed)} is needed for a "
            f"gradient of shape {tuple(grad.shape)} and history_size={history_size}"
        )
    if packed and history.dtype != torch.float32:
        raise ValueError(
            f"{call}: a history of half-size pairs is {history.dtype}, but torch.float32 is needed"
        )


def stored_pairs(history: Tensor, history_size: int) -> tuple[Tensor, Tensor]:
    """s and y of the stored pairs, [K, D, N] each, newest first."""
    if is_packed(history):
        return _packed.unpacked(history, history_size, history_size)
    dim = history.shape[2] // 2 - 1
    cells = history[:, :history_size].permute(1, 2, 0)
    if cells.stride(2) != 1:
        cells = cells.contiguous()
    return cells[:, :dim], cells[:, dim + 1 : 2 * dim + 1]


def newest_gamma(history: Tensor, history_size: int) -> Tensor:
    """Gamma of the newest pair, [N]; 0 where there is none."""
    if is_packed(history):
        s, y = _packed.unpacked(history, history_size, 1)
    else:
        s, y = stored_pairs(history[:, :1], 1)
    return _pairs.dot(s[0], y[0])


def as_stored(history: Tensor, pair: Pair) -> Pair:
    """The pair with the rounding that storing it will cost."""
    return _packed.as_stored(pair) if is_packed(history) else pair


def push(history: Tensor, history_size: int, pair: Pair, accept: Tensor) -> None:
    """Put a pair in front of the others, in the rows of `accept` [N] (bool), in place."""
    if is_packed(history):
        _packed.push(history, history_size, pair, accept)
        return
    dim = pair.s.shape[0]
    cells = history.permute(1, 2, 0)
    for first, new in ((0, pair.s), (dim + 1, pair.y)):
        lanes = cells[:, first : first + dim]
        for slot in range(history_size - 1, 0, -1):
            lanes[slot].copy_(torch.where(accept, lanes[slot - 1], lanes[slot]))
        lanes[0].copy_(torch.where(accept, new, lanes[0]))
