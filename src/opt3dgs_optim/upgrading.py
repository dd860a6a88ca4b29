"""How a trainer's optimizer gets the parts of a course, in place."""

import functools
import inspect
import logging
import sys
from collections.abc import Mapping
from typing import Any, NamedTuple

from torch.optim import Adam, Optimizer

from opt3dgs_optim.checks import LOGGER, warn_user
from opt3dgs_optim.course import Course
from opt3dgs_optim.names import (
    GAUSSIAN_NAMES,
    canonical_name,
    gaussian_of,
    group_name,
    is_known_other,
    set_of,
    split_name,
)
from opt3dgs_optim.overrides import without_torchs_own
from opt3dgs_optim.state import rows_of
from opt3dgs_optim.stepadam import StepAdam
from opt3dgs_optim.version import __version__

CALL = "PhaseScheduler.upgrade"


class Candidate(NamedTuple):
    """An optimizer that was looked at."""

    key: str | None  # its key in a dict of optimizers, which says what it holds
    optimizer: Any
    shown: str  # how messages call it


class Plan(NamedTuple):
    """What is to be done with an optimizer that the parts do not surround yet."""

    optimizer: Optimizer
    base: type[Adam]  # whose step the parts surround
    made: type[StepAdam]  # the class that it gets
    slots: list[tuple[str, str | None]]  # by group: set of Gaussians, which parameter


def upgrade(optimizers: Any, course: Course) -> int:
    """Put the parts of `course` into optimizers, in place; how many did not have them.

    Arguments and errors are those of `PhaseScheduler.upgrade`.
    """
    candidates = _candidates(optimizers)
    taken, left, plans, held = list[str](), list[str](), list[Plan](), list[tuple[str, str]]()
    unknown: list[tuple[str, Any]] = []
    known_rows = set[int]()
    looked_at = dict[int, str]()
    for key, optimizer, shown in candidates:  # all are looked at before the first is changed
        if id(optimizer) in looked_at:
            raise ValueError(f"{CALL}: {shown} is {looked_at[id(optimizer)]}, which is there twice")
        looked_at[id(optimizer)] = shown
        if key is not None and canonical_name(key) is None:
            left.append(str(key))
            unknown += [(str(key), group) for group in getattr(optimizer, "param_groups", ())]
            continue
        plan, slots = _look_at(optimizer, course, shown, key)
        for i, (group, slot) in enumerate(zip(optimizer.param_groups, slots, strict=True)):
            set_name, name = slot
            called = key or group_name(i, group)
            if name is None:
                left.append(called)
                unknown.append((called, group))
                continue
            if (set_name, name) in held:
                raise ValueError(f"{CALL}: two groups of {shown} hold {name!r}")
            held.append((set_name, name))
            taken.append(called)
            known_rows |= {rows_of(param) for param in group["params"] if param.dim()}
        if plan is not None and any(name for _, name in slots):
            plans.append(plan)
    if not taken:
        names = sorted(alias for aliases in GAUSSIAN_NAMES.values() for alias in aliases)
        raise ValueError(
            f"{CALL}: none of the names {left} is a Gaussian parameter's; allowed are "
            f"{', '.join(names)}"
        )
    parts = ", ".join(str(part) for part in course.parts) or "none"  # a part's own words may fail
    _warn_of_unknown(unknown, known_rows)
    _carry_out(plans, course)
    others = f"; left alone: {', '.join(left)}" if left else ""
    again = f" from iteration {course.iteration}" if course.iteration else ""
    say(
        f"opt3dgs_optim {__version__}: total_steps={course.total_steps}{again}, parts {parts}, "
        f"in the steps of {', '.join(taken)}{others}"
    )
    return len(plans)


def _carry_out(plans: list[Plan], course: Course) -> None:
    """Give all optimizers their parts, or none: what a stock trainer has loaded may be damaged."""
    before = [Unchanged(plan.optimizer) for plan in plans]
    try:
        with course.undone_on_error():
            course.followers.upgrades += 1
            for plan in plans:
                optimizer: Any = plan.optimizer
                optimizer.upgraded_in = course.followers.upgrades
                # A learning-rate scheduler's wrapper of the old class's.
                vars(optimizer).pop("step", None)
                optimizer.__class__ = plan.made
                optimizer.hold(plan.slots)
                optimizer.follow(course, plan.base)
                optimizer.take_loaded()
    except BaseException:
        for each in before:
            each.put_back()
        raise


class Unchanged:
    """An optimizer as it was, to be put back if it cannot get its parts.

    Its tensors are not copied: an upgrade writes into none of them.
    """

    def __init__(self, optimizer: Optimizer) -> None:
        self._optimizer, self._class = optimizer, type(optimizer)
        self._attributes, self._defaults = dict(vars(optimizer)), dict(optimizer.defaults)
        self._groups = list(optimizer.param_groups)
        # By parameter: its state, and what is in it.
        self._state = {
            param: (own, dict(own) if isinstance(own, dict) else {})
            for param, own in optimizer.state.items()
        }

    def put_back(self) -> None:
        """Make it again what it was, in the same lists and dicts."""
        optimizer: Any = self._optimizer
        vars(optimizer).clear()
        vars(optimizer).update(self._attributes)
        optimizer.__class__ = self._class
        optimizer.param_groups[:] = self._groups
        for into, was in ((optimizer.defaults, self._defaults), *self._state.values()):
            if isinstance(into, dict):
                into.clear()
                into.update(was)
        for param in [param for param in optimizer.state if param not in self._state]:
            del optimizer.state[param]


def _candidates(optimizers: Any) -> list[Candidate]:
    if isinstance(optimizers, Optimizer):
        return [Candidate(None, optimizers, "the optimizer")]
    if isinstance(optimizers, Mapping):
        return [Candidate(key, each, f"optimizers[{key!r}]") for key, each in optimizers.items()]
    if isinstance(optimizers, (list, tuple)):
        return [Candidate(None, each, f"optimizers[{i}]") for i, each in enumerate(optimizers)]
    raise TypeError(
        f"{CALL}: optimizers is a {type(optimizers).__name__}, but a dict or a list of optimizers, "
        "or one optimizer with named groups, is needed"
    )


def _warn_of_unknown(unknown: list[tuple[str, Any]], known_rows: set[int]) -> None:
    """Say which groups may be Gaussian parameters under names that are not known here."""
    suspects = [
        name
        for name, group in unknown
        if any(param.dim() and rows_of(param) in known_rows for param in group["params"])
        and max(known_rows) > 1
        and not is_known_other(name)
    ]
    if suspects:
        warn_user(
            f"{CALL}: {', '.join(suspects)} stay as they are, though they have as many rows as the "
            "Gaussian parameters. If they are some, the parts act on the others only; put "
            f"the optimizers into a dict under names that are known: {', '.join(GAUSSIAN_NAMES)}"
        )


def _look_at(
    optimizer: Any, course: Course, shown: str, key: str | None
) -> tuple[Plan | None, list[tuple[str, str | None]]]:
    """How an optimizer gets the parts (None: it has them already); what each group holds."""
    if isinstance(optimizer, StepAdam):
        if optimizer.course is not course:
            raise TypeError(
                f"{CALL}: {shown} is a {optimizer.call_name} with parts of its own; use the "
                "scheduler that it has, or make a new optimizer"
            )
        groups = optimizer.param_groups
        return None, [(set_of(group), gaussian_of(group)) for group in groups]
    base = _base_of(optimizer, shown)
    # A dict's key says what its optimizer holds, whatever the group is called.
    slots = [split_name(key or group.get("name")) for group in optimizer.param_groups]
    if not any(name for _, name in slots):
        return None, slots
    return Plan(optimizer, base, _made_class(optimizer, shown), slots), slots


def _made_class(optimizer: Any, shown: str) -> type[StepAdam]:
    """The class that the optimizer gets; TypeError where its own cannot be kept."""
    kind = type(optimizer)
    _check_attributes(optimizer, shown)
    try:
        made = upgraded_class(kind)
        # What assignment of a class asks: the same layout.
        object.__new__(kind).__class__ = made
    except TypeError as error:
        raise TypeError(
            f"{CALL}: {shown} is a {kind.__module__}.{kind.__qualname__}, of which no class with "
            f"parts can be made ({error})"
        ) from None
    return made


def _check_attributes(optimizer: Any, shown: str) -> None:
    """TypeError where attributes of the trainer's would hide those of the parts, or be hidden."""
    kind, everything = type(optimizer), {*vars(StepAdam), *StepAdam.__annotations__}
    between = [each for each in kind.__mro__ if each not in Adam.__mro__]
    theirs = {*vars(optimizer)}.union(*map(vars, between))
    own = {name for name in everything if not name.startswith("__") and not hasattr(Adam, name)}
    clash = sorted(own & theirs)
    if clash:
        raise TypeError(
            f"{CALL}: {shown}, a {kind.__module__}.{kind.__qualname__}, has {', '.join(clash)}, "
            "which is a name of the parts' own; give it another one"
        )
    replaced = sorted(name for name in everything & {*vars(optimizer)} if name != "step")
    if replaced:
        raise TypeError(
            f"{CALL}: somebody has replaced {', '.join(replaced)} of {shown}, a "
            f"{kind.__module__}.{kind.__qualname__}; do that after the upgrade"
        )
    if any({"__reduce__", "__reduce_ex__"} & {*vars(each)} for each in between):
        raise TypeError(
            f"{CALL}: {shown} is a {kind.__module__}.{kind.__qualname__}, whose __reduce__ a copy "
            "with parts could not keep; what a copy needs can be in __getstate__ and __setstate__"
        )


@functools.cache
def upgraded_class(base: type[Adam]) -> type[StepAdam]:
    """The class of an upgraded optimizer: a `StepAdam` that is still a `base`.

    Trainers choose by `isinstance`, call what their own class overrides, and look at the module of
    the class: name, module and the methods that `StepAdam` has not are `base`'s.
    """
    bases = (StepAdam,) if base is Adam else (StepAdam, base)

    def new(cls: type[StepAdam], *args: Any, **options: Any) -> Any:
        # `type(optimizer)(...)`, of a trainer that makes it anew: one without parts.
        return base(*args, **options) if args or options else object.__new__(cls)

    def reduce(self: StepAdam, protocol: Any) -> Any:
        # A made class is found by the class that it was made of, not by its name.
        return _new_upgraded, (base,), self.__getstate__()

    names = {"__module__": base.__module__, "__qualname__": base.__qualname__, "_made_of": base}
    if base.__repr__ is not Adam.__repr__:
        names["__repr__"] = base.__repr__
    return type(base.__name__, bases, {**names, "__new__": new, "__reduce_ex__": reduce})


def _new_upgraded(base: type[Adam]) -> StepAdam:
    made = upgraded_class(base)
    return made.__new__(made)


def _base_of(optimizer: Any, shown: str) -> type[Adam]:
    """The class whose step the parts surround; TypeError where it is no Adam that they know."""
    kind = f"{type(optimizer).__module__}.{type(optimizer).__qualname__}"
    if not isinstance(optimizer, Adam):
        raise TypeError(f"{CALL}: {shown} is a {kind}, but torch.optim.Adam is needed")
    # A learning-rate scheduler wraps the class's step; another may have wrapped its wrapper.
    own = vars(optimizer).get("step")
    wrapped = getattr(own, "__func__", None) or getattr(own, "__wrapped__", None)
    if own is not None and wrapped is not type(optimizer).step:
        raise TypeError(f"{CALL}: somebody has replaced the step of {shown}, a {kind}")
    step = without_torchs_own(type(optimizer).step)
    if step is without_torchs_own(Adam.step):
        _check_device_path(optimizer, shown)
        return Adam
    if list(inspect.signature(step).parameters)[1:2] == ["visibility"]:
        return type(optimizer)  # gsplat's SelectiveAdam, INRIA's SparseGaussianAdam
    raise TypeError(
        f"{CALL}: {shown} is a {kind} with a step of its own, but Adam's, or one that takes a "
        "visibility mask, is needed"
    )


def _check_device_path(optimizer: Any, shown: str) -> None:
    """TypeError for tensors whose steps are another matter, such as DTensor's shards."""
    for group in optimizer.param_groups:
        for param in group["params"]:
            if type(param).__name__ == "DTensor" or type(param.data).__name__ == "DTensor":
                raise TypeError(
                    f"{CALL}: {shown} holds a DTensor, but parts act on the rows of plain tensors; "
                    "upgrade optimizers of local tensors, as gsplat's distributed trainer has them"
                )


def say(message: str) -> None:
    """A log line (INFO); on stderr where nobody has set logging up, as in most trainers."""
    if LOGGER.hasHandlers():
        LOGGER.info(message)
    elif LOGGER.level <= logging.INFO and not LOGGER.disabled:  # nobody has asked for silence
        record = LOGGER.makeRecord(LOGGER.name, logging.INFO, __file__, 0, message, (), None)
        logging.StreamHandler(sys.stderr).handle(record)
