"""How a trainer's optimizer gets the parts of a course, in place."""

import inspect
import logging
import sys
from typing import Any, NamedTuple

from torch.optim import Adam

from opt3dgs_optim.checks import LOGGER
from opt3dgs_optim.course import Course
from opt3dgs_optim.names import SLOT, canonical_name, group_name
from opt3dgs_optim.stepadam import StepAdam

CALL = "PhaseScheduler.upgrade"


class Found(NamedTuple):
    """An optimizer that can have the parts of a course."""

    optimizer: Any
    base: type[Adam] | None  # whose step the parts surround; None: it has them already
    slots: list[str | None]  # the Gaussian parameter that each group holds
    names: list[str]  # of the groups that hold one, as the trainer calls them
    left: list[str]  # of the others


def look_at(optimizer: Any, course: Course, shown: str, key: str | None) -> Found:
    """What an optimizer holds; it is not changed. Raises as `PhaseScheduler.upgrade`.

    `shown` is how messages call it, `key` what a dict of optimizers says that it holds; None: its
    groups' names say.
    """
    base = None
    if not isinstance(optimizer, StepAdam):
        base = _base_of(optimizer, shown)
    elif optimizer.course is not course:
        raise TypeError(f"{CALL}: {shown} is a {type(optimizer).__name__} with parts of its own")
    groups = optimizer.param_groups
    # A dict's key says what its optimizer holds, whatever the group is called.
    slots = [canonical_name(key or group.get("name")) for group in groups]
    if base is None:
        slots = [group.get(SLOT) for group in groups]
    known = [name for name in slots if name is not None]
    twice = sorted({name for name in known if known.count(name) > 1})
    if twice:
        raise ValueError(f"{CALL}: two groups of {shown} hold {twice[0]!r}")
    called = [key or group_name(i, group) for i, group in enumerate(groups)]
    names = [name for name, slot in zip(called, slots, strict=True) if slot is not None]
    left = [name for name, slot in zip(called, slots, strict=True) if slot is None]
    return Found(optimizer, base if known else None, slots, names, left)


def take(found: Found, course: Course) -> None:
    """Put the parts of `course` into an optimizer, in place."""
    if found.base is None:
        return
    optimizer = found.optimizer
    for group, name in zip(optimizer.param_groups, found.slots, strict=True):
        group[SLOT] = name
    vars(optimizer).pop("step", None)  # a learning-rate scheduler's wrapper of the old class's
    optimizer.__class__ = StepAdam
    optimizer.follow(course, found.base)
    course.take_loaded(optimizer)


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
