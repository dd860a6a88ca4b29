"""Rows with a non-finite gradient stand still for one step; the others do not notice."""

from __future__ import annotations

import torch
from torch import Tensor

CAPACITY = 4096  # rows saved on a GPU, where their number is not known to the host


class FrozenRows:
    """Rows of a parameter and its moments, saved before a step and put back after it."""

    def __init__(self, rows: Tensor, bad: Tensor, kept: list[Tensor]) -> None:
        self._rows, self._bad, self._kept = rows, bad, kept
        self._saved = [tensor[rows].clone() for tensor in kept]
        self.count = bad.sum()
        self.overflow: Tensor | None = None  # 0-d float: more bad rows than could be saved

    @classmethod
    def find(cls, grad: Tensor, kept: list[Tensor]) -> FrozenRows | None:
        """Save the rows of `kept` where `grad` is not finite, and set those of `grad` to zero.

        Returns None where there is nothing to save. On a GPU the number of such rows is not
        read back: up to 4,096 are saved, and `overflow` says on the device if there were more
        (then the caller drops the whole step).
        """
        if grad.dim() == 0 or grad.numel() == 0:
            return None
        if grad.device.type == "cpu":
            # The sum is finite unless a summand is not, or it overflows: then look closely.
            if bool(torch.isfinite(grad.sum())):
                return None
            bad = (
                ~torch.isfinite(grad).flatten(1).all(dim=1) if grad.dim() > 1 else ~grad.isfinite()
            )
            rows = bad.nonzero().squeeze(1)
            if rows.numel() == 0:
                return None
            frozen = cls(rows, bad[rows], kept)
        else:
            bad = ~torch.isfinite(grad.reshape(grad.shape[0], -1).sum(dim=1))
            capacity = min(CAPACITY, grad.shape[0])
            rows = torch.nonzero_static(bad, size=capacity, fill_value=0).squeeze(1)
            frozen = cls(rows, bad[rows], kept)
            # Not the list's: its unused places name row 0, and that one may be bad.
            frozen.count = bad.sum()
            frozen.overflow = (frozen.count > capacity).to(torch.float32)
        grad[rows] = torch.where(frozen._like(grad), 0.0, grad[rows])
        return frozen

    def _like(self, tensor: Tensor) -> Tensor:
        return self._bad.reshape(-1, *[1] * (tensor.dim() - 1))

    def restore(self) -> None:
        """Put the saved rows back."""
        for tensor, saved in zip(self._kept, self._saved, strict=True):
            # Unused places of a fixed-size list name row 0: it gets what it has now.
            tensor[self._rows] = torch.where(self._like(tensor), saved, tensor[self._rows])
