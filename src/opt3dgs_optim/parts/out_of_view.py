"""Points out of view: where views see little of a scene, regularisers make no full steps."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.course import Course
from opt3dgs_optim.names import SLOT
from opt3dgs_optim.part import Group, Part
from opt3dgs_optim.rows import shaped

SHARE = "visible_share"  # of the positions' group: mean share of the points that a view sees
MEMORY, SAMPLE = 100, 16_384  # views of the mean; points of each that are asked
BELOW, LEAST = 1 / 3, 0.01  # where it acts; least of a view


@dataclass(frozen=True, repr=False)
class OutOfView(Part):
    """Keep the scales and opacities of points that few views see from melting.

    3DGS-MCMC's regularisers pull at every point in every iteration, and Adam makes a full step of
    a gradient however small. Relocation and `Fading` empty second moments: a point out of view
    then shrinks and fades until a view sees it, and where views see a tenth of the points, most
    are dead by then. While the mean visible share s of the points is below a third, the second
    moment of one out of view is at least (gradient / (3 s))^2, for steps of at most about 3 s of
    a full one; above, nothing is changed, bit for bit. Out of view is a point whose position's
    gradient is zero; the positions must be stepped first, as in every known trainer. No memory.
    """

    names = ("means", "scales", "opacities")

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: dict[str, Any], course: Course
    ) -> Tensor:
        """See at the positions [N, 3] who is out of view; raise the others' second moments."""
        if grad.dim() == 0 or len(grad) == 0:
            return grad
        if group[SLOT] == "means":
            some, share = grad[:: 1 + len(grad) // SAMPLE], group.get(SHARE, 1.0)
            now: Any = some.any(1).mean(dtype=torch.float32)
            now = max(now.item(), LEAST) if grad.is_cpu else now.clamp(min=LEAST)
            group[SHARE] = share = share + (now - share) * (course.valid / MEMORY)
            off = grad.is_cpu and share >= BELOW  # on a GPU nothing is read
            unseen = None if off else ~grad.any(1) & course.valid
            course.unseen = course.current, unseen, share
            return grad
        iteration, unseen, share = course.unseen
        if unseen is None or iteration != course.current or len(unseen) != len(grad):
            return grad
        factor = BELOW / share * (share < BELOW)
        least = torch.where(shaped(unseen, grad), grad * factor, 0.0).square_()
        state["exp_avg_sq"].copy_(torch.maximum(state["exp_avg_sq"], least))
        return grad

    def numbers(self, course: Course) -> Mapping[str, float | Tensor]:
        """The mean visible share."""
        return {SHARE: course.unseen[2]}
