"""Points as columns: torch computes several times faster on [D, N] than on [N, D]."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

CHUNK = 32768  # rows that a CPU works on at a time, so that intermediates stay in its cache


def row_chunks(points: Tensor) -> Iterator[slice]:
    """Rows to work on at a time: all of them, except on a CPU without a compiler's loop fusion."""
    rows = points.shape[0]
    if points.device.type != "cpu" or torch.compiler.is_compiling() or rows == 0:
        yield slice(0, rows)
        return
    for start in range(0, rows, CHUNK):
        yield slice(start, min(start + CHUNK, rows))


def columns(points: Tensor, dtype: torch.dtype) -> Tensor:
    """Points [N, D] as [D, N] of `dtype`, each coordinate contiguous."""
    return points.T.to(dtype).contiguous()
