"""Annealing: learning rates start above the trainer's own and end below them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from opt3dgs_optim.checks import check_number, set_options
from opt3dgs_optim.names import GAUSSIAN, canonical_name, check_names
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training

CALL = "Annealing"
ANNEALED = tuple(name for name in GAUSSIAN if name != "means")


@dataclass(frozen=True, repr=False)
class Annealing(Part):
    """Multiply the steps of shapes, opacities and colours by a factor that falls geometrically.

        factor(t) = peak^(1 - t) * final^t,    t = iteration / total_steps in 0..1

    3DGS keeps all learning rates but the positions' constant: too small to get far in the first
    iterations, too large to settle in the last. The factor comes on top of the trainer's own
    schedule; the learning rates in `param_groups` stay as they are. It costs no memory.

    The positions are left alone, and the opacities have a peak of their own, since either would
    lose detail at four times its rate (docs/evidence.md).

    Args:
        peak: factor at the first iteration, above 0, of all parameters but the opacities.
        final: factor at the last iteration, above 0.
        opacity_peak: `peak` of the opacities.
        names: the Gaussian parameters, under gsplat's or INRIA's names.

    Raises:
        ValueError: an option is outside what is allowed, or a name is no Gaussian parameter's.
    """

    peak: float = 4.0
    final: float = 0.4
    opacity_peak: float = 1.0
    names: tuple[str, ...] = ANNEALED

    def __post_init__(self) -> None:
        set_options(
            self,
            peak=check_number(CALL, "peak", self.peak, 0.0, open_low=True),
            final=check_number(CALL, "final", self.final, 0.0, open_low=True),
            opacity_peak=check_number(CALL, "opacity_peak", self.opacity_peak, 0.0, open_low=True),
            names=check_names(CALL, self.names),
        )

    def at(self, name: str | None, progress: float) -> float:
        """The factor on a parameter's step.

        Args:
            name: its name, gsplat's or INRIA's; 1 where it is none of those that are annealed.
            progress: share of the run that is over; taken as 0..1.
        """
        known = canonical_name(name)
        if known not in self.names:
            return 1.0
        peak = self.opacity_peak if known == "opacities" else self.peak
        t = min(max(progress, 0.0), 1.0)
        return peak ** (1.0 - t) * self.final**t

    def plan(self, step: Step, training: Training) -> None:
        """Scale the rate."""
        step.factor = step.factor * self.at(step.name, training.progress)

    def numbers(self, training: Training) -> Mapping[str, float]:
        """`annealing`: the factor on the steps of the first of its parameters."""
        return {"annealing": self.at(self.names[0], training.progress)}
