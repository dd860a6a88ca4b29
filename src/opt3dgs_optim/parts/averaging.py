"""Averaging: a training ends at the mean of its last iterates."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from opt3dgs_optim.course import Course
from opt3dgs_optim.part import Group, Part
from opt3dgs_optim.rows import shaped

MEAN, COUNT = "mean_iterate", "num_averaged"  # of a row, and of how many of its iterates


@dataclass(frozen=True, repr=False)
class Averaging(Part):
    """Put the mean of the last iterates in the place of the last one (Polyak and Juditsky 1992).

    Every step follows one view, so the parameters wander about what fits all of them, the further
    the higher their learning rates; the mean does not. That of the last thirtieth of the run takes
    their place in the last tenth of it, in rows that a mask lets move; what is infinite, as colours
    of gsplat's `--app_opt`, stays, and edited rows begin anew. Until then nothing is changed. It
    takes the parameters' memory once more.
    """

    share: ClassVar[float] = 1 / 30  # of the run

    keys = (MEAN, COUNT)

    @torch.no_grad()
    def after(self, group: Group, param: Tensor, state: dict[str, Any], course: Course) -> None:
        """Take the parameter [N, ..] into its mean; in the last steps put that in its place."""
        left, length = course.total_steps - course.current, self.share * course.total_steps
        if not 0 < left <= length:
            return
        if COUNT not in state:  # from the next step on: this one may yet be taken back
            state[MEAN] = torch.zeros_like(param, dtype=torch.float32)
            state[COUNT] = torch.zeros(param.shape[:1], device=param.device)
            return
        mean, count = state[MEAN], shaped(state[COUNT].add_(course.valid), param)
        mean.lerp_(param.float(), course.valid / count.clamp(min=1.0))
        if left <= max(2, length / 10):  # trainers save before the last step, or do not make it
            param.copy_(torch.where(mean.isfinite() & course.valid, mean, param))
