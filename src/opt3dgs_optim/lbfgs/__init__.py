"""The per-point L-BFGS: curvature pairs of every point, and the two-loop recursion on them.

No optimizer is in sight: functions of tensors, points first. On a GPU, points of three coordinates
are the CUDA kernel's, where it can run.
"""

from opt3dgs_optim.lbfgs.history import history_from_pairs, new_history
from opt3dgs_optim.lbfgs.two_loop import lqn_direction, two_loop

__all__ = ["history_from_pairs", "lqn_direction", "new_history", "two_loop"]
