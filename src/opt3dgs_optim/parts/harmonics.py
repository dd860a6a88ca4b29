"""Harmonics: in short trainings the higher spherical harmonics make longer steps."""

from __future__ import annotations

from dataclasses import dataclass

from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training

SHORTEST, PUBLISHED = 3_000, 30_000  # iterations


@dataclass(frozen=True, repr=False)
class Harmonics(Part):
    """Lengthen the steps of the spherical harmonics of degree 1 and more in short trainings.

    3DGS trainers step them at a twentieth of the rate of degree 0, and for 30,000 iterations. After
    fewer they have not grown to their size. So in T iterations the rate is scaled by 30,000 / T:
    by 3 in 10,000. Trainings of few photos are shorter still, and longer steps make their colours
    fit those photos alone. So the rate is scaled by no more than T / 3,000, and up to 3,000
    iterations and from 30,000 on it is the trainer's. Where no end is planned, T is the present
    iteration. Colours of degree 0 are unchanged.
    """

    names = ("shN",)

    def plan(self, step: Step, training: Training) -> None:
        """Scale the rate."""
        length = training.end_step or step.iteration or 1
        step.factor *= max(1.0, min(PUBLISHED / length, length / SHORTEST))
