"""Points out of view: where views see little of a scene, regularisers make no full steps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim import triton
from opt3dgs_optim.device import Reading
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Hold, Step
from opt3dgs_optim.training import Training

GOLDEN_RATIO = (5**0.5 - 1) / 2
SHARE_LOOKED_AT = 1 / 4  # of the views
WEIGHT = 1 / 25  # of a view that is looked at: the mean is of the last 100 views or so
MAX_SEEN_SHARE = 1 / 3  # above it nothing is changed
# Iterations after which a share counts, whatever a device has done by then: two runs are the same,
# and so are two ranks. By then it has nearly always come.
LAG = 2
MIN_SEEN_SHARE = 0.01  # a view counts as seeing at least so much


@dataclass(frozen=True, repr=False)
class OutOfView(Part):
    """Hold the scales and opacities of points out of view, which regularisers would destroy.

    3DGS-MCMC's regularisers pull on the scale and the opacity of every point in every iteration,
    and Adam takes a full step however small a gradient is. Relocation and `Fading` empty second
    moments, so a point out of view then shrinks and fades until a view sees it again. Where views
    see a few percent of the points, most points are dead by then.

    This part keeps s, the mean share of the points that a view sees, over the last 100 views, of
    which it looks at one in four. While s is below a third, the second moment of a point out of
    view is raised to at least (gradient / (3 s))^2, so its steps are at most about 3 s times a full
    step. Above a third nothing is changed, bit for bit.

    A point is out of view where the gradient of its position is zero. Points whose position has
    never had a gradient, as frozen ones, do not count in s. The positions' gradient must be there
    at the first step of an iteration, as in every known trainer.
    """

    names = ("means", "scales", "opacities")
    later = ("hold",)

    def plan(self, step: Step, training: Training) -> None:
        """Find points out of view by `means.grad`; hold the other names' second moments."""
        seen = training.unsaved.get((OutOfView, step.set))
        if seen is None:
            seen = _Seen(f"share {step.set}".rstrip(), training.notes_of(self))
            training.unsaved[OutOfView, step.set] = seen
        if seen.iteration != step.iteration:
            seen.look(step, training)
        if seen.rows is not None and step.name != "means" and len(seen.rows) == len(step.param):
            step.hold = Hold(seen.rows, MAX_SEEN_SHARE / seen.notes[seen.note])

    def read_back(self, training: Training) -> None:
        """Have a share that is on its way in the notes."""
        for place, seen in training.unsaved.items():
            if place[0] is OutOfView:
                seen.arrive()

    def numbers(self, training: Training) -> Mapping[str, float]:
        """`visible_share`: the mean share of the points that a view sees, the least of all sets."""
        notes = training.notes_of(self)
        return {"visible_share": min((notes[k] for k in notes if k.startswith("share")), default=1)}


class _Seen:
    """What was found of a set of Gaussians.

    Attributes:
        notes: of the part, with the mean share of this set under the name `note`, and the share of
            a view that was looked at, with the iteration that takes it into the mean.
        iteration: in which it was looked at last; None: not yet.
        rows: [N] bool, out of view; None where views see enough.
        counter: [1] int64, 2^32 for each point in view and 1 for each that is or was, of all looks.
        counted: the counter before the look whose `reading` is on its way to the host.
    """

    def __init__(self, note: str, notes: dict[str, Any]) -> None:
        self.note, self.notes, self.due = note, notes, f"due of {note}"
        if f"view's {note}" not in notes:
            notes.pop(self.due, None)  # it was on its way before a load
        self.iteration: int | None = None
        self.rows: Tensor | None = None
        self.counter: Tensor | None = None
        self.reading: Reading | None = None
        self._mask: Tensor | None = None

    def look(self, step: Step, training: Training) -> None:
        """Look at the positions' gradient of this iteration."""
        self.iteration, self.rows = step.iteration, None
        if step.iteration >= self.notes.get(self.due, math.inf):
            self.take()
        means = training.param_of(step.set, "means")
        grad = None if means is None else means.grad
        # Multiples of the golden ratio keep step with no order of views, as of a rig of cameras.
        is_due = step.iteration * GOLDEN_RATIO % 1.0 < SHARE_LOOKED_AT
        looks = is_due and self.due not in self.notes
        holds = self.notes.setdefault(self.note, 1.0) < MAX_SEEN_SHARE
        if grad is None or not len(grad) or not (looks or holds):
            return
        state = training.state_of_param(step.set, "means") if looks else None
        counter = self._counter(grad.device) if looks else None
        if holds:
            self.rows = self._rows(grad)
        second = None if state is None else state["exp_avg_sq"]
        if second is not None and (
            second.shape != grad.shape or second.device != grad.device or not second.is_contiguous()
        ):
            second = None  # of other rows, or elsewhere, which the step refuses
        look = triton.look if triton.looks(grad) else look_at_positions
        look(grad, second, self.rows, counter)
        if counter is not None:
            self.reading = Reading(counter)
            self.reading.ask()
            self.notes[self.due] = step.iteration + LAG

    def arrive(self) -> None:
        """Have the share of the view that was looked at last in the notes."""
        counted = None if self.reading is None else self.reading.take(wait=True)
        if counted is None:
            return
        self.reading, new = None, (counted[0] - self.counted) % 2**64
        self.counted = counted[0]
        self.notes[f"view's {self.note}"] = (new >> 32) / max(new % 2**32, 1)

    def take(self) -> None:
        """Take the share of a view into the mean."""
        self.arrive()
        del self.notes[self.due]
        share = self.notes.pop(f"view's {self.note}", 0)
        if share > 0:  # a gradient that is zero everywhere is of no view
            mean = self.notes.setdefault(self.note, 1.0)  # a load has none before its first look
            self.notes[self.note] = mean + WEIGHT * (max(share, MIN_SEEN_SHARE) - mean)

    def _counter(self, device: torch.device) -> Tensor:
        if self.counter is None or self.counter.device != device:
            self.counter, self.counted = torch.zeros(1, dtype=torch.int64, device=device), 0
        return self.counter

    def _rows(self, grad: Tensor) -> Tensor:
        if self._mask is None or self._mask.device != grad.device or len(self._mask) != len(grad):
            self._mask = torch.empty(len(grad), dtype=torch.bool, device=grad.device)
        return self._mask


def look_at_positions(
    grad: Tensor, exp_avg_sq: Tensor | None, out_of_view: Tensor | None, counter: Tensor | None
) -> None:
    """`opt3dgs_optim.triton.look` in plain torch."""
    in_view = (grad != 0).any(1)
    if out_of_view is not None:
        torch.logical_not(in_view, out=out_of_view)
    if counter is not None:
        known = in_view if exp_avg_sq is None else in_view | (exp_avg_sq != 0).any(1)
        counter.add_(in_view.sum() * 2**32 + known.sum())
