"""Running means on the device, updated in place and without a host synchronisation.

In place, so that a CUDA graph which has captured an update goes on from the last one.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import torch
from torch import Tensor


class RunningMoments:
    """Mean, variance and minimum of a stream of scalars; decay 1 weighs all of them alike.

    `squares` is the sum of squared deviations from the mean.
    """

    def __init__(self, decay: float, dtype: torch.dtype, device: torch.device) -> None:
        self.decay = decay
        start = torch.tensor([0.0, 0.0, 0.0, torch.inf], dtype=dtype, device=device)
        self.weight, self.mean, self.squares, self.low = start.unbind()

    def update(self, value: Tensor, valid: Tensor) -> None:
        """Take `value` (0-d) if `valid` (0-d bool)."""
        weight = self.decay * self.weight + 1
        # West's update: numerically safe for a large mean with a small variance.
        change = value - self.mean
        mean = self.mean + change / weight
        square = self.decay * self.squares + change * (value - mean)
        self.weight.copy_(torch.where(valid, weight, self.weight))
        self.mean.copy_(torch.where(valid, mean, self.mean))
        self.squares.copy_(torch.where(valid, square, self.squares))
        self.low.copy_(torch.where(valid, torch.minimum(self.low, value), self.low))

    @property
    def variance(self) -> Tensor:
        """Population variance, 0-d; 0 before the first value."""
        return (self.squares / self.weight.clamp(min=1)).clamp(min=0)

    def state(self) -> list[float]:
        """Plain floats (synchronises)."""
        return torch.stack([self.weight, self.mean, self.squares, self.low]).tolist()

    def load(self, state: list[float]) -> None:
        """Restore `state()`."""
        loaded = torch.tensor(state, dtype=self.mean.dtype, device=self.mean.device)
        self.weight, self.mean, self.squares, self.low = loaded.unbind()


class ViewMeans:
    """Exponential running mean of the energy of every view."""

    def __init__(self, decay: float, dtype: torch.dtype, device: torch.device) -> None:
        self.decay = decay
        self._rows: dict[Hashable, int] = {}
        self._means = torch.zeros(0, dtype=dtype, device=device)
        self._weights = torch.zeros(0, dtype=dtype, device=device)

    def update(self, view: Hashable, value: Tensor, valid: Tensor) -> Tensor:
        """Take a view's energy if `valid` and return that view's mean, this energy included."""
        row = self._rows.setdefault(view, len(self._rows))
        if row >= self._means.shape[0]:
            room = self._means.new_zeros(max(64, self._means.shape[0]))
            self._means = torch.cat([self._means, room])
            self._weights = torch.cat([self._weights, room])
        weight = self.decay * self._weights[row] + 1
        mean = self._means[row] + (value - self._means[row]) / weight
        self._weights[row] = torch.where(valid, weight, self._weights[row])
        self._means[row] = torch.where(valid, mean, self._means[row])
        return torch.where(self._weights[row] > 0, self._means[row], value)

    def state(self) -> dict[str, Any]:
        """Plain lists (synchronises)."""
        n = len(self._rows)
        return {
            "views": list(self._rows),
            "means": self._means[:n].tolist(),
            "weights": self._weights[:n].tolist(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restore `state()`."""
        like = {"dtype": self._means.dtype, "device": self._means.device}
        self._rows = {view: row for row, view in enumerate(state["views"])}
        self._means = torch.tensor(state["means"], **like)
        self._weights = torch.tensor(state["weights"], **like)
