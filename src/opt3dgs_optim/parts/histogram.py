"""The flat histogram: the multiplier nu of every step, from the density of the visited energies."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from opt3dgs_optim.checks import as_float, check_count, check_energy, check_interval, check_number
from opt3dgs_optim.clock import Phase
from opt3dgs_optim.part import Part
from opt3dgs_optim.parts.partitions import FixedPartitions, MovingPartitions
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training

# The temperature is not given in the paper; zeta * tau / du = 1.5 at its zeta and du.
PAPER: dict[str, Any] = {"energy_range": (0.0, 0.2), "temperature": 2e-3, "warmup": 2500}
PAPER["num_partitions"] = MOST = 200
PAPER_CLAMP = (-5.0, 5.0)  # not given in the paper; the only published one of its family
CALL = "EnergyHistogram"
CLAMP = (-1.0, 3.0)  # twice as far from 1 as nu is two deviations out


class EnergyHistogram(Part):
    """Steps are longer at energies below the mean, shorter above it: the flat histogram's nu.

        nu = 1 + zeta * tau * dlog Theta / du                                        (eq. 14)

    Theta is the weight of the energy's partition, by how often the training has been there.

    By default the partitions follow the energy's recent mean and deviation: an energy two
    deviations from the mean gets |nu - 1| = 1 at all times, nu's mean is 1 and its deviation 1/2,
    whatever zeta and however far the energy falls. `MovingPartitions` has the formulas. With a
    range and a temperature it is the paper's update, errata mended (`FixedPartitions`);
    `EnergyHistogram.paper()` has its numbers.

    The default is made for trainings. **To sample** a fixed energy, give `energy_range`, from the
    lowest energy to a little above the barriers that are to be crossed, `temperature`, the same as
    the noise's (`IsotropicNoise`), and `warmup=0`. The law is then exp(-energy / temperature) over
    Psi(energy)^zeta, see `weights`. Energies outside the range have nu 1; an optimizer is one
    chain, whatever its rows are. The default's partitions follow the walk, so the well in which it
    began looks like all there is. In a double well whose barrier is six times the temperature, a
    walk of 10,000 steps of 0.006 never crossed it without a histogram, twice with the default, and
    19 times with a range and a temperature (`examples/awsgld_double_well.py`).

    Args:
        num_partitions: number of partitions; None: 48 if they follow the energy; for a range as
            many as are half a temperature wide, at most 200, which are the paper's. Where they are
            narrower nu is often at its bounds, and the samples' law is not the one above.
        energy_range: (low, high) in units of the loss, cut uniformly; the first and the last
            partition are open (eq. 7). `"auto"`: see above.
        zeta: flattening exponent, from 0 to 1. With an automatic temperature it must be neither 0
            nor 1, and cancels.
        temperature: tau, in units of the loss; `"auto"` exactly when `energy_range` is.
        warmup: number of energies during which nu is 1 while Theta is being estimated.
        clamp: (low, high) bounds of nu, around 1, or None; `"auto"` is (-1, 3) for partitions that
            follow the energy, where nu seldom leaves 0 to 2, and (-5, 5) for a range.

    Raises:
        ValueError: an option is outside what is allowed.
    """

    during = Phase.EXPLORATION
    learns = True
    later = ("factor",)

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
        automatic = isinstance(energy_range, str) and energy_range == "auto"
        if automatic != (temperature == "auto"):
            given = f"energy_range={energy_range!r} and temperature={temperature!r}"
            raise ValueError(f"{CALL}: {given}, but either both are 'auto', or both are numbers")
        self.energy_range, self.temperature = energy_range, temperature
        span, tau, usual = (0.0, 0.0), 0.0, 48
        if not automatic:
            self.energy_range = span = check_interval(CALL, "energy_range", energy_range)
            self.temperature = tau = check_number(CALL, "temperature", temperature, 0.0)
            usual = half_a_temperature_wide(*span, tau)
        wanted = usual if num_partitions is None else num_partitions
        fewest = 24 if automatic else 3  # at most half a deviation wide
        self.num_partitions = check_count(CALL, "num_partitions", wanted, fewest)
        ends = {"open_low": automatic, "open_high": automatic}
        self.zeta = check_number(CALL, "zeta", zeta, 0.0, 1.0, **ends)
        self.warmup = check_count(CALL, "warmup", warmup, 4 if automatic else 0)
        if clamp == "auto":
            clamp = CLAMP if automatic else PAPER_CLAMP
        self.clamp = None if clamp is None else check_interval(CALL, "clamp", clamp)
        if self.clamp is not None and not self.clamp[0] <= 1 <= self.clamp[1]:
            raise ValueError(f"{CALL}: clamp={clamp!r}, but bounds on both sides of 1 are needed")
        self._partitions: FixedPartitions | MovingPartitions
        if automatic:
            self._partitions = MovingPartitions(self.num_partitions, self.zeta)
        else:
            self._partitions = FixedPartitions(self.num_partitions, span, self.zeta, tau)
        self.num_observed = 0
        self._place(torch.device("cpu"))

    @classmethod
    def paper(cls, **overrides: Any) -> EnergyHistogram:
        """The paper's update with its settings: range [0, 0.2], zeta .75, warm-up 2,500.

        The temperature (2e-3), the clamp (-5 to 5) and lambda's schedule are not in the paper.
        """
        return cls(**(PAPER | overrides))

    def _place(self, device: torch.device) -> None:
        """Begin anew on a device."""
        # A loss has float32's digits; elsewhere than on a CPU float64 is slow or missing.
        dtype = torch.float64 if device.type == "cpu" else torch.float32
        self._partitions.place(device, dtype)
        self._taken = torch.zeros((), dtype=dtype, device=device)  # energies that were finite
        self._sums = torch.zeros(3, dtype=dtype, device=device)  # of nu^0, nu, nu^2 after warm-up
        self._nu = torch.ones((), dtype=dtype, device=device)

    @torch.no_grad()
    def observe(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, energy: Tensor | float, training: Training | None = None
    ) -> Tensor:
        """Take one energy; return nu, 0-d on its device, of the weights before their update.

        Args:
            energy: the training loss of this iteration, 0-d (or one element; ValueError of more).
                One that is not finite changes nothing. A GPU is not waited for.
            training: the training's; where the next step exploits, energies are left alone.
        """
        value = check_energy(f"{CALL}.observe", "energy", energy, torch.float64)
        if training is not None and training.exploits_next:  # its loss may be another
            return self._nu
        if value.device != self._nu.device:  # a trainer's GPU, or resumed from a checkpoint
            learnt = self.state_dict()["learnt"]
            self._place(value.device)
            self._restore(learnt)
        value = value.to(self._nu.dtype)
        valid = torch.isfinite(value)
        self.num_observed += 1
        self._taken = self._taken + valid
        nu = self._partitions.take(value, valid, self._taken)
        if self.clamp is not None:
            nu = nu.clamp(*self.clamp)
        counts = valid & (self._taken > self.warmup)
        self._nu = nu = torch.where(counts, nu, self._nu)
        self._sums = self._sums + counts * torch.stack([torch.ones_like(nu), nu, nu * nu])
        return nu

    def plan(self, step: Step, training: Training) -> None:
        """Scale the rate by nu: a float, or where energies lie on a device a tensor of it, 0-d."""
        if self.num_observed:
            step.factor = step.factor * self._factor()
        elif step.iteration > 0:  # one may come after the first step
            training.messages.warn_once(
                CALL,
                f"{CALL}: no energy has been observed, so that nu is 1; call phases.observe(loss) "
                "before the steps, with AWSGLD histogram.observe(loss) or step(closure)",
            )

    def _factor(self) -> float | Tensor:
        return self._nu.item() if self._nu.is_cpu else self._nu

    @property
    def multiplier(self) -> Tensor:
        """Nu after the last finite energy, 0-d, on the energies' device."""
        return self._nu

    @property
    def weights(self) -> Tensor:
        """Theta, [num_partitions], positive, sum 1 (eq. 9).

        For means under exp(-energy / temperature), a sample of energy u counts Psi(u)^zeta. The log
        of Psi is that of Theta at each partition's upper edge, and linear between them (eq. 10).
        """
        return self._partitions.weights

    @property
    def mean_multiplier(self) -> Tensor:
        """Mean of nu over all energies after the warm-up (1 before it), 0-d: an honest control."""
        count, total, _ = self._sums
        return torch.where(count > 0, total / count, 1.0)

    @property
    def multiplier_std(self) -> Tensor:
        """Standard deviation of nu over all energies after the warm-up, 0-d."""
        count, total, squares = self._sums
        return (squares / count - (total / count) ** 2).nan_to_num(0.0).clamp(min=0).sqrt()

    def numbers(self, training: Training) -> dict[str, float | Tensor]:
        """`nu`, after as many energies as the warm-up has, while it acts."""
        acts = training.phase is self.during and self.num_observed > self.warmup
        return {"nu": self._factor()} if acts else {}

    def state_dict(self) -> dict[str, Any]:
        """All that `observe` has learnt, as plain numbers and lists. Synchronises."""
        parts = self._taken.reshape(1), self._nu.reshape(1), self._sums, self._partitions.state
        span = self.energy_range
        return {
            "energy_range": span if span == "auto" else list(span),
            "learnt": torch.cat(parts).tolist(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`.

        Raises:
            ValueError: it is damaged, or of other partitions; nothing is changed then.
        """
        learnt: Any = state.get("learnt")
        needed = 5 + len(self._partitions.state)
        fits = (
            state.get("energy_range") == self.state_dict()["energy_range"]
            and isinstance(learnt, list)
            and len(learnt) == needed
            and all(math.isfinite(as_float(number)) for number in learnt)
        )
        if not fits or learnt[0] < 0 or not self._partitions.fits(learnt[5:]):
            raise ValueError(
                f"{CALL}.load_state_dict: it is damaged, or of another histogram; load what one "
                f"with num_partitions={self.num_partitions} and energy_range={self.energy_range!r} "
                "has learnt"
            )
        self._restore(learnt)

    def _restore(self, learnt: list[float]) -> None:
        numbers = self._nu.new_tensor(learnt)
        self._taken, self._sums, self._partitions.state = numbers[0], numbers[2:5], numbers[5:]
        self.num_observed = int(learnt[0])
        # The warm-up may be another here.
        self._nu = torch.where(numbers[0] > self.warmup, numbers[1], 1.0)

    def __repr__(self) -> str:
        line = f"{CALL}("
        if self.energy_range != "auto":
            line += f"energy_range={self.energy_range!r}, temperature={self.temperature!r}, "
        line += f"zeta={self.zeta:g}, clamp={self.clamp}): nu "
        if self._taken <= self.warmup:
            return f"{line}1, warm-up: {int(self._taken)} of {self.warmup} energies"
        mean, deviation = float(self.mean_multiplier), float(self.multiplier_std)
        return f"{line}{float(self._nu):.4g}, mean {mean:.4g} +- {deviation:.2g}"


def half_a_temperature_wide(low: float, high: float, temperature: float) -> int:
    """How many partitions of a range are half a temperature wide, 3 to `MOST`."""
    return max(3, round(min(2 * (high - low) / temperature, MOST))) if temperature else 3
