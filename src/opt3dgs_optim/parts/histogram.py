"""The flat histogram: the multiplier nu of every step, from the density of the visited energies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from opt3dgs_optim.checks import (
    as_float,
    check_count,
    check_energy,
    check_interval,
    check_keys,
    check_number,
)
from opt3dgs_optim.course import Course
from opt3dgs_optim.part import Part, Phase
from opt3dgs_optim.partitions import FixedPartitions, MovingPartitions, Tally, host_tensor
from opt3dgs_optim.step import Step

# The temperature is not given in the paper; zeta * tau / du = 1.5 at its zeta and du.
PAPER: dict[str, Any] = {"energy_range": (0.0, 0.2), "temperature": 2e-3, "warmup": 2500}
PAPER_CLAMP = (-5.0, 5.0)  # not given in the paper; the only published one of its family
CALL = "EnergyHistogram"
CLAMP = (-1.0, 3.0)  # twice as far from 1 as nu is two deviations out
# Where nu does nothing: so little for so many energies, or for this share of the run.
EFFECT, WINDOW, WINDOW_SHARE = 0.1, 300, 1 / 30
MAX_COUNT = 2**53 - 1  # of energies
TOP_SHARE = 0.5  # of Theta, in the open partition above the range: the loss may yet fall into it


class EnergyHistogram(Part):
    """Steps are longer at energies below the mean, shorter above it: the flat histogram's nu.

        nu = 1 + zeta * tau * dlog Theta / du                                        (eq. 14)

    Theta is the weight of the energy's partition, by how often the training has been there.

    By default the partitions follow the energy's recent mean and deviation: an energy two
    deviations from the mean gets |nu - 1| = 1 at all times, nu's mean is 1 and its deviation 1/2,
    whatever zeta and however far the energy falls. `MovingPartitions` has the formulas. With a
    range and a temperature it is the paper's update, to the letter (`FixedPartitions`);
    `EnergyHistogram.paper()` has its numbers.

    The default is made for trainings. **For sampling** a fixed energy give both `energy_range`,
    from the lowest energy to a little above the barriers that are to be crossed, and `temperature`,
    that of the noise (`IsotropicNoise`), and `warmup=0`. The default helps little: its partitions
    follow the walk, so that the well in which it began looks like all there is. In a double well
    whose barrier is six times the temperature, a walk of 20,000 steps of 0.006 crossed it once
    without a histogram, 5 times with the default, and 39 times with a range and a temperature
    (in a clone: `python tests/test_lqnadam_claims.py`).

    Args:
        num_partitions: number of partitions; None for 48 that follow the energy, 200 of a range.
        energy_range: (low, high) in units of the loss, cut uniformly; the first and the last
            partition are open (eq. 7). `"auto"`: see above.
        zeta: flattening exponent, from 0 to 1. With an automatic temperature it must be neither 0
            nor 1, and cancels.
        temperature: tau, in units of the loss; automatic where the range is, and only there.
        warmup: number of energies during which nu is 1 while Theta is being estimated.
        clamp: (low, high) bounds of nu, or None; `"auto"` is (-1, 3) for partitions that follow
            the energy, where nu seldom leaves 0 to 2, and (-5, 5) for those of a range.

    Raises:
        ValueError: an option is outside what is allowed; in a step, a group has `maximize=True`.
    """

    during = Phase.EXPLORATION
    learns = True

    def __init__(
        self,
        num_partitions: int | None = None,
        energy_range: tuple[float, float] | Literal["auto"] = "auto",
        *,
        zeta: float = 0.75,
        temperature: float | Literal["auto"] = "auto",
        warmup: int = 250,
        clamp: tuple[float, float] | Literal["auto"] | None = "auto",
    ) -> None:
        automatic = _are_automatic(energy_range, temperature)
        fewest = 24 if automatic else 3  # at most half a deviation wide
        wanted = (48 if automatic else 200) if num_partitions is None else num_partitions
        self.num_partitions = check_count(CALL, "num_partitions", wanted, fewest)
        ends = {"open_low": automatic, "open_high": automatic}
        self.zeta = check_number(CALL, "zeta", zeta, 0.0, 1.0, **ends)
        self.warmup = check_count(CALL, "warmup", warmup, 4 if automatic else 0)
        if clamp == "auto":
            clamp = CLAMP if automatic else PAPER_CLAMP
        self.clamp = None if clamp is None else check_interval(CALL, "clamp", clamp)
        self.energy_range, self.temperature = energy_range, temperature
        self._law: FixedPartitions | MovingPartitions
        if automatic:
            self._law = MovingPartitions(self.num_partitions, self.zeta, self.clamp)
        else:
            self.energy_range = check_interval(CALL, "energy_range", energy_range)
            self.temperature = check_number(CALL, "temperature", temperature, 0.0)
            fixed = (self.energy_range, self.zeta, self.temperature, self.clamp)
            self._law = FixedPartitions(self.num_partitions, *fixed)
        self._allocate(torch.device("cpu"))

    @classmethod
    def paper(cls, **overrides: Any) -> EnergyHistogram:
        """The paper's update with its settings: range [0, 0.2], zeta .75, warm-up 2,500.

        The temperature (2e-3), the clamp (-5 to 5) and lambda's schedule are not in the paper.
        """
        return cls(**(PAPER | overrides))

    def _allocate(self, device: torch.device) -> None:
        self._device, self._on_host = device, _is_host(device)
        self._law.allocate(device)
        self.num_observed = 0  # calls of observe(): says whether anybody calls
        self.last_finite: Tensor | bool = True  # whether the last energy was
        # How many of them were finite, and powers 0, 1 and 2 of nu, summed over those after the
        # warm-up: numbers on a CPU, and on a device, which alone knows which are finite, tensors.
        self._taken = 0
        self._sums = [0.0] * 3
        self._tally = None if self._on_host else Tally(self.warmup, self._law.nu)
        self._factor: float | Tensor = 1.0

    @torch.no_grad()
    def observe(  # pyright: ignore[reportIncompatibleMethodOverride]
        self,
        energy: Tensor | float,
        course: Course | None = None,
    ) -> Tensor:
        """Take one energy; return nu, 0-d on its device, of the weights before their update.

        Args:
            energy: the training loss of this iteration, 0-d (or one element; ValueError of more).
                One that is not finite changes nothing. A GPU is not waited for.
            course: the training's, which wants no copy of nu.
        """
        value = self._on_device(energy)
        valid: Tensor | bool = torch.isfinite(value)
        if self._on_host:
            valid = bool(valid)
        self.num_observed += 1
        self.last_finite = valid
        if valid is not False:
            self._take(value, valid)
        return self.multiplier if course is not None else self.multiplier.clone()

    def _take(self, value: Tensor, valid: Tensor | Literal[True]) -> None:
        law = self._law
        if self._tally is not None:
            law.take_on_device(value, valid, self._tally)
            self._factor = law.nu
            return
        self._taken += 1
        law.take(value, True, self._taken)
        if self._taken <= self.warmup:
            law.nu.fill_(1.0)
        self._factor = nu = law.nu.item()
        if self._taken > self.warmup:
            self._sums = [a + b for a, b in zip(self._sums, (1.0, nu, nu * nu), strict=True)]

    def _on_device(self, energy: Tensor | float) -> Tensor:
        value = check_energy(f"{CALL}.observe", "energy", energy, torch.float64)
        if value.device != self._device:  # e.g. resumed from a checkpoint
            self._restore(value.device, self.state_dict())
        return value

    def plan(self, step: Step, course: Course) -> None:
        """Scale the rate by nu: a number where the energies live on a CPU."""
        if self.num_observed:
            step.factor = step.factor * self._factor
        elif step.iteration > 20:
            course.warn_once(
                CALL, f"{CALL}: no energy has come; call phases.observe(loss) before the steps"
            )

    @property
    def multiplier(self) -> Tensor:
        """Nu after the last finite energy, 0-d, on the energies' device."""
        return self._law.nu

    @property
    def weights(self) -> Tensor:
        """Theta, [num_partitions], positive, sum 1 (eq. 9)."""
        return self._law.weights.clone()

    def _moments(self) -> Tensor:
        sums = self._sums if self._tally is None else self._tally.sums
        return torch.as_tensor(sums, dtype=self._law.nu.dtype, device=self._law.nu.device)

    def _num_taken(self) -> int:
        """Number of finite energies. Synchronises."""
        return self._taken if self._tally is None else int(self._tally.count)

    @property
    def mean_multiplier(self) -> Tensor:
        """Mean of nu over all energies after the warm-up (1 before it), 0-d: an honest control."""
        count, total, _ = self._moments()
        return torch.where(count > 0, total / count, 1.0)

    @property
    def multiplier_std(self) -> Tensor:
        """Standard deviation of nu over all energies after the warm-up, 0-d."""
        count, total, squares = self._moments()
        return (squares / count - (total / count) ** 2).nan_to_num(0.0).clamp(min=0).sqrt()

    @property
    def coordinates(self) -> tuple[float, float, float]:
        """Low and high end of the partitions, and tau, now, in units of the loss. Synchronises."""
        return self._law.coordinates()

    def numbers(self, course: Course | None = None) -> dict[str, float | Tensor]:
        """`nu`, after as many energies as the warm-up has; one that is not finite is one here."""
        return {"nu": self._law.nu.clone()} if self.num_observed > self.warmup else {}

    def state_dict(self) -> dict[str, Any]:
        """All that `observe` has learnt, as plain numbers and lists. Synchronises."""
        return {
            "num_observed": self.num_observed,
            "num_taken": self._num_taken(),
            "sums": self._moments().tolist(),
            **self._law.state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`.

        Raises:
            ValueError: it is damaged, or of other partitions; nothing is changed then.
        """
        call = f"{CALL}.load_state_dict"
        here = self.state_dict()
        check_keys(call, state, tuple(here))
        for name, own in here.items():
            saved = state[name]
            rows, length = (saved, len(own)) if isinstance(own, list) else ([saved], 1)
            plain = isinstance(rows, list) and len(rows) == length
            if not plain or not all(math.isfinite(as_float(number)) for number in rows):
                needed = f"num_partitions={self.num_partitions} has {length} finite numbers there"
                raise ValueError(f"{call}: {name}={saved!r}, but a histogram with {needed}")
        observed = check_count(call, "num_observed", state["num_observed"], 0, MAX_COUNT)
        check_count(call, "num_taken", state["num_taken"], 0, observed)
        self._law.check(call, state)
        self._restore(self._device, state)

    def _restore(self, device: torch.device, state: Mapping[str, Any]) -> None:
        self._allocate(device)
        self._law.load(state)
        self.num_observed = int(state["num_observed"])
        if self._tally is None:
            self._taken, self._sums = int(state["num_taken"]), list(state["sums"])
            self._factor = self._law.nu.item()
        else:
            self._tally.count.fill_(int(state["num_taken"]))
            self._tally.sums.copy_(host_tensor(state["sums"]))
            self._factor = self._law.nu

    def __repr__(self) -> str:
        line = f"{CALL}("
        if self.energy_range != "auto":
            line += f"energy_range={self.energy_range!r}, temperature={self.temperature!r}, "
        line += f"zeta={self.zeta:g}, clamp={self.clamp}): nu "
        taken = self._num_taken()
        if taken <= self.warmup:
            return f"{line}1, warm-up: {taken} of {self.warmup} energies"
        mean, deviation = float(self.mean_multiplier), float(self.multiplier_std)
        return f"{line}{float(self.multiplier):.4g}, mean {mean:.4g} +- {deviation:.2g}"


def _is_host(device: torch.device) -> bool:
    """Whether the host knows at once if an energy there is finite."""
    return device.type == "cpu"


def _are_automatic(energy_range: Any, temperature: Any) -> bool:
    """Whether both are; ValueError if only one of the two is."""
    words = [each for each in (energy_range, temperature) if isinstance(each, str)]
    if any(word != "auto" for word in words) or len(words) == 1:
        given = f"energy_range={energy_range!r} and temperature={temperature!r}"
        raise ValueError(f"{CALL}: {given}, but either both are 'auto', or both are numbers")
    return bool(words)
