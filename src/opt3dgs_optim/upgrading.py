"""How a trainer's optimizer gets the parts of a course, in place."""

from __future__ import annotations

import inspect
import logging
import sys
from typing import Any

from torch.optim import Adam

from opt3dgs_optim.course import Course
from opt3dgs_optim.describe import group_name
from opt3dgs_optim.names import SLOT, canonical_name
from opt3dgs_optim.stepadam import StepAdam

CALL = "PhaseScheduler.upgrade"
LOGGER = logging.getLogger("opt3dgs_optim")


def take(optimizer: Any, course: Course, shown: str, key: str | None) -> tuple[list[str], bool]:
    """Put the parts of `course` into an optimizer, in place.

    Args:
        optimizer: a `torch.optim.Adam`, or one of this course already.
        course: the training's.
        shown: how messages call the optimizer.
        key: what a dict of optimizers says that it holds; None: its groups' names say.

    Returns:
        The names of the groups that have the parts now; whether the optimizer is new to them.

    Raises:
        TypeError, ValueError: as `PhaseScheduler.upgrade`.
    """
    groups = optimizer.param_groups if isinstance(optimizer, Adam) else []
    if isinstance(optimizer, StepAdam):
        if optimizer.course is not course:
            kind = type(optimizer).__name__
            raise TypeError(f"{CALL}: {shown} is a {kind} with parts of its own")
        return [group_name(i, g) for i, g in enumerate(groups) if g.get(SLOT) is not None], False
    base = _base_of(optimizer, shown)
    # A dict's key says what its optimizer holds, whatever the group is called.
    slots = [canonical_name(key or group.get("name")) for group in groups]
    known = [name for name in slots if name is not None]
    twice = sorted({name for name in known if known.count(name) > 1})
    if twice:
        raise ValueError(f"{CALL}: two groups of {shown} hold {twice[0]!r}")
    if not known:
        return [], False
    for group, name in zip(groups, slots, strict=True):
        group[SLOT] = name
    vars(optimizer).pop("step", None)  # a learning-rate scheduler's wrapper of the old class's
    optimizer.__class__ = StepAdam
    upgraded: Any = optimizer
    upgraded.follow(course, base)
    upgraded.take_loaded()
    named = zip(range(len(groups)), groups, slots, strict=True)
    return [key or group_name(i, group) for i, group, name in named if name is not None], True


def _base_of(optimizer: Any, shown: str) -> type[Adam]:
    """The class whose step the parts surround; TypeError where it is no Adam that they know."""
    kind = f"{type(optimizer).__module__}.{type(optimizer).__qualname__}"
    if not isinstance(optimizer, Adam):
        raise TypeError(f"{CALL}: {shown} is a {kind}, but torch.optim.Adam is needed")
    own = vars(optimizer).get("step")
    if own is not None and not getattr(own, "_wrapped_by_lr_sched", False):
        raise TypeError(f"{CALL}: somebody has replaced the step of {shown}, a {kind}")
    step = inspect.unwrap(type(optimizer).step)
    if step is inspect.unwrap(Adam.step):
        return Adam
    if list(inspect.signature(step).parameters)[1:2] == ["visibility"]:
        return type(optimizer)  # gsplat's SelectiveAdam, INRIA's SparseGaussianAdam
    raise TypeError(
        f"{CALL}: {shown} is a {kind} with a step of its own, but Adam's, or one that takes a "
        "visibility mask, is needed"
    )


def say(message: str) -> None:
    """A log line (INFO); on stderr where nobody has set logging up, as in most trainers."""
    if LOGGER.hasHandlers():
        LOGGER.info(message)
    else:
        record = LOGGER.makeRecord(LOGGER.name, logging.INFO, __file__, 0, message, (), None)
        logging.StreamHandler(sys.stderr).handle(record)
