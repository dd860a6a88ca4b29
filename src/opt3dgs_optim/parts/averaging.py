"""Averaging: a training ends at the mean of its last iterates."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_number
from opt3dgs_optim.course import Course
from opt3dgs_optim.part import Group, Part
from opt3dgs_optim.rows import shaped

MEAN, COUNT = "mean_iterate", "num_averaged"  # of a row, and of how many of its iterates
LAST = 2  # steps that end at the mean: trainers save before the last one, or do not make it


@dataclass(frozen=True, repr=False)
class Averaging(Part):
    """Put the mean of the last iterates in the place of the last one (Polyak and Juditsky 1992).

    Every step follows one view, so the parameters wander about what fits all of them, the further
    the higher their learning rates; the mean does not (for networks: Izmailov et al., UAI 2018).
    It takes their place in the run's last two steps; until then nothing is changed. Where density
    control edits rows meanwhile, the mean begins anew; rows that a mask holds back in the last two
    steps keep what they have. While it is taken, it costs the parameters' memory once more.

    Args:
        share: of the run whose iterates are averaged, in (0, 1].

    Raises:
        ValueError: the share is outside what is allowed.
    """

    share: float = 1 / 30

    keys = (MEAN, COUNT)

    def __post_init__(self) -> None:
        check_number("Averaging", "share", self.share, 0.0, 1.0, open_low=True)

    @torch.no_grad()
    def after(self, group: Group, param: Tensor, state: dict[str, Any], course: Course) -> None:
        """Take the parameter [N, ..] into its mean; in the last steps put that in its place."""
        left = course.total_steps - course.current
        if not 0 < left <= self.share * course.total_steps:
            return
        if COUNT not in state:  # from the next step on: this one may yet be taken back
            state[MEAN] = torch.zeros_like(param, dtype=torch.float32)
            state[COUNT] = torch.zeros(param.shape[:1], device=param.device)
            return
        mean, count = state[MEAN], state[COUNT].add_(course.valid)
        mean += (param - mean) * (course.valid / shaped(count.clamp(min=1.0), mean))
        if left <= LAST:
            param.copy_(torch.where(shaped(count > 0, mean) & course.valid, mean, param))
