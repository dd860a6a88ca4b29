"""Arithmetic of curvature pairs, coordinates first.

Everything here works on [D, N] tensors whose rows are contiguous: component by component, torch is
several times faster on them than on [N, D].
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

CHUNK = 16384  # rows that a CPU works on at a time, so that intermediates stay in its cache
DEVICE_CHUNK = 1 << 20  # rows that fill any GPU; intermediates are some 500 bytes per row
BITS = {torch.float32: torch.int32, torch.float64: torch.int64}  # by the dtypes of points
EXPONENTS = {torch.float32: 0x7F800000, torch.float64: 0x7FF0000000000000}  # of their bits


class Pair(NamedTuple):
    """A candidate curvature pair of every point."""

    vectors: Tensor  # [2, D, N]: s and y, both divided by sqrt(s.y); not finite unless s.y > 0
    cosine: Tensor  # [N] s.y / (|s| |y|); NaN where s or y is zero or not finite


def bits_of(mask: Tensor) -> Tensor:
    """All bits of a chosen point, [N] int8: what `overwrite` takes of `mask` (bool)."""
    return mask.view(torch.int8).neg()  # -1, which is all bits of wider integers, too


def overwrite(old: Tensor, new: Tensor, chosen: Tensor) -> None:
    """Put the bits [.., N] of `new` over those of `old`, in place, where `chosen` says.

    On a CPU `torch.where` branches: where the mask is as good as random, it takes five times as
    long.
    """
    old.bitwise_xor_(torch.bitwise_xor(old, new).bitwise_and_(chosen))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """a.b of every point, [.., N], of vectors [.., D, N]."""
    return torch.linalg.vecdot(a, b, dim=-2)


def largest(x: Tensor) -> Tensor:
    """Largest component of every point of [D, N], [N]; NaN where there is one."""
    return x.abs().amax(0)


def power_of_two(sizes: Tensor) -> Tensor:
    """The largest power of two in each size, in place; 0 of a subnormal number.

    Dividing by it and multiplying by it again changes no digit.
    """
    sizes.view(BITS[sizes.dtype]).bitwise_and_(EXPONENTS[sizes.dtype])
    return sizes


def length(x: Tensor) -> Tensor:
    """Euclidean norm of vectors [.., D, N] without overflow or underflow, [.., N]."""
    norms = x.abs() if x.shape[-2] == 1 else x
    while (count := norms.shape[-2]) > 1:  # by halves: D may be the size of a network
        half = count // 2
        first, last = norms[..., :half, :], norms[..., -1:, :]
        norms = torch.hypot(first, norms[..., half : 2 * half, :])
        if count % 2:
            torch.hypot(norms[..., :1, :], last, out=norms[..., :1, :])
    return norms.squeeze(-2)


def normalised(vectors: Tensor) -> Pair:
    """Divide a pair [2, D, N] by sqrt(s.y), in place, without overflow or underflow on the way."""
    lengths = length(vectors)
    units = vectors.div_(lengths.unsqueeze(1))
    cosine = dot(units[0], units[1])
    factors = (lengths / lengths.flip(0)).div_(cosine).sqrt_()
    return Pair(units.mul_(factors.unsqueeze(1)), cosine)


def row_chunks(points: Tensor) -> list[slice]:
    """Rows to work on at a time."""
    rows = points.shape[0]
    size = CHUNK if points.device.type == "cpu" else DEVICE_CHUNK
    return [slice(start, min(start + size, rows)) for start in range(0, max(rows, 1), size)]


def columns(*points: Tensor) -> Tensor:
    """M times points [N, D] as [M, D, N], each coordinate contiguous."""
    like = points[0].detach()
    found = like.new_empty(len(points), *reversed(like.shape))
    if like.is_cpu and not torch.compiler.is_compiling():  # numpy takes half of the time
        for place, given in zip(found.numpy(), points, strict=True):
            np.copyto(place, given.detach().numpy().T)
    else:  # three times as fast as a transposed copy
        torch.stack([row for given in points for row in given.unbind(1)], out=found.flatten(0, 1))
    return found


def put(points: Tensor, found: Tensor) -> None:
    """Into `points` [N, D] what was found as [D, N]: as fast as `columns`."""
    if points.is_cpu and not torch.compiler.is_compiling():
        target = points.numpy()
        for i, row in enumerate(found.numpy()):  # a fifth of the time of a transposed copy
            np.copyto(target[:, i], row)
    else:
        points.copy_(found.T)
