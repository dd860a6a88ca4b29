"""A constant multiplier: the control that every claim for the flat histogram needs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from opt3dgs_optim.checks import check_count, check_number
from opt3dgs_optim.course import Course
from opt3dgs_optim.part import Group, Part, Phase

# Where a constant would do as well: a factor's deviation over so many steps, or share of the run.
WINDOW, WINDOW_SHARE = 300, 1 / 30
EFFECT = 0.1  # relative: learning rates that differ by less are taken as the same


@dataclass(frozen=True, repr=False)
class ConstantMultiplier(Part):
    """nu = `value`, whatever the energy: a plain change of all learning rates while exploring.

    While the loss falls, the flat histogram's nu is above 1 on average; part of any gain is then
    just a larger step. Compare with a constant of the same mean
    (`EnergyHistogram.mean_multiplier`) before crediting the histogram.

    Args:
        value: the multiplier, any finite number.
        warmup: number of energies during which it is 1, as in `EnergyHistogram`.

    Raises:
        ValueError: an option is outside what is allowed.
    """

    value: float
    warmup: int = 0

    during = Phase.EXPLORATION

    def __post_init__(self) -> None:
        check_number("ConstantMultiplier", "value", self.value)
        check_count("ConstantMultiplier", "warmup", self.warmup, 0)

    def factor(self, group: Group, course: Course) -> float:
        """The multiplier of the next step."""
        return 1.0 if course.num_observed <= self.warmup else self.value

    def numbers(self, course: Course) -> Mapping[str, float]:
        """`nu`, after the warm-up."""
        return {"nu": self.value} if course.num_observed > self.warmup else {}


class Constancy:
    """Whether a factor has been nearly constant, and what then takes its place.

    Attributes:
        constant: the part of that size; None where it is 1, or the factor varies.
    """

    def __init__(self) -> None:
        self.constant: ConstantMultiplier | None = None
        self._windows: list[list[float]] = []
        self._verdict: str | None = None
        self._mean: list[float] = []

    def judge(self, name: str, powers: list[float], total_steps: int, ready: bool) -> str | None:
        """Why a constant would do as well, or None; a verdict stays.

        Args:
            name: the factor's.
            powers: sums of its powers 0, 1 and 2 over all steps so far.
            total_steps: of the run.
            ready: whether there may be a verdict now.
        """
        if self._verdict is not None or powers[0] <= 0:
            return self._verdict
        window = max(WINDOW, WINDOW_SHARE * total_steps)
        self._windows.append(powers)
        old = [each for each in self._windows if powers[0] - each[0] >= window]
        if not old:
            return None
        self._windows = self._windows[len(old) - 1 :]
        count, total, squares = (now - then for now, then in zip(powers, old[-1], strict=True))
        mean = total / count
        deviation = math.sqrt(max(squares / count - mean * mean, 0.0))
        if not ready or deviation > EFFECT * abs(mean):
            return None
        self._settle(name, mean)
        assert self._verdict is not None
        self._verdict += f"; its deviation was {deviation:.3f} over {count:.0f} energies"
        return self._verdict

    def _settle(self, name: str, mean: float) -> None:
        # Its mean is a learning rate that this training has been running with: leaving it would be
        # a change of its own. A mean of 0 or less would never come down again.
        near_one = mean <= 0 or abs(mean - 1) <= EFFECT
        self.constant = None if near_one else ConstantMultiplier(mean)
        follow = "off" if near_one else f"a constant {mean:.3g} from now on"
        self._mean = [mean]
        self._verdict = f"{name} was {mean:.3f}: {follow}"

    def state(self) -> list[float]:
        """The mean that was found to be constant, or nothing."""
        return list(self._mean)

    def load(self, name: str, state: list[float]) -> None:
        """Restore `state()`."""
        self.constant, self._verdict, self._mean = None, None, []
        for mean in state:
            self._settle(name, mean)
