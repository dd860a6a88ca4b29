"""Half-size pairs: s and y of a curvature pair as bfloat16, two of them in one float32 lane.

A trainer edits optimizer state by rows and must find float32 tensors there, so the two share the
bits of a float32: coordinate i of y is the upper half of lane i of its pair, that of s the lower.
|y| = 1, hence a lane is a finite number, whatever s is; s, in units of |y|, needs the range that
bfloat16 shares with float32 and float16 lacks. Lanes are only ever moved as int32: they are bits,
and no arithmetic sees them.

Layout, [N, lanes], header first (see `_history`), in true float32:

    lanes 0 .. D-1           last visible position        lane D           counter
    lanes D+1 .. 2D          last visible gradient        lane 2D + 1      spare, zero
    from lane 2(D+1) on, D lanes per pair, newest first

For D = 3, which the CUDA kernel takes, lanes is rounded up to a multiple of four, so that a row is
read 16 bytes at a time: 24 of them, 96 bytes per point, for K = 5.
"""

from __future__ import annotations

import torch
from torch import Tensor

from opt3dgs_optim import _pairs
from opt3dgs_optim._pairs import Pair

UPPER = -65536  # 0xffff0000 as an int32


def num_lanes(history_size: int, dim: int) -> int:
    """Lanes of a row for `history_size` pairs of points with `dim` coordinates."""
    lanes = 2 * (dim + 1) + history_size * dim
    return -(-lanes // 4) * 4 if dim == 3 else lanes


def num_coordinates(lanes: int, history_size: int) -> int:
    """D of a history of so many lanes; what `num_lanes` adds for D = 3 is less than K + 2."""
    return (lanes - 2) // (history_size + 2)


def as_stored(pair: Pair) -> Pair:
    """The pair rounded to bfloat16; its cosine is 0 where rounding has left no s.y > 0 of it."""
    s, y = (v.to(torch.bfloat16).to(v.dtype) for v in (pair.s, pair.y))
    sy = _pairs.dot(s, y)
    return Pair(s, y, torch.where((sy > 0) & torch.isfinite(sy), pair.cosine, 0.0))


def unpacked(history: Tensor, history_size: int, pairs: int) -> tuple[Tensor, Tensor]:
    """s and y of the newest `pairs` pairs as float32, [pairs, D, N] each, newest first."""
    dim = num_coordinates(history.shape[1], history_size)
    bits = _pair_bits(history, history_size)[: pairs * dim]
    if bits.stride(1) != 1:
        bits = bits.contiguous()
    s, y = (bits << 16).view(torch.float32), (bits & UPPER).view(torch.float32)
    return s.unflatten(0, (pairs, dim)), y.unflatten(0, (pairs, dim))


def push(history: Tensor, history_size: int, pair: Pair, accept: Tensor) -> None:
    """Put a pair, `as_stored`, in front of the others in the rows of `accept` [N], in place."""
    slots = _pair_bits(history, history_size).unflatten(0, (history_size, -1))
    new = ((pair.s.view(torch.int32) >> 16) & ~UPPER) | (pair.y.view(torch.int32) & UPPER)
    for slot in range(history_size - 1, 0, -1):
        slots[slot].copy_(torch.where(accept, slots[slot - 1], slots[slot]))
    slots[0].copy_(torch.where(accept, new, slots[0]))


def _pair_bits(history: Tensor, history_size: int) -> Tensor:
    """The lanes of all pairs as int32, [K D, N]: a view."""
    dim = num_coordinates(history.shape[1], history_size)
    first = 2 * (dim + 1)
    return history.view(torch.int32).T[first : first + history_size * dim]
