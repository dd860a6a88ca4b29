"""What changes at the switch besides the positions' direction: the loss, and Adam's moments."""

from dataclasses import dataclass

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_count, set_options
from opt3dgs_optim.course import Course
from opt3dgs_optim.names import ADAM_KEYS
from opt3dgs_optim.part import Group, Kept, Part, Phase, State

# Iterations after the switch in which moments may still be restarted, where steps did not count.
MAX_LATE_ITERATIONS = 10


class SquaredLoss(Part):
    """The photometric term is mean error^2 while exploiting, instead of mean |error|.

    Opt3DGS, "Exploitation": L1 becomes L2 in the last 1,000 of 30,000 iterations.
    """

    during = Phase.EXPLOITATION

    def pixel_loss(self, error: Tensor) -> Tensor:
        """Mean squared error, 0-d."""
        return error.square().mean()


@dataclass(frozen=True, repr=False)
class FreshMoments(Part):
    """Adam's moments of the Gaussian parameters start anew at the switch.

    Loss and direction change scale there, and second moments of the old gradients would hold the
    steps back for a thousand iterations.

    Args:
        settling: iterations that must be left for the moments to settle, or nothing is done: a
            restarted second moment is that of a few views, and its first steps are long.

    Raises:
        ValueError: `settling` is no whole number from 0 on.
    """

    settling: int = 0

    during = Phase.EXPLOITATION
    keeps = (Kept("fresh", per="parameter"),)

    def __post_init__(self) -> None:
        settling = check_count("FreshMoments", "settling", self.settling, 0)
        set_options(self, settling=settling)

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """Zero the moments in the parameter's first step after the switch that counts."""
        left = course.total_steps - course.switch_step
        late = course.switch_step + MAX_LATE_ITERATIONS
        if left < self.settling or (state.last_step or 0) >= late:
            return grad
        last, step = state.last_step, state["step"]
        if last is None and step.item() <= course.current - course.switch_step:
            return grad  # moments of a checkpoint, which begin at the switch already
        fresh: Tensor = state["fresh"]
        if step.is_cpu:  # steps that count are known to the host on these paths of torch
            first = last is None or last < course.switch_step
            # It is 0 again after a step that turned out not to count; a device is not waited for.
            if first or (fresh.is_cpu and fresh.item() == 0):
                for key in [key for key in ADAM_KEYS if key in state]:
                    state[key].zero_()
                fresh.fill_(1.0)
            return grad
        for key in [key for key in ADAM_KEYS if key in state]:
            moment = state[key]
            moment.copy_(torch.where(fresh == 0, 0.0, moment))
        fresh.fill_(1.0)
        return grad
