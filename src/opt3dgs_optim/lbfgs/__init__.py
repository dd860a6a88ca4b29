"""The per-point L-BFGS: curvature pairs of every point, and the two-loop recursion on them.

No optimizer is in sight: functions of tensors, points first. On a GPU, points of three coordinates
are the CUDA kernel's, where it can run.
"""

from opt3dgs_optim.lbfgs.foresight import foresight
from opt3dgs_optim.lbfgs.history import (
    MAX_HISTORY,
    history_from_pairs,
    history_shape,
    laid_out,
    new_history,
)
from opt3dgs_optim.lbfgs.two_loop import lqn_direction, two_loop

__all__ = [
    "MAX_HISTORY",
    "foresight",
    "history_from_pairs",
    "history_shape",
    "laid_out",
    "lqn_direction",
    "new_history",
    "two_loop",
]
