"""A CPU that is taken for a GPU: whether a loss is finite is then known on the device only."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim import Course


def on_a_device(monkeypatch: Any) -> None:
    """Have courses keep `valid` as a tensor, which nothing reads back, as on a GPU."""

    def take(self: Course, energy: Tensor) -> None:
        self.num_observed += 1
        self.energy_device = energy.device
        self.valid = torch.isfinite(energy)
        for part in self.hooks["observe"]:
            part.observe(energy, self.valid, self)

    monkeypatch.setattr(Course, "take", take)
