"""A constant multiplier: the control that every claim for the flat histogram needs."""

from collections.abc import Mapping
from dataclasses import dataclass

from opt3dgs_optim.checks import check_count, check_number, set_options
from opt3dgs_optim.course import Course
from opt3dgs_optim.part import Group, Part, Phase


@dataclass(frozen=True, repr=False)
class ConstantMultiplier(Part):
    """nu = `value`, whatever the energy: a plain change of all learning rates while exploring.

    Compare with a constant of the same mean (`EnergyHistogram.mean_multiplier`) before crediting
    the histogram: part of any gain may be just a larger step.

    Args:
        value: the multiplier, any finite number.
        warmup: number of energies during which it is 1, as in `EnergyHistogram`, but for those that
            are not finite, which count here.

    Raises:
        ValueError: an option is outside what is allowed.
    """

    value: float
    warmup: int = 0

    during = Phase.EXPLORATION

    def __post_init__(self) -> None:
        set_options(
            self,
            value=check_number("ConstantMultiplier", "value", self.value),
            warmup=check_count("ConstantMultiplier", "warmup", self.warmup, 0),
        )

    def factor(self, group: Group, course: Course) -> float:
        return 1.0 if course.num_observed <= self.warmup else self.value

    def numbers(self, course: Course) -> Mapping[str, float]:
        """`nu`, after the warm-up."""
        return {"nu": self.value} if course.num_observed > self.warmup else {}
