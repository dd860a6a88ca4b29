"""Points outside the present view keep Adam's normaliser, so that regularisers do not melt them."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim import Course, Part
from opt3dgs_optim.names import SLOT
from opt3dgs_optim.part import Group
from opt3dgs_optim.rows import shaped


class KeepUnseen(Part):
    """Second moments are forgotten more slowly in iterations that do not see the point.

    3DGS-MCMC's regularisers pull at every opacity and scale in every iteration. Where a point is
    out of view, theirs is the whole gradient, and Adam makes a full step of a gradient however
    small as soon as its second moment has forgotten the image's: after a thousand iterations. With
    thousands of views, points shrink and fade between the few that see them. Here the second
    moment's memory is longer by 1 / floor in such iterations: the regulariser gets its own share
    of a step, r / rms(image gradient), and a point that no view ever sees is still relocated.

    A point is out of view where the gradient of its position is exactly zero.

    Args:
        floor: how fast second moments are forgotten out of view, as a share of Adam's own rate.
    """

    names = ("means", "scales", "opacities")

    def __init__(self, floor: float = 0.05) -> None:
        self.floor = floor
        self._unseen = torch.zeros(0, dtype=torch.bool)

    def __repr__(self) -> str:
        return f"KeepUnseen({self.floor:g})"

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: dict[str, Any], course: Course
    ) -> Tensor:
        """See who is in view at the positions, which are stepped first; keep the other moments."""
        if group[SLOT] == "means":
            self._unseen = (grad == 0).all(1)
        elif len(self._unseen) == len(param):
            kept = group["betas"][1] ** (self.floor - 1)
            factor = torch.where(self._unseen, kept, 1.0)
            state["exp_avg_sq"].mul_(shaped(factor, param))
        return grad
