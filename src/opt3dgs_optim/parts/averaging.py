"""Averaging: a training ends at the mean of its last iterates."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor

from opt3dgs_optim.course import Course
from opt3dgs_optim.names import gaussian_of
from opt3dgs_optim.part import Group, Kept, Part, State, Window
from opt3dgs_optim.state import broadcast_rows, is_finite_sum

# What it publishes from step to step: the last three iterations in which a parameter was stepped.
STEPPED = "stepped in"


@dataclass(frozen=True, repr=False)
class Averaging(Part):
    """Put the mean of the last iterates in the place of the last one (Polyak and Juditsky 1992).

    Every step follows one view, so the parameters wander about what fits all of them, the further
    the higher their learning rates; their mean does not. Averaging covers the last thirtieth of the
    run. In the last tenth of that the mean takes the parameters' place, because trainers save
    before their last step. Until then nothing is changed. The last two steps of a parameter are
    always among these, also where few are averaged: some trainers count images, a batch of them
    per step, and some step a parameter in every 16th iteration only.

    With masked steps every row has the mean of its own iterates, and takes it in a step that moves
    it. Rows that density control edits begin anew. Numbers that are not finite are left alone, such
    as the colours of gsplat's `--app_opt`, which are logits.

    It takes the memory of the parameters once more, in the last thirtieth.
    """

    share: ClassVar[float] = 1 / 30  # of the run

    keeps = (Kept("mean"), Kept("count", shape=(), allowed=(0.0, math.inf)))

    def window(self, course: Course) -> Window:
        """The last thirtieth of the run, in which iterates are averaged."""
        return course.total_steps - math.floor(self.share * course.total_steps), course.total_steps

    @torch.no_grad()
    def after(self, group: Group, param: Tensor, state: State, course: Course) -> None:
        """Take the parameter [N, ..] into its mean; in the last steps put that in its place."""
        start, end = self.window(course)
        count, mean = state["count"].add_(1.0), state["mean"]
        whole = param.is_cpu and is_finite_sum(param)  # a GPU would have to be waited for
        iterate = param if whole else torch.where(param.isfinite(), param, 0.0)
        weight = 1.0 / broadcast_rows(count, param)
        mean.lerp_(iterate.to(mean.dtype), weight.to(mean.dtype))
        # Trainers save before the last step, or do not make it.
        last_two = 2 * _stride(group, param, course)
        if end - course.current <= max(last_two, (end - start) / 10):
            # .data: no write that a part should notice by the version counter.
            param.data.copy_(mean if whole else torch.where(param.isfinite(), mean, param))


def _stride(group: Group, param: Tensor, course: Course) -> int:
    """The iterations from one step of a parameter to the next; 1 before its second.

    The shorter one of the last two times: a parameter that had no gradient for long, or a
    checkpoint of a later iteration, makes one of them longer. Iterations that the clock has been
    set back over are forgotten.
    """
    name, now = f"{STEPPED} {gaussian_of(group)}", course.current
    before = course.published(name, param, earlier=True) or ()
    stepped = (*(each for each in before if each < now), now)[-3:]
    course.publish(name, param, stepped)
    return min((later - earlier for earlier, later in pairwise(stepped)), default=1)
