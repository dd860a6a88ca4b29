"""Arithmetic of curvature pairs, coordinates first.

Everything here works on [D, N] tensors whose rows are contiguous: component by component, torch is
several times faster on them than on [N, D].
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

CHUNK = 32768  # rows that a CPU works on at a time, so that intermediates stay in its cache
DEVICE_CHUNK = 1 << 20  # rows that fill any GPU; intermediates are some 500 bytes per row
BITS = {torch.float32: torch.int32, torch.float64: torch.int64}


class Pair(NamedTuple):
    """A candidate curvature pair, both vectors divided by |y|."""

    s: Tensor  # [D, N]
    y: Tensor  # [D, N], unit length (zero where the gradients were equal)
    cosine: Tensor  # [N] s.y / (|s| |y|); 0 where s or y is zero, NaN where they are not finite


def dot(a: Iterable[Tensor], b: Iterable[Tensor]) -> Tensor:
    """a.b of every point, [N], of [D, N] or of its rows."""
    (x, y), *others = zip(a, b, strict=True)
    total = x * y
    for x, y in others:  # half the time of a sum of products
        total.addcmul_(x, y)
    return total


def overwrite(mask: Tensor, *pairs: tuple[Tensor, Tensor]) -> None:
    """In each pair (old, new) of [..., N], put the new over the old where `mask` [N] (bool) says.

    Bit for bit. On a CPU `torch.where` branches: where the mask is as good as random, it takes
    five times as long.
    """
    kind = BITS[pairs[0][0].dtype]
    chosen = mask.to(kind).neg_()  # all bits of a chosen point's numbers
    for old, new in pairs:
        bits = old.view(kind)
        bits.bitwise_xor_(torch.bitwise_xor(bits, new.view(kind)).bitwise_and_(chosen))


def largest(x: Tensor) -> Tensor:
    """Largest component of every point of [D, N], [N]; NaN where there is one."""
    return x.abs().amax(0)


def length(x: Tensor) -> Tensor:
    """Euclidean norm of every point without overflow or underflow, [N]; 1 for a zero vector."""
    size = largest(x)
    scaled = x / torch.threshold(size, 0.0, 1.0)
    return torch.threshold_(dot(scaled, scaled).sqrt_().mul_(size), 0.0, 1.0)


def normalised_pair(s: Tensor, y: Tensor) -> Pair:
    """Divide a pair by |y|, without overflow or underflow on the way."""
    size = length(y)
    s, y = s / size, y / size
    return Pair(s, y, dot(s / length(s), y))


def row_chunks(points: Tensor, on_cpu: int | None = None) -> list[slice]:
    """Rows to work on at a time; `on_cpu` is how many of a CPU's, in the place of `CHUNK`."""
    rows = points.shape[0]
    size = (on_cpu or CHUNK) if points.device.type == "cpu" else DEVICE_CHUNK
    return [slice(start, min(start + size, rows)) for start in range(0, max(rows, 1), size)]


def columns(points: Tensor, dtype: torch.dtype, out: Tensor | None = None) -> Tensor:
    """Points [N, D] as [D, N] of `dtype`, each coordinate contiguous; `out` is where, if given."""
    found = out
    if found is None:
        found = torch.empty(points.shape[1], len(points), dtype=dtype, device=points.device)
    if points.is_cpu and points.dtype in BITS and dtype in BITS:  # numpy takes half of the time
        np.copyto(found.numpy(), points.detach().numpy().T)
    else:  # three times as fast as a transposed copy
        torch.stack(points.detach().to(dtype).unbind(1), out=found)
    return found


def in_range_of(dtype: torch.dtype, numbers: Tensor) -> Tensor:
    """Numbers of another dtype, to be cast: those that this one cannot hold become its largest."""
    if numbers.dtype == dtype:
        return numbers
    most = torch.finfo(dtype).max
    return numbers.clamp(-most, most)


def put(points: Tensor, found: Iterable[Tensor]) -> None:
    """Into `points` [N, D] what was found as [D, N] or its rows: as fast as `columns`."""
    for column, row in zip(points.unbind(1), found, strict=True):
        if points.is_cpu and points.dtype in BITS and row.dtype in BITS:
            np.copyto(column.numpy(), row.numpy())
        else:
            column.copy_(row)
