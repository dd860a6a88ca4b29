"""What optimizers and the scheduler say of themselves: a few short lines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from opt3dgs_optim.names import slot

MOST_GROUPS = 8


def block(name: str, lines: Iterable[str]) -> str:
    """`name(`, the lines, indented, and `)`."""
    return "\n".join([f"{name}(", *(f"  {line}" for line in lines), ")"])


def group_lines(groups: Iterable[Mapping[str, Any]]) -> list[str]:
    """A line per parameter group: name, shape and learning rate."""
    lines = [_group_line(i, group) for i, group in enumerate(groups)]
    more = len(lines) - MOST_GROUPS
    return lines if more <= 0 else [*lines[:MOST_GROUPS], f"and {more} more groups"]


def group_name(index: int, group: Mapping[str, Any]) -> str:
    """How a group is called in messages."""
    return str(group.get("name") or slot(group) or f"group {index}")


def _group_line(index: int, group: Mapping[str, Any]) -> str:
    params = group["params"]
    if len(params) == 1:
        size = str(list(params[0].shape))
    else:
        size = f"{len(params)} tensors, {sum(p.numel() for p in params):,} numbers"
    return f"{group_name(index, group)} {size}: lr {float(group['lr']):.4g}"
