"""How a trainer's optimizer gets the parts of a course, in place."""

import inspect
import logging
import sys
from collections.abc import Mapping
from typing import Any

from torch.optim import Adam, Optimizer

from opt3dgs_optim.checks import LOGGER
from opt3dgs_optim.course import Course
from opt3dgs_optim.names import GAUSSIAN_NAMES, SLOT, canonical_name, group_name
from opt3dgs_optim.stepadam import StepAdam
from opt3dgs_optim.version import __version__

CALL = "PhaseScheduler.upgrade"


def upgrade(optimizers: Any, course: Course) -> int:
    """Put the parts of `course` into optimizers, in place; how many did not have them.

    Arguments and errors are those of `PhaseScheduler.upgrade`.
    """
    if isinstance(optimizers, Optimizer):
        found = [(None, optimizers, "the optimizer")]
    elif isinstance(optimizers, Mapping):
        found = [(key, each, f"optimizers[{key!r}]") for key, each in optimizers.items()]
    else:
        raise TypeError(
            f"{CALL}: optimizers is a {type(optimizers).__name__}, but a dict of optimizers, or "
            "one optimizer with named groups, is needed"
        )
    taken, left, plans = [], [], []
    for key, optimizer, shown in found:  # all are looked at before the first is changed
        if key is not None and canonical_name(key) is None:
            left.append(str(key))
            continue
        base, slots = _look_at(optimizer, course, shown, key)
        for i, (group, slot) in enumerate(zip(optimizer.param_groups, slots, strict=True)):
            (left if slot is None else taken).append(key or group_name(i, group))
        if base is not None and any(slots):
            plans.append((optimizer, base, slots))
    if not taken:
        names = sorted(alias for aliases in GAUSSIAN_NAMES.values() for alias in aliases)
        raise ValueError(
            f"{CALL}: none of the names {left} is a Gaussian parameter's; allowed are "
            f"{', '.join(names)}"
        )
    for optimizer, base, slots in plans:
        for group, slot in zip(optimizer.param_groups, slots, strict=True):
            group[SLOT] = slot
        vars(optimizer).pop("step", None)  # a learning-rate scheduler's wrapper of the old class's
        optimizer.__class__ = StepAdam
        optimizer.follow(course, base)
        course.take_loaded(optimizer)
    parts = ", ".join(str(part) for part in course.parts) or "none"
    others = f"; left alone: {', '.join(left)}" if left else ""
    again = f" from iteration {course.iteration}" if course.iteration else ""
    _say(
        f"opt3dgs_optim {__version__}: total_steps={course.total_steps}{again}, parts {parts}, "
        f"in the steps of {', '.join(taken)}{others}"
    )
    return len(plans)


def _look_at(
    optimizer: Any, course: Course, shown: str, key: str | None
) -> tuple[type[Adam] | None, list[str | None]]:
    """Whose step the parts surround (None: it has them already); what each group holds.

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
    twice = sorted({name for name in slots if name is not None and slots.count(name) > 1})
    if twice:
        raise ValueError(f"{CALL}: two groups of {shown} hold {twice[0]!r}")
    return base, slots


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


def _say(message: str) -> None:
    """A log line (INFO); on stderr where nobody has set logging up, as in most trainers."""
    if LOGGER.hasHandlers():
        LOGGER.info(message)
    else:
        record = LOGGER.makeRecord(LOGGER.name, logging.INFO, __file__, 0, message, (), None)
        logging.StreamHandler(sys.stderr).handle(record)
