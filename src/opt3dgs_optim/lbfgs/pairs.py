"""Arithmetic of curvature pairs, coordinates first.

Everything here works on [D, N] tensors whose rows are contiguous: component by component, torch is
several times faster on them than on [N, D].
"""

from typing import NamedTuple

import torch
from torch import Tensor

CHUNK = 32768  # rows that a CPU works on at a time, so that intermediates stay in its cache
DEVICE_CHUNK = 1 << 20  # rows that fill any GPU; intermediates are some 400 bytes per row


class Pair(NamedTuple):
    """A candidate curvature pair, both vectors divided by |y|."""

    s: Tensor  # [D, N]
    y: Tensor  # [D, N], unit length (zero where the gradients were equal)
    cosine: Tensor  # [N] s.y / (|s| |y|); 0 where s or y is zero, NaN where they are not finite


def dot(a: Tensor, b: Tensor, product: Tensor | None = None) -> Tensor:
    """a.b of every point, [N] of [D, N]; `product` is memory for what is summed."""
    return torch.mul(a, b, out=product).sum(0)


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


def row_chunks(points: Tensor) -> list[slice]:
    """Rows to work on at a time."""
    rows = points.shape[0]
    size = CHUNK if points.device.type == "cpu" else DEVICE_CHUNK
    return [slice(start, min(start + size, rows)) for start in range(0, max(rows, 1), size)]


def columns(points: Tensor, dtype: torch.dtype) -> Tensor:
    """Points [N, D] as [D, N] of `dtype`, each coordinate contiguous."""
    return torch.stack(points.to(dtype).unbind(1))  # three times as fast as a transposed copy
