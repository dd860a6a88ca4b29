"""The decision rule: what is in the defaults of `PhaseScheduler`, and why."""

from __future__ import annotations

from dataclasses import dataclass

from study.analysis import Gain, Study
from study.study_arm import ALL_ANNEALED, DEFAULTS, POOLED

SHORT, LONG = 3_000, 7_500
# part, or an option of it -> (the arm with it, the arm without it, iterations)
COMPARISONS = {
    "annealing": (ALL_ANNEALED, "faded", SHORT),
    "annealing.opacity_peak": (DEFAULTS, ALL_ANNEALED, LONG),
    "fading": (ALL_ANNEALED, "annealed-8-0.4", SHORT),
    "pooling": (POOLED, DEFAULTS, LONG),
    "multiplier": ("awsgld", "constant", SHORT),
    "squared_loss": ("l2@1/30", "mcmc", SHORT),
    "reset_moments": ("l1+reset@1/30", "mcmc", SHORT),
    "curvature": ("l2+reset+lqn@1/30", "l2+reset@1/30", SHORT),
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
