"""Points out of view: where views see little of a scene, regularisers make no full steps."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor

from opt3dgs_optim.course import Course
from opt3dgs_optim.names import gaussian_of
from opt3dgs_optim.part import Group, Kept, Part, State
from opt3dgs_optim.state import broadcast_rows

OUT_OF_VIEW, SEEN_SHARE = "out_of_view", "seen_share"  # what it publishes, and keeps
SHARE_LOOKED_AT = 1 / 4  # of the views
GOLDEN_RATIO = (5**0.5 - 1) / 2
WEIGHT = 1 / 25  # of a view that is looked at: the mean is of the last 100 views or so
MAX_POINTS_LOOKED_AT = 2_048  # of each view, for the mean share over many
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

    A point is out of view where the gradient of its position is zero. A gradient that is zero
    everywhere is of no view, and does not count in the mean. The positions may be stepped before or
    after the scales and opacities; where the trainer clears their gradient first, they must be
    stepped first, as in every known trainer. It costs no memory.
    """

    names = ("means", "scales", "opacities")
    keeps = (Kept(SEEN_SHARE, per="parameter", initial=1.0, allowed=(0.0, 1.0)),)

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """See at the positions [N, ..] who is out of view; raise the others' second moments."""
        if grad.dim() == 0 or grad.shape[0] == 0:
            return grad
        if gaussian_of(group) == "means":
            # Not of what Adam is fed: that is zero where a step turns out not to count, which the
            # other parameters' steps may do.
            own = cast(Tensor, param.grad)
            share: Any = _mean_share(own, state[SEEN_SHARE], course.iteration)
            course.publish(SEEN_SHARE, param, share)
            if not isinstance(share, float) or share < MAX_SEEN_SHARE:
                course.publish(OUT_OF_VIEW, param, ~_has_gradient(own))
            return grad
        share = course.published(SEEN_SHARE, param)
        positions: Tensor | None = None  # their gradient, where they come later
        if share is None:  # the positions come later in this iteration
            means = course.gaussians_of(param).get("means")
            if means is None or means.grad is None:
                return grad
            kept = course.number_kept(self, SEEN_SHARE, means)
            kept = torch.ones((), device=means.device) if kept is None else kept
            positions = means.grad
            share = _mean_share(positions, kept.clone(), course.iteration)
        if isinstance(share, float) and share >= MAX_SEEN_SHARE:
            return grad
        if positions is None:
            unseen = course.published(OUT_OF_VIEW, param)
        else:
            unseen = ~_has_gradient(positions)
        if unseen is None or unseen.shape != grad.shape[:1]:
            return grad
        factor = MAX_SEEN_SHARE / share * (share < MAX_SEEN_SHARE)
        if isinstance(factor, Tensor):
            factor = factor.to(grad.device)
        least = torch.where(broadcast_rows(unseen.to(grad.device), grad), grad * factor, 0.0)
        second = state.peek("exp_avg_sq")
        second.copy_(torch.maximum(second, least.square_()))
        return grad

    def numbers(self, course: Course) -> Mapping[str, float | Tensor]:
        """`visible_share`: the mean share of the points that a view sees."""
        share = course.last_published(SEEN_SHARE)
        return {"visible_share": 1.0 if share is None else share}


def _is_looked_at(view: int) -> bool:
    """Whether the view of an iteration counts in the mean share: one in four.

    Multiples of the golden ratio keep step with no order of views, as that of a rig of four
    cameras.
    """
    return view * GOLDEN_RATIO % 1.0 < SHARE_LOOKED_AT


def _mean_share(grad: Tensor, kept: Tensor, view: int) -> float | Tensor:
    """Take the share of the points that a view sees into the mean share `kept`, 0-d, in place.

    Not of each view, because that takes a GPU nine launches and a CPU a tenth of a millisecond.
    A gradient [N, ..] that is zero everywhere, as that of frozen positions, is of no view.

    Returns:
        The mean share: a number on a CPU. A GPU's is not read.
    """
    if not _is_looked_at(view):
        return kept.item() if grad.is_cpu else kept
    seen = _has_gradient(grad[:: 1 + grad.shape[0] // MAX_POINTS_LOOKED_AT])
    if not grad.is_cpu:
        # Not `mean`, which takes twice as long.
        share = seen.sum(dtype=torch.float32).div_(seen.shape[0])
        of_a_view = share > 0
        share = share.clamp_(min=MIN_SEEN_SHARE).to(kept)
        return kept.copy_(torch.where(of_a_view.to(kept.device), kept.lerp(share, WEIGHT), kept))
    # Numbers of Python's: each small operator would take as long as the sum does.
    before, count = kept.item(), torch.count_nonzero(seen).item()
    share = max(count / seen.shape[0], MIN_SEEN_SHARE)
    if count == 0 or share == before:
        return before
    mean = before + WEIGHT * (share - before)
    kept.fill_(mean)
    return mean


def _has_gradient(grad: Tensor) -> Tensor:
    """Which points have a gradient, [N] bool."""
    return (grad if grad.dim() == 2 else grad.reshape(grad.shape[0], -1)).any(1)
