"""Harmonics: in short trainings the higher spherical harmonics make longer steps."""

from __future__ import annotations

from dataclasses import dataclass

from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training

PUBLISHED = 30_000  # iterations, for which 3DGS's rates are
MOST = 4.0


@dataclass(frozen=True, repr=False)
class Harmonics(Part):
    """Lengthen the steps of the spherical harmonics of degree 1 and more in short trainings.

    3DGS trainers step them at a twentieth of the rate of degree 0, and for 30,000 iterations. After
    fewer they have not grown to their size. So the rate is scaled by 30,000 / total_steps, by no
    less than 1 and no more than 4; where no end is planned, by 30,000 / iteration. Colours of
    degree 0, and trainings of 30,000 iterations or more, are unchanged.
    """

    names = ("shN",)

    def plan(self, step: Step, training: Training) -> None:
        """Scale the rate."""
        length = training.end_step or step.iteration or 1
        step.factor *= min(max(PUBLISHED / length, 1.0), MOST)
