"""Means over the ranks of a torch.distributed process group."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class RankMean:
    """Averages tensors over a process group, every rank weighing the same.

    ValueError for `call` where there is none, or this process is not in it.
    """

    def __init__(self, call: str, process_group: Any) -> None:
        # Imported here: many builds of torch and most trainings are without it.
        from torch import distributed

        if not (distributed.is_available() and distributed.is_initialized()):
            raise ValueError(
                f"{call}: process_group={process_group!r}, but torch.distributed is not "
                "initialised; call torch.distributed.init_process_group first, or leave "
                "process_group at None"
            )
        if distributed.get_rank(process_group) < 0:
            raise ValueError(f"{call}: this process does not belong to {process_group!r}")
        self._group = process_group
        self._reduce = distributed.all_reduce
        self._size = distributed.get_world_size(process_group)

    def __call__(self, values: Tensor) -> Tensor:
        """The means over the ranks, of the shape of `values`; every rank must call as often."""
        half = values.dtype in (torch.float16, torch.bfloat16)
        total = values.detach().to(torch.float32 if half else values.dtype, copy=True)
        self._reduce(total, group=self._group)
        return total / self._size

    def __deepcopy__(self, memo: Any) -> RankMean:
        """A process group is one, however often an optimizer is copied."""
        return self
