"""What parts have learnt and do not declare: their own `state_dict()`, put back or forgotten."""

from __future__ import annotations

import copy
from typing import Any

from opt3dgs_optim.checks import LOGGER, warn_user
from opt3dgs_optim.part import Part


def put_back(part: Part, attributes: dict[str, Any], state: dict[str, Any]) -> None:
    """Give a part the attributes that it had, and what it had learnt."""
    vars(part).clear()
    vars(part).update(attributes)
    if are_same(part.state_dict(), state):
        return
    try:
        part.load_state_dict(state)  # it has changed its lists and tensors in place
    except Exception as error:  # the others are put back all the same
        LOGGER.warning("%s cannot load what it has saved: %r", type(part).__name__, error)


def learnt_by(part: Part) -> dict[str, Any]:
    """A copy of what a part has learnt; nothing where it can only say so once it has."""
    try:
        return copy.deepcopy(part.state_dict())
    except Exception:
        return {}


def are_same(one: Any, other: Any) -> bool:
    """Whether two states are equal; tensors and arrays in them are taken for different."""
    try:
        return bool(one == other)
    except (RuntimeError, ValueError):
        return False


def begin_anew(name: str, part: Part, unlearnt: dict[str, Any]) -> None:
    """Have a part forget what it has learnt, of which a checkpoint says nothing."""
    try:
        part.load_state_dict(copy.deepcopy(unlearnt))
    except Exception as error:
        warn_user(
            f"{name} has learnt something that this checkpoint does not know of, and cannot load "
            f"the {unlearnt!r} that its state_dict() was at first ({error!r}): it keeps that"
        )
