"""The decision rule: what is in the defaults of `PhaseScheduler`, and why."""

from __future__ import annotations

from dataclasses import dataclass

from study.analysis import Gain, Study

ITERATIONS = 3_000
# part -> (the arm with it, the arm without it)
COMPARISONS = {
    "annealing": ("annealed-4-0.4+faded", "faded"),
    "fading": ("annealed-4-0.4+faded", "annealed-8-0.4"),
    "multiplier": ("awsgld", "constant"),
    "squared_loss": ("l2@1/30", "mcmc"),
    "reset_moments": ("l1+reset@1/30", "mcmc"),
    "curvature": ("l2+reset+lqn@1/30", "l2+reset@1/30"),
}


@dataclass(frozen=True)
class Decision:
    """Whether a part is in the defaults."""

    arm: str
    control: str
    gain: Gain | None  # None: not measured

    @property
    def on(self) -> bool:
        """A part that was not shown to pay is off."""
        return self.gain is not None and self.gain.verdict == "pays"


def decide(study: Study) -> dict[str, Decision]:
    """The decision on every part.

    Annealing and fading are judged against each other alone, fading against the annealing that did
    best by itself, since both lengthen steps; the multiplier against a constant of its mean,
    curvature against the same phase without it.
    """
    settings = study.settings(ITERATIONS)
    return {
        part: Decision(arm, control, study.gain(settings, arm, control))
        for part, (arm, control) in COMPARISONS.items()
    }
