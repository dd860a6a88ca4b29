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

Group = dict[str, Any]  # a parameter group of an optimizer


class Phase(enum.Enum):
    """What a training is doing."""

    EXPLORATION = "exploration"
    EXPLOITATION = "exploitation"


class Part:
    """One thing that a training's steps can have: a factor, another gradient, noise, ...

    A part overrides the hooks that it needs; another is never called. What it keeps per row lives
    in `optimizer.state[param]` under its `keys`, as float32 tensors with the points first, where an
    all-zero row means "nothing": density control edits them with the moments. What it keeps per
    parameter lives in the group, as plain numbers. Both travel in the optimizers' `state_dict()`,
    and so does `state_dict()` of the part.

    Parts know nothing of masks, of GradScaler or of `maximize`: they get the gradient of what is
    minimised, unscaled, zero in rows that a mask holds back. Examples: docs/write-a-part.md.

    Attributes:
        during: the phase in which the part acts; None: in both.
        names: the Gaussian parameters that it acts on, gsplat's names; None: every group.
        keys: what it keeps per row in `optimizer.state[param]`.
    """

    during: ClassVar[Phase | None] = None
    keys: ClassVar[tuple[str, ...]] = ()
    names: Any = GAUSSIAN  # tuple[str, ...] | None

    def __repr__(self) -> str:
        """The options that are given; the parameters where they are not the part's usual ones."""
        options = fields(self) if is_dataclass(self) else ()
        shown = [f.name for f in options if f.name != "names" or self.names != f.default]
        given = {name: getattr(self, name) for name in shown if getattr(self, name) is not None}
        return f"{type(self).__name__}({', '.join(f'{n}={v!r}' for n, v in given.items())})"

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
        self, group: Group, param: Tensor, grad: Tensor, state: dict[str, Any], course: Course
    ) -> Tensor:
        """The gradient that Adam is fed instead of `grad` (of its shape); may edit the moments.

        `state` holds Adam's moments already. `course.valid` as a tensor: a step that will be
        dropped is still prepared, and must leave no trace.
        """
        raise NotImplementedError

    def after(self, group: Group, param: Tensor, state: dict[str, Any], course: Course) -> None:
        """After the parameter has moved. The group's learning rate is the trainer's own again."""

    def numbers(self, course: Course) -> Mapping[str, float | Tensor]:
        """Columns of the run log for the iteration observed last: numbers or 0-d tensors."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint must hold, as plain floats, lists and dicts."""
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
