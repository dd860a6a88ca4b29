"""Points out of view: where views see little of a scene, regularisers make no full steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.course import Course, Reading
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Hold, Step

GOLDEN_RATIO = (5**0.5 - 1) / 2
SHARE_LOOKED_AT = 1 / 4  # of the views
WEIGHT = 1 / 25  # of a view that is looked at: the mean is of the last 100 views or so
MAX_SEEN_SHARE = 1 / 3  # above it nothing is changed
MIN_SEEN_SHARE = 0.01  # a view counts as seeing at least so much


@dataclass(frozen=True, repr=False)
class OutOfView(Part):
    """Hold the scales and opacities of points out of view, which regularisers would destroy.

    3DGS-MCMC's regularisers pull at the scale and the opacity of every point in every iteration,
    and Adam makes a full step of a gradient however small it is. Relocation and `Fading` empty
    second moments, so a point out of view then shrinks and fades until a view sees it again. Where
    each view sees a tenth of the points, most of them are dead by then.

    This part keeps the mean share s of the points that a view sees, over the last 100 views, of
    which it looks at one in four. While s is below a third, the second moment of a point out of
    view is raised to at least (gradient / (3 s))^2, so that its steps are at most about 3 s of a
    full one. Above a third nothing is changed, bit for bit.

    A point is out of view where the gradient of its position is zero. Points whose position has
    never had a gradient do not count in s: frozen positions are not out of view. The positions'
    gradient must be there at the first step of an iteration, as in every known trainer.
    """

    names = ("means", "scales", "opacities")

    def plan(self, step: Step, course: Course) -> None:
        """See at the positions [N, 3] who is out of view; hold the others' second moments."""
        notes, place = course.notes_of(self), (self, step.set)
        seen = course.scratch.get(place)
        if seen is None or seen.iteration != step.iteration:
            seen = _looked_at(step, course, notes, seen)
            course.scratch[place] = seen
        if seen.rows is not None and step.name != "means" and len(seen.rows) == len(step.param):
            step.hold = Hold(seen.rows, MAX_SEEN_SHARE / notes["share"])

    def settle(self, course: Course) -> None:
        """Take the share that is on its way."""
        for place, seen in course.scratch.items():
            if place[0] is self and seen.reading is not None:
                if seen.reading.source.is_cuda:
                    torch.cuda.synchronize()
                seen.reading = _taken(seen.reading, course.notes_of(self))

    def numbers(self, course: Course) -> Mapping[str, float]:
        """`visible_share`: the mean share of the points that a view sees."""
        return {"visible_share": course.notes_of(self).get("share", 1.0)}


class _Seen:
    """What was found in an iteration."""

    def __init__(self, iteration: int, rows: Tensor | None, reading: Reading | None) -> None:
        self.iteration = iteration
        self.rows = rows  # [N] bool, out of view; None where views see enough
        self.reading = reading  # [1] the share of a view, on its way to the host


def _looked_at(step: Step, course: Course, notes: dict[str, Any], before: _Seen | None) -> _Seen:
    """Look at the positions' gradient of this iteration."""
    notes.setdefault("share", 1.0)
    reading = None if before is None else _taken(before.reading, notes)
    means = step.param if step.name == "means" else course.param_of(step.set, "means")
    grad = None if means is None else means.grad
    # Multiples of the golden ratio keep step with no order of views, as of a rig of four cameras.
    looks = reading is None and step.iteration * GOLDEN_RATIO % 1.0 < SHARE_LOOKED_AT
    holds = notes["share"] < MAX_SEEN_SHARE
    if grad is None or not len(grad) or not (looks or holds):
        return _Seen(step.iteration, None, reading)
    in_view = (grad != 0).any(1)
    if looks:
        state = course.state_of_param(step.set, "means")
        known = in_view if state is None else in_view | (state["exp_avg_sq"] != 0).any(1)
        reading = Reading((in_view.sum() / known.sum().clamp_(min=1)).reshape(1))
        reading.ask()
    return _Seen(step.iteration, ~in_view if holds else None, reading)


def _taken(reading: Reading | None, notes: dict[str, Any]) -> Reading | None:
    """Take the share of a view into the mean; what is still on its way."""
    share = None if reading is None else reading.take()
    if share is None:
        return reading
    if share > 0:  # a gradient that is zero everywhere is of no view
        notes["share"] += WEIGHT * (max(share, MIN_SEEN_SHARE) - notes["share"])
    return None
