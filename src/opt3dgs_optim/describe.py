"""What optimizers and the scheduler say of themselves: a few short lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from opt3dgs_optim.names import SLOT


def block(name: str, lines: Iterable[str]) -> str:
    """`name(`, the lines, indented, and `)`."""
    return "\n".join([f"{name}(", *(f"  {line}" for line in lines), ")"])


def group_name(index: int, group: Mapping[str, Any]) -> str:
    """How a group is called in messages."""
    return str(group.get("name") or group.get(SLOT) or f"group {index}")


def group_line(index: int, group: Mapping[str, Any]) -> str:
    """A parameter group's name, shape and learning rate."""
    params = group["params"]
    size: Any = list(params[0].shape)
    if len(params) != 1:
        size = f"{len(params)} tensors, {sum(p.numel() for p in params):,} numbers"
    return f"{group_name(index, group)} {size}: lr {float(group['lr']):.4g}"
