"""Averaging: a training ends at the mean of its last iterates."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training

SHARE = 1 / 30  # of a planned training
SHARE_OF_FALL = 1 / 5
ITERATES = 250  # at least are averaged, where there are as many; more gain nothing


@dataclass(frozen=True, repr=False)
class Averaging(Part):
    """Put the mean of the last iterates in the place of the last one (Polyak and Juditsky 1992).

    Every step follows one view, so the parameters wander around what fits all views, further with
    higher learning rates; their mean does not. Averaging covers the last thirtieth of the run, or
    the last fifth of the fall where no end was planned: at least 250 of its iterates, or all if
    there are fewer. In its last tenth, at least the last two iterations, every iterate counts, and
    the mean takes the parameters' place, because trainers save before their last step. Until then
    nothing is changed.

    After an edit of rows the edited parameters' means begin anew: density control should end before
    the averaging. Iterates that are not finite are left out. In the last thirtieth it takes the
    parameters' memory once more, plus nine numbers a Gaussian. With moments of 16 bits the mean's
    numbers have 16 bits, too, except positions. If a GPU has no room for it, there is a warning,
    and the training goes on without.

    Args:
        names: the Gaussian parameters, under gsplat's names; None: every parameter of the upgraded
            optimizers: cameras, exposures, anchors, networks.
    """

    names: tuple[str, ...] | None = GAUSSIAN

    later = ("mean",)

    @staticmethod
    def start(total_steps: int, fall_step: int | None = None) -> int:
        """The first iteration that is averaged."""
        return _window(total_steps, fall_step)[0]

    @staticmethod
    def put_from(total_steps: int, fall_step: int | None = None) -> int:
        """The first iteration after which the mean is in the parameters' place."""
        return _window(total_steps, fall_step)[1]

    def begins(self, training: Training) -> int:
        """The first iteration that is averaged, where it is known beforehand."""
        total = training.end_step
        return 0 if training.open_end or total is None else self.start(total)

    def plan(self, step: Step, training: Training) -> None:
        """Take the iterate into the mean."""
        total, now = training.end_step, step.iteration
        if total is None or training.finished:
            return
        start, put, every = _window(total, training.fall_step)
        if start <= now < total:
            step.put, step.every = now >= put, every


@functools.lru_cache(maxsize=8)  # every step asks
def _window(total_steps: int, fall_step: int | None) -> tuple[int, int, int]:
    """The first iteration that is averaged, the first after which the mean is put, and `every`."""
    if fall_step is None:
        length = math.floor(SHARE * total_steps)
    else:
        length = math.floor(SHARE_OF_FALL * (total_steps - fall_step))
    # A short run puts the mean where it begins, or has none.
    put = total_steps - min(length, max(2, math.floor(length / 10)))
    return total_steps - length, put, max(1, length // ITERATES)
