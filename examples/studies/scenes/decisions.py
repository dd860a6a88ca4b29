"""The decision rule: what is in the defaults of `PhaseScheduler`, and why."""

from __future__ import annotations

from dataclasses import dataclass

from studies.scenes.analysis import Gain, Study
from studies.scenes.arms import ALL_ANNEALED, DEFAULTS, POOLED

SHORT, LONG = 3_000, 7_500
# part, or an option of it -> (the arm with it, the arm without it, iterations)
COMPARISONS = {
    "Annealing": (ALL_ANNEALED, "faded", SHORT),
    "Annealing.opacity_peak": (DEFAULTS, ALL_ANNEALED, LONG),
    "Fading": (ALL_ANNEALED, "annealed-8-0.4", SHORT),
    "Pooling": (POOLED, DEFAULTS, LONG),
    "EnergyHistogram": ("awsgld", "constant", SHORT),
    "SquaredLoss": ("l2@1/30", "mcmc", SHORT),
    "FreshMoments": ("l1+reset@1/30", "mcmc", SHORT),
    "Curvature": ("l2+reset+lqn@1/30", "l2+reset@1/30", SHORT),
}


@dataclass(frozen=True)
class Decision:
    """Whether a part is in the defaults."""

    arm: str
    control: str
    iterations: int
    gain: Gain | None  # None: not measured

    @property
    def on(self) -> bool:
        """A part that was not shown to pay is off."""
        return self.gain is not None and self.gain.verdict == "pays"


def decide(study: Study) -> dict[str, Decision]:
    """The decision on every part.

    Annealing and fading are judged against each other alone, fading against the annealing that did
    best by itself, since both lengthen steps; the multiplier against a constant of its mean,
    curvature against the same phase without it. A peak of the opacities' own is judged in longer
    trainings, since what it prevents takes time: points that few views see are relocated.
    """
    return {
        part: Decision(arm, control, count, study.gain(study.settings(count), arm, control))
        for part, (arm, control, count) in COMPARISONS.items()
    }
