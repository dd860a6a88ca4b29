"""What an arm of the study is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from splatting.arms import ALL_OFF, Arm, MakeScheduler
from splatting.scenes import Scene

from opt3dgs_optim import Annealing, Fading, PhaseScheduler

BASELINE = "mcmc"
ALL_ANNEALED = "annealed-4-0.4+faded"
DEFAULTS = "annealed-4-opacities-1+faded"  # what `PhaseScheduler(total_steps)` is
POOLED = f"{DEFAULTS}+pooled"
UNFADED_OPACITIES = f"{DEFAULTS}-opacities-unfaded"
# As measured, so that a change of the package's defaults does not change what an arm was.
DEFAULT_ANNEALING = Annealing(4.0, 0.4, opacity_peak=1.0)
DEFAULT_PARTS: dict[str, Any] = {"annealing": DEFAULT_ANNEALING, "fading": Fading()}
# (scene, iterations, mean nu of the arm in `needs`) -> the options that differ from ALL_OFF
Options = Callable[[Scene, int, float | None], dict[str, Any]]


@dataclass(frozen=True)
class StudyArm:
    """One way of training, as options of `PhaseScheduler` and of the trainer around it."""

    name: str
    what: str
    control: str  # the arm that a gain is measured against
    options: Options | None = None  # None: torch's own Adam in the trainer
    switch: float = 1.0  # where exploitation starts
    trunk: str | None = None  # branch off this arm's run at the switch
    needs: str | None = None  # the arm whose mean nu it takes
    host: dict[str, Any] = field(default_factory=dict)  # what `StudyFit` does differently
    preset: MakeScheduler | None = None  # makes the scheduler, where no options say it

    def arm(self, scene: Scene) -> Arm:
        """The arm as the examples' trainer takes it."""
        if self.options is None:
            return Arm(self.name, self.what)
        options = self.options

        # The switch is the arm's own, so that a trunk and its branches share their `FitOptions`.
        def make(iterations: int, _switch: float, nu: float | None) -> PhaseScheduler:
            if self.preset is not None:
                return self.preset(iterations, self.switch, nu)
            changed = ALL_OFF | options(scene, iterations, nu)
            return PhaseScheduler(iterations, self.switch, **changed)

        return Arm(self.name, self.what, make=make, needs=self.needs)


def label(arm: str) -> str:
    """An arm's name in tables and plots, where the defaults' is long."""
    return arm.replace(DEFAULTS, "defaults")


def fixed(**options: Any) -> Options:
    """These options, whatever the scene."""
    return lambda _scene, _iterations, _nu: options


def anneal_all(peak: float, final: float = 0.4) -> Annealing:
    """All parameters, the opacities too."""
    return Annealing(peak, final, opacity_peak=peak)
