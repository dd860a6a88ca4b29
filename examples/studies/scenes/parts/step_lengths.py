"""How long the steps really are, without noise."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from opt3dgs_optim import Course, Part
from opt3dgs_optim.names import SLOT
from opt3dgs_optim.part import Group


class StepLengths(Part):
    """Root mean square of every parameter's step over its learning rate, in every n-th iteration.

    Args:
        every: n.

    Attributes:
        rows: parameter -> length of each step that was looked at.
    """

    def __init__(self, every: int) -> None:
        self.every = every
        self.rows: dict[str, list[float]] = {}
        self._old: dict[str, Tensor] = {}

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: dict[str, Any], course: Course
    ) -> Tensor:
        """Remember where the parameter was."""
        if course.iteration % self.every == 0:
            self._old[str(group[SLOT])] = param.detach().clone()
        return grad

    def after(self, group: Group, param: Tensor, state: dict[str, Any], course: Course) -> None:
        """Compare; a part that adds noise comes later in the list."""
        old = self._old.pop(str(group[SLOT]), None)
        if old is not None:
            length = float(((param.detach() - old) / group["lr"]).square().mean().sqrt())
            self.rows.setdefault(str(group[SLOT]), []).append(round(length, 5))
