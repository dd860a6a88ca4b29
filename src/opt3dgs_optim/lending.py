"""What a step lends to torch's Adam, and takes back whatever happens."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.part import Group


class Lent:
    """Learning rates, gradients and flags that stand in place of others for one step."""

    def __init__(self) -> None:
        self._items: list[tuple[dict[str, Any], str, Any]] = []
        self._attributes: list[tuple[Any, str, Any]] = []

    def item(self, owner: dict[str, Any], key: str, value: Any) -> None:
        """Put `value` in place of `owner[key]`."""
        self._items.append((owner, key, owner[key]))
        owner[key] = value

    def attribute(self, owner: Any, name: str, value: Any) -> None:
        """Put `value` in place of `owner.name`; None where there is none."""
        self._attributes.append((owner, name, getattr(owner, name, None)))
        setattr(owner, name, value)

    def take_back(self) -> None:
        """Put everything back."""
        for owner, key, value in self._items:
            owner[key] = value
        for owner, name, value in self._attributes:
            setattr(owner, name, value)

    def rate(self, group: Group, factor: float | Tensor, valid: Tensor | bool) -> None:
        """lr times the factor, never left in the group: schedulers would compound it.

        Args:
            group: the group to be stepped.
            factor: on Adam's step, not on decoupled weight decay, which would grow weights where
                it is negative.
            valid: 0-d, whether the step will be made, where only the device knows.
        """
        rate = group["lr"]
        if isinstance(factor, Tensor):
            if factor.device.type == "cpu":
                factor = factor.item()
            else:  # fused Adam reads a float32 learning rate from the device
                device = group["params"][0].device
                factor = factor.to(device=device, dtype=torch.float32, non_blocking=True)
        if group.get("decoupled_weight_decay") and group["weight_decay"]:
            kept = 1 - rate * group["weight_decay"]
            kept = torch.where(valid, kept, 1.0) if isinstance(valid, Tensor) else kept
            for param in group["params"]:
                if param.grad is not None:
                    param.mul_(kept)
            self.item(group, "weight_decay", 0.0)
        self.item(group, "lr", rate * factor)

    def flag(self, optimizer: Any, valid: Tensor) -> None:
        """Merge "the loss is not finite" with the GradScaler's flag, on the device."""
        flag, theirs = (~valid).to(torch.float32), getattr(optimizer, "found_inf", None)
        if theirs is not None:
            flag = torch.maximum(flag, theirs.reshape(()).to(flag.device))
        self.attribute(optimizer, "found_inf", flag)
