"""Annealing: all learning rates start above the trainer's own and end below them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from opt3dgs_optim.checks import check_number
from opt3dgs_optim.course import Course
from opt3dgs_optim.names import GAUSSIAN_NAMES, canonical_name, slot
from opt3dgs_optim.part import Group, Part

CALL = "Annealing"


@dataclass(frozen=True, repr=False)
class Annealing(Part):
    """Multiply the step of every Gaussian parameter by a factor that falls geometrically.

        factor(t) = peak^(1 - t) * final^t,    t = iteration / total_steps in 0..1

    3DGS lets the positions' learning rate decay to 1 % and keeps the others constant: too small
    to get far in the first iterations, too large to settle in the last. The factor comes on top
    of the trainer's own schedule; the learning rates in `param_groups`, which 3DGS-MCMC's noise is
    proportional to, stay as they are. It costs no memory.

    The opacities have a peak of their own. 3DGS-MCMC's regularisers pull at every point, and Adam
    makes a full step of that where a view does not reach: at four times the rate, points which few
    views see are transparent and relocated within a hundred iterations, and a scene with few views
    is over-fitted.

    Args:
        peak: factor at the first iteration, above 0: a number for all parameters but the
            opacities, or a dict by parameter (gsplat's or INRIA's names; those left out are not
            annealed).
        final: factor at the last iteration, above 0.
        opacity_peak: `peak` of the opacities, where that is a number.

    Raises:
        ValueError: an option is outside what is allowed.
    """

    peak: float | Mapping[str, float] = 4.0
    final: float = 0.4
    opacity_peak: float = 1.0

    def __post_init__(self) -> None:
        check_number(CALL, "final", self.final, 0.0, open_low=True)
        check_number(CALL, "opacity_peak", self.opacity_peak, 0.0, open_low=True)
        if not isinstance(self.peak, Mapping):
            check_number(CALL, "peak", self.peak, 0.0, open_low=True)
            return
        peaks: dict[str, float] = {}
        for name, value in self.peak.items():
            known = canonical_name(name)
            if known is None:
                raise ValueError(
                    f"{CALL}: peak has {name!r}, which is no Gaussian parameter's name; allowed "
                    f"are {', '.join(GAUSSIAN_NAMES)}"
                )
            peaks[known] = check_number(CALL, f"peak[{name!r}]", value, 0.0, open_low=True)
        object.__setattr__(self, "peak", peaks)
        object.__setattr__(self, "names", tuple(peaks))

    def at(self, name: str | None, progress: float) -> float:
        """The factor on a parameter's step.

        Args:
            name: its name, gsplat's or INRIA's; 1 where it is no Gaussian parameter.
            progress: share of the run that is over; taken as 0..1.
        """
        known = canonical_name(name)
        if isinstance(self.peak, Mapping):
            peak = self.peak.get(known or "")
        else:
            peak = self.opacity_peak if known == "opacities" else self.peak
        if known is None or peak is None:
            return 1.0
        t = min(max(progress, 0.0), 1.0)
        return peak ** (1.0 - t) * self.final**t

    def factor(self, group: Group, course: Course) -> float:
        """The factor on the group's next step."""
        return self.at(slot(group), course.progress)

    def numbers(self, course: Course) -> Mapping[str, float]:
        """`annealing`: the factor on the steps of the positions, or of the first parameter."""
        first = next(iter(self.peak)) if isinstance(self.peak, Mapping) else "means"
        return {"annealing": self.at(first, course.progress)}
