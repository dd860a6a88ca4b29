"""The protocol of a part: one thing that a training's steps can have."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from numbers import Integral, Number, Real
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

import torch
from torch import Tensor

from opt3dgs_optim.checks import as_float, check_choice, set_options
from opt3dgs_optim.names import GAUSSIAN

if TYPE_CHECKING:
    from opt3dgs_optim.course import Course

Group = dict[str, Any]  # a parameter group of an optimizer
State = Any  # what a hook sees of a parameter's state: `state.ParameterState`, see `Part`
Window = tuple[int, int]  # first iteration, and the one after the last


class Phase(enum.Enum):
    """What a training is doing."""

    EXPLORATION = "exploration"
    EXPLOITATION = "exploitation"

    def __repr__(self) -> str:
        """As it is written in code, which messages show."""
        return f"Phase.{self.name}"


@dataclass(frozen=True)
class Kept:
    """One thing that a part keeps from step to step: see `Part.keeps`.

    Args:
        name: how the part's hooks read and write it, `state[name]`.
        per: `"row"` keeps a tensor whose first dimension is the parameter's, one row per point;
            `"parameter"` a number per parameter; `"training"` one number for the whole training.
        shape: per row, the dimensions after the first, or a function of the parameter [N, ..] that
            gives them; None: those of the parameter itself. A number has none.
        dtype: of what is kept. A floating one is never narrower than the parameter's: what belongs
            to float64 positions is kept in float64. What has a number for each of the parameter's
            is complex where that is.
        initial: the value of a number before it is written, one that the dtype has. Rows begin as
            zeros, because trainers that add points append zero rows: an all-zero row must mean
            "nothing yet".
        allowed: the smallest and the largest number that it may be, with `initial` from one to the
            other; None: any. One of a checkpoint beyond that is damage. A number that is not finite
            is, too, unless `initial` is none.

    Raises:
        ValueError: an option is outside what is allowed, or does not go with the others.
    """

    name: str
    per: Literal["row", "parameter", "training"] = "row"
    shape: tuple[int, ...] | Callable[[Tensor], tuple[int, ...]] | None = None
    dtype: torch.dtype = torch.float32
    initial: float = 0.0
    allowed: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Check the options, and make plain numbers of Python's of them."""
        check_choice("Kept", "per", self.per, ("row", "parameter", "training"))
        if not isinstance(self.name, str) or not self.name.isidentifier():
            raise ValueError(f"Kept: name={self.name!r}, but a word without dots is needed")
        if not isinstance(self.dtype, torch.dtype):
            raise ValueError(f"Kept: dtype={self.dtype!r}, but a torch.dtype is needed")
        if not isinstance(self.initial, Number):
            raise ValueError(f"Kept: initial={self.initial!r}, but a number is needed")
        if self.per == "row" and self.initial != 0:
            raise ValueError(f"Kept: initial={self.initial!r}, but rows begin as zeros")
        if self.per != "row" and self.shape is not None:
            raise ValueError(
                f"Kept: shape={self.shape!r} and per={self.per!r}, but None is needed for a number"
            )
        shape = self.shape
        if not (shape is None or callable(shape)):
            shape = _checked_shape(shape, ", a function of the parameter, or None")
        initial = _checked_initial(self.initial, self.dtype)
        allowed = _checked_interval(self.allowed, initial, self.dtype)
        set_options(self, shape=shape, initial=initial, allowed=allowed)

    def shape_for(self, param: Tensor) -> tuple[int, ...]:
        """The whole shape of what is kept of a parameter [N, ..]."""
        if self.per != "row":
            return ()
        if self.shape is None:
            return tuple(param.shape)
        rest = _checked_shape(self.shape(param)) if callable(self.shape) else self.shape
        return (*param.shape[:1], *rest)

    def dtype_for(self, param: Tensor) -> torch.dtype:
        """The dtype of what is kept of a parameter."""
        wide = param.dtype in (torch.float64, torch.complex128)
        alike = self.per == "row" and self.shape is None  # one number for each of the parameter's
        if self.dtype.is_floating_point and param.is_complex() and alike:
            return torch.complex128 if wide else torch.complex64
        return torch.float64 if self.dtype.is_floating_point and wide else self.dtype

    def make(self, param: Tensor) -> Tensor:
        """The initial value for a parameter, on its device."""
        shape, dtype = self.shape_for(param), self.dtype_for(param)
        value = 0.0 if self.per == "row" else self.initial
        return torch.full(shape, value, dtype=dtype, device=param.device)


def _checked_shape(shape: Any, others: str = "") -> tuple[int, ...]:
    """The dimensions after the first; ValueError unless they are whole numbers from 0."""
    rest = [as_float(each) for each in shape] if isinstance(shape, (tuple, list)) else [-1.0]
    if not all(each >= 0 and each.is_integer() for each in rest):
        raise ValueError(
            f"Kept: shape={shape!r}, but a tuple of the dimensions after the first, whole numbers "
            f"from 0{others} is needed"
        )
    return tuple(map(int, rest))


def _checked_initial(initial: Any, dtype: torch.dtype) -> Any:
    """The number as one of Python's own; ValueError unless the dtype has it."""
    number = _number_of(initial, dtype)
    if number is None:
        raise ValueError(f"Kept: initial={initial!r}, but a number that {dtype} has is needed")
    return number


def _number_of(value: Any, dtype: torch.dtype) -> Any:
    """A number as one of Python's own; None where the dtype has none of that size, or kind."""
    try:
        if dtype.is_complex:
            number = complex(value)
            parts = number.real, number.imag
        elif not isinstance(value, Real):
            return None
        elif dtype.is_floating_point:
            number = float(value)
            parts = (number,)
        else:
            number, is_bool = int(cast(Any, value)), dtype == torch.bool
            low, high = (0, 1) if is_bool else (torch.iinfo(dtype).min, torch.iinfo(dtype).max)
            return number if number == value and low <= number <= high else None
    except (OverflowError, ValueError):  # one beyond all floats, or no finite one for an integer
        return None
    largest = torch.finfo(dtype).max
    return number if all(abs(p) <= largest or not math.isfinite(p) for p in parts) else None


def _checked_interval(allowed: Any, initial: Any, dtype: torch.dtype) -> Any:
    """The pair of numbers; ValueError unless `initial` lies between them."""
    if allowed is None:
        return None
    is_pair = isinstance(allowed, (tuple, list)) and len(allowed) == 2
    pair: Any = allowed if is_pair else (None, None)
    low, high = map(as_float, pair)
    if not low <= high or dtype.is_complex:
        needed = "None" if dtype.is_complex else "a pair of numbers (low, high), low <= high,"
        raise ValueError(f"Kept: allowed={allowed!r}, but {needed} is needed for {dtype}")
    low, high = (int(each) if isinstance(each, Integral) else float(each) for each in pair)
    if not low <= initial <= high:
        raise ValueError(
            f"Kept: allowed={allowed!r}, but what it begins with, initial={initial!r}, is needed "
            "among these"
        )
    return low, high


class Part:
    """One thing that a training's steps can have: a factor, another gradient, noise, ...

    A part overrides the hooks that it needs, and a hook that is not overridden is never called. It
    knows nothing of masks, of GradScaler, of `maximize` or of steps that do not count: a hook gets
    the gradient of what is minimised, unscaled, and zero in rows that a mask holds still. Energies
    alone are as the trainer says them, also where it maximises.

    What a part keeps is declared in `keeps`, and the optimizer does the rest. It makes each entry
    when a hook first reads it, on the parameter's device and in the declared dtype; it stores it
    under the part's own name, so that two parts of one class never share; it saves it with the
    optimizer's `state_dict()`, and checks and restores it; it drops rows that are not those of the
    parameter any more, and everything once the part's `window` is over or another one begins.

    The hooks' `state` is a mapping. `state["exp_avg"]`, `state["exp_avg_sq"]` and `state["step"]`
    are Adam's own moments under torch's names, and a declared name is what the part keeps. Both may
    be edited in place or assigned; `state.last_step` is the iteration of the parameter's last step.

    If a step turns out not to count (its loss is not finite, or a GradScaler skips it), its
    gradient is zero, and what hooks have written to the parameter and to what they keep is undone.
    An edit of Adam's moments holds, and `last_step` goes on: an event of the iteration has happened
    whether its step counts or not, on a host as on a GPU, which knows too late.

    `docs/write-a-part.md` has examples.

    Attributes:
        during: the phase in which the part acts; None: in both.
        names: the Gaussian parameters that it acts on, gsplat's names; None: every group.
        keeps: what it keeps.
        own_units: whether `before` feeds Adam a gradient in other units than the parameter's. Then
            Adam's moments are in these units, too, and begin anew where the part begins to act on
            a parameter or ends, in a checkpoint of the unchanged trainer, say.
        needs_units: whether `before` needs a gradient in the parameter's own units. Then the part
            cannot come after one that has other units.
        spares_own_units: whether the part leaves a parameter alone while another one that acts on
            it has units of its own.
    """

    during: ClassVar[Phase | None] = None
    own_units: ClassVar[bool] = False
    needs_units: ClassVar[bool] = False
    spares_own_units: ClassVar[bool] = False
    keeps: tuple[Kept, ...] = ()
    names: Any = GAUSSIAN  # tuple[str, ...] | None

    def __repr__(self) -> str:
        """The options that are given; the parameters where they are not the part's usual ones."""
        options = fields(self) if is_dataclass(self) else ()
        shown = [f.name for f in options if f.name != "names" or self.names != f.default]
        given = {name: getattr(self, name) for name in shown if getattr(self, name) is not None}
        return f"{type(self).__name__}({', '.join(f'{n}={v!r}' for n, v in given.items())})"

    def window(self, course: Course) -> Window | None:
        """The iterations for which what the part keeps is valid; None: all.

        What was kept in another window is dropped: in a longer run, after the clock has been set
        back, or when the window is over. A part acts in no step outside of its window. A part that
        acts in one phase has that phase's window.
        """
        return course.window_of(self.during)

    def ready(self, group: Group, course: Course) -> bool:
        """Whether the part can act on a group in this step; asked in every step if overridden."""
        return True

    def observe(self, energy: Tensor, valid: Tensor | bool, course: Course) -> None:
        """Take the loss of an iteration in which the part acts, 0-d, finite where `valid`.

        That is a 0-d bool tensor where the loss lives on a GPU, whose numbers are not to be read.
        """

    def pixel_loss(self, error: Tensor) -> Tensor:
        """The photometric term, 0-d, of `render - target`; the last part that has one wins."""
        raise NotImplementedError

    def factor(self, group: Group, course: Course) -> float | Tensor | None:
        """The factor on the group's step, 0-d; None is 1. The factors of all parts multiply."""

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """The gradient that Adam is fed instead of `grad`, of its shape; may edit the moments.

        Adam's moments are there already, and the parameter has not moved yet.
        """
        raise NotImplementedError

    def displacement(
        self, group: Group, param: Tensor, step: Tensor, state: State, course: Course
    ) -> Tensor:
        """What the parameter moves by instead of Adam's `step`, of its shape.

        Adam's step, learning rate and factors included, is added to the parameter elsewhere; a part
        with this hook gets it by itself, and the parameter has not moved yet. Of several parts the
        last one is asked first, which had the last word on what Adam is fed.
        """
        raise NotImplementedError

    def after(self, group: Group, param: Tensor, state: State, course: Course) -> None:
        """After the parameter has moved. The group's learning rate is the trainer's own again."""

    def numbers(self, course: Course) -> Mapping[str, float | Tensor]:
        """Columns of the run log for the iteration observed last: numbers or 0-d tensors.

        The log's own are `kind`, `iteration`, `seconds`, `phase`, `event`, `energy`, `metadata` and
        `self`.
        """
        return {}

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint must hold besides `keeps`, as plain floats, lists and dicts."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`; ValueError where it is damaged, and then nothing is changed."""

    def evidence(self, course: Course) -> Tensor | None:
        """What it did to this training, [k] numbers on the device; None: nothing to judge by.

        With `adaptive=True` read every 100 iterations, all parts' at once, averaged over the ranks.
        """

    def useless(self, evidence: list[float], course: Course) -> str | None:
        """Why this training does not need the part, or None; asked while it is off, too."""


def overrides(part: Part, hook: str) -> bool:
    """Whether a part has a hook of its own."""
    return getattr(type(part), hook) is not getattr(Part, hook)
