"""The protocol of a part: one thing that a training's steps can have."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from torch import Tensor

from opt3dgs_optim.names import GAUSSIAN

if TYPE_CHECKING:
    from opt3dgs_optim.course import Course
    from opt3dgs_optim.step import Step


class Phase(enum.Enum):
    """What a training is doing."""

    EXPLORATION = "exploration"
    EXPLOITATION = "exploitation"


class Part:
    """One thing that a training's steps can have: a factor, fading, another gradient, ...

    A part says *what* the step of a parameter has, in `plan`, by plain values; one function makes
    the step of them (`opt3dgs_optim.step`), on a GPU in one launch. A part that needs its own
    arithmetic has `before` and `after`, in torch operations, at a launch for each of them.

    What a part learns of a training goes into `course.notes_of(self)`, a dict of plain numbers by
    name, which is saved with the optimizers; a part object whose state lives in itself sets
    `learns`, and serves one training.

    `docs/write-a-part.md` has examples.

    Attributes:
        during: the phase in which the part acts; None: in both.
        names: the Gaussian parameters that it acts on, gsplat's names; None: every parameter.
        learns: whether the object itself changes in a training.
    """

    during: ClassVar[Phase | None] = None
    learns: ClassVar[bool] = False
    names: Any = GAUSSIAN  # tuple[str, ...] | None

    def plan(self, step: Step, course: Course) -> None:
        """Say what the step has, before it is made, by setting attributes of `step`."""

    def before(self, step: Step, course: Course) -> Tensor:
        """The gradient [N, ...] that Adam is fed in the place of `step.grad`."""
        return step.grad

    def after(self, step: Step, course: Course) -> None:
        """Change `step.param` [N, ...] in place, after the step."""

    def observe(self, energy: Tensor, course: Course) -> None:
        """Take the loss of this iteration, 0-d; called by `observe(loss)`."""

    def settle(self, course: Course) -> None:
        """Take what is still on its way from a device into the notes; called before a save."""

    def pixel_loss(self, error: Tensor) -> Tensor:
        """The photometric term of an error [...] of pixels, 0-d."""
        raise NotImplementedError

    def numbers(self, course: Course) -> Mapping[str, float | Tensor]:
        """What a log may show of this iteration; a device's numbers stay there."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """What the object has learnt, as plain numbers and lists."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`; ValueError, with nothing changed, where it does not fit."""

    def __repr__(self) -> str:
        """The options that are given; the parameters where they are not the part's usual ones."""
        options = fields(self) if is_dataclass(self) else ()
        shown = [f.name for f in options if f.name != "names" or self.names != f.default]
        given = {name: getattr(self, name) for name in shown}
        return f"{type(self).__name__}({', '.join(f'{n}={v!r}' for n, v in given.items())})"


def overrides(part: Part, hook: str) -> bool:
    """Whether a part has a hook of its own."""
    return getattr(type(part), hook) is not getattr(Part, hook)
