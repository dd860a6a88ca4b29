"""What changes at the switch besides the positions' direction: the loss, and Adam's moments."""

from dataclasses import dataclass

from torch import Tensor

from opt3dgs_optim.checks import check_count
from opt3dgs_optim.course import Course
from opt3dgs_optim.part import Group, Part, Phase, State
from opt3dgs_optim.state import MOMENTS


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

    def __post_init__(self) -> None:
        check_count("FreshMoments", "settling", self.settling, 0)

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """Zero the moments in the parameter's first step after the switch."""
        left = course.total_steps - course.switch_step
        last = getattr(state, "last_step", None)
        if (last is None or last < course.switch_step) and left >= self.settling:
            for key in ("step", *MOMENTS):
                if key in state:
                    state[key].zero_()
        return grad
