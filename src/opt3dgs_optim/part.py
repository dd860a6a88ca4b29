"""The protocol of a part: one thing that a training's steps can have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any, ClassVar

from torch import Tensor

from opt3dgs_optim.clock import Phase
from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training


class Part:
    """One thing that a training's steps can have: a factor, fading, another gradient, ...

    In `plan`, a part sets plain values that say *what* a parameter's step has; one function makes
    the step from them (`opt3dgs_optim.step`), on a GPU in one launch. A part with arithmetic of its
    own puts another gradient into `step.grad`, or has `after`; both use torch operations, each a
    launch.

    What a part learns of a training goes into `training.notes_of(self)`, a dict of plain numbers by
    name, which is saved with the optimizers; a part object whose state lives in itself sets
    `learns`, and serves one training.

    `docs/write-a-part.md` has examples.

    Attributes:
        during: the phase in which the part acts; None: in both.
        names: the Gaussian parameters that it acts on, gsplat's names; None: every parameter.
        learns: whether the object itself changes in a training.
        later: which of "factor" (on a device), "hold" and "mean" it may add in steps after the
            first: a GPU's kernels for them are compiled at the first step.
    """

    during: ClassVar[Phase | None] = None
    learns: ClassVar[bool] = False
    later: ClassVar[tuple[str, ...]] = ()
    names: Any = GAUSSIAN  # tuple[str, ...] | None

    def begins(self, training: Training) -> int:
        """The first iteration in which it acts; of a training of no planned end, 0."""
        return 0

    def plan(self, step: Step, training: Training) -> None:
        """Say what the step has, before it is made, by setting attributes of `step`."""

    def after(self, step: Step, training: Training) -> None:
        """Change `step.param` [N, ...] in place, after the step."""

    def observe(self, energy: Tensor, training: Training) -> None:
        """Take the loss of this iteration, 0-d; called by `observe(loss)`."""

    def read_back(self, training: Training) -> None:
        """Take what is on its way from a device into the notes: before a save, after a load."""

    def pixel_loss(self, error: Tensor) -> Tensor:
        """The photometric term of an error [...] of pixels, 0-d."""
        raise NotImplementedError

    def numbers(self, training: Training) -> Mapping[str, float | Tensor]:
        """What a log may show of this iteration; a device's numbers stay there."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """What the object has learnt, as plain numbers and lists."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`; ValueError, with nothing changed, where it does not fit."""

    def overrides(self, hook: str) -> bool:
        """Whether it has a hook of its own."""
        return getattr(type(self), hook) is not getattr(Part, hook)

    def __repr__(self) -> str:
        """The options that are given; the parameters where they are not the part's usual ones."""
        options = fields(self) if is_dataclass(self) else ()
        shown = [f.name for f in options if f.name != "names" or self.names != f.default]
        given = {name: getattr(self, name) for name in shown}
        return f"{type(self).__name__}({', '.join(f'{n}={v!r}' for n, v in given.items())})"
