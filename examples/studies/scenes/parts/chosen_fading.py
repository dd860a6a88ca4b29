"""Fading of points that Adam's moments choose."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from opt3dgs_optim import Course, Fading, Part
from opt3dgs_optim.part import Group


class ChosenFading(Part):
    """`Fading` whose points the moments choose, parameter by parameter.

    A point is stale where its gradients have shrunk: exp_avg^2 is then small beside exp_avg_sq,
    both summed over its coordinates. `"stale"` fades the share of the points in which it is
    smallest, `"fresh"` that in which it is largest.
    """

    def __init__(self, choice: Literal["stale", "fresh"]) -> None:
        self.choice = choice
        self.random = Fading()  # whose numbers these are

    def __repr__(self) -> str:
        return f"ChosenFading({self.choice!r})"

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: dict[str, Any], course: Course
    ) -> Tensor:
        """Fade the chosen points where this iteration has an event."""
        now, fading = course.iteration, self.random
        before, after = (fading.events_before(i, course.total_steps) for i in (now - 1, now))
        for _ in range(before, after):
            rows = chosen_rows(state, fading.share, stale=self.choice == "stale")
            state["exp_avg"][rows] *= fading.exp_avg
            state["exp_avg_sq"][rows] *= fading.exp_avg_sq
        return grad


def chosen_rows(moments: dict[str, Tensor], share: float, stale: bool) -> Tensor:
    """Indices of the share of the rows [N, ..] whose exp_avg^2 / exp_avg_sq is most extreme.

    Rows without a gradient so far are not among them.
    """
    num_points = len(moments["exp_avg"])
    first = moments["exp_avg"].double().square().reshape(num_points, -1).sum(1)
    second = moments["exp_avg_sq"].double().reshape(num_points, -1).sum(1)
    known = torch.nonzero(second > 0).squeeze(1)
    ratio = first[known] / second[known]
    count = min(round(share * num_points), len(known))
    return known[torch.topk(ratio, count, largest=not stale).indices]
