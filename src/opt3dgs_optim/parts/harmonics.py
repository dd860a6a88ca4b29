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
    fewer they have not grown to their size. So their rate is scaled by 30,000 / total_steps, but by
    4 at most: by 3 in 10,000 iterations. Trainings of 30,000 iterations or more, or of no planned
    end, and colours of degree 0 are unchanged.

    It is for sixty photos or more with relocation, as in 3DGS-MCMC. With clone and split one scene
    gains by it, and one loses. An optimizer cannot see how many photos there are, so it is none of
    the defaults: with twenty or fewer, colours then fit the photos trained on, and no others.

    Examples:
        >>> from opt3dgs_optim import DEFAULTS, Harmonics, PhaseScheduler
        >>> phases = PhaseScheduler(10_000, parts=[*DEFAULTS, Harmonics()])
    """

    names = ("shN",)

    def plan(self, step: Step, training: Training) -> None:
        """Scale the rate."""
        if training.end_step and not training.open_end:
            step.factor *= min(max(PUBLISHED / training.end_step, 1.0), MOST)
