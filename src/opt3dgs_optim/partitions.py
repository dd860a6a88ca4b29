"""How the visits of the energy's partitions are counted, and the multiplier nu that follows.

`FixedPartitions` is the paper's: a fixed range, Theta by stochastic approximation.
`MovingPartitions` is the default: partitions of the energy's recent deviations, and Theta from a
smoothed density of the recent visits. Equation numbers are those of the Opt3DGS paper (every
displayed equation counted; 7 partition, 13 index, 14 multiplier, 16 update of the weights).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

RELATIVE_ROUNDING = 1e-5  # of a saved range; more than that of float32
FLOOR = 1e-8  # smallest weight of a fixed range before renormalisation; log theta never sees 0
# Of the moving partitions; lengths are in deviations of the energy.
MEMORY = 100  # energies that mean, deviation and density remember
REACH = 6.0  # half of the range
BANDWIDTH = 0.4  # of the Gaussian by which a visit is spread, and by which the density is read
EVEN = 0.05  # share of the visits that is spread over all partitions: no visits, no slope
LIMIT = 4.0  # an energy further away counts as one at this distance
UNLIMITED = 4  # energies at the start, whose deviation is not known yet
MEAN_ABS = math.sqrt(2 / math.pi)  # mean absolute deviation of a Gaussian of deviation 1
RESOLUTION = 1e-6  # smallest deviation, as a share of the present distance from the mean


def host_tensor(numbers: Any) -> Tensor:
    """Numbers of Python's, in lists or not, as a float64 tensor on the CPU."""
    return torch.tensor(numbers, dtype=torch.float64, device="cpu")


class Tally:
    """How many energies have counted, where only the device knows which of them are finite.

    Attributes:
        warmup: number of energies during which nu is 1.
        count: number of finite energies so far, 0-d, int64.
        sums: powers 0, 1 and 2 of nu, summed over the finite energies after the warm-up, [3].
    """

    def __init__(self, warmup: int, nu: Tensor) -> None:
        self.warmup = warmup
        self.count = torch.zeros((), dtype=torch.int64, device=nu.device)
        self.sums = nu.new_zeros(3)
        self._powers = torch.arange(3, dtype=nu.dtype, device=nu.device)

    def add(self, nu: Tensor, valid: Tensor | Literal[True]) -> None:
        """Take the nu of an energy that has been counted; in the warm-up it becomes 1, in place."""
        in_warmup = self.count <= self.warmup
        nu.masked_fill_(in_warmup, 1.0)
        # Of two booleans, `>` is "and not".
        self.sums.addcmul_(torch.pow(nu, self._powers), valid > in_warmup)


class Partitions:
    """What both kinds share. `take` is the update, `nu` what it finds, 0-d.

    Pickled by its numbers: a pickle of its tensors gives every view memory of its own.
    """

    nu: Tensor

    def take_on_device(self, energy: Tensor, valid: Tensor | Literal[True], tally: Tally) -> None:
        """`take`, warm-up and sums, where only the device knows whether the energy is finite.

        Args:
            energy: 0-d, on the partitions' device.
            valid: whether it is finite, 0-d, bool. One that is not changes nothing.
            tally: of the energies before it; this one is added. Never synchronises.
        """
        tally.count.add_(valid)
        self.take(energy, valid, tally.count)
        tally.add(self.nu, valid)

    def take(self, energy: Tensor, valid: Tensor | Literal[True], count: int | Tensor) -> None:
        """Nu from the present weights, then their update with an energy, the `count`-th finite one.

        `valid` is whether it is finite. Where that is a tensor, `count` is one too.
        """
        raise NotImplementedError

    def __getstate__(self: Any) -> Any:
        plain = {key: value for key, value in vars(self).items() if not isinstance(value, Tensor)}
        return plain, self.nu.device, self.state()

    def __setstate__(self: Any, kept: Any) -> None:
        plain, device, state = kept
        vars(self).update(plain)
        self.allocate(device)
        self.load(state)


@dataclass(eq=False)
class FixedPartitions(Partitions):
    """Eq. 7, 13, 14 and 16 as the paper has them.

    Options as in `EnergyHistogram`, methods as in `MovingPartitions`.
    """

    num_partitions: int
    energy_range: tuple[float, float]
    zeta: float
    temperature: float
    clamp: tuple[float, float] | None

    def allocate(self, device: torch.device) -> None:
        # MPS has no float64.
        dtype = torch.float32 if device.type == "mps" else torch.float64
        m, (low, high) = self.num_partitions, self.energy_range
        scalars = [low, (high - low) / m, self.temperature, 0, 1]
        self._scalars = torch.tensor(scalars, dtype=dtype, device=device)
        self._low, self._width, self._tau, self._count, self.nu = self._scalars.unbind()
        self.weights = torch.full((m,), 1.0 / m, dtype=dtype, device=device)

    def take(self, energy: Tensor, valid: Tensor | bool, count: int | Tensor) -> None:
        """Nu from the present weights, then their update. They have a count of their own."""
        valid = torch.as_tensor(valid, device=energy.device)
        value = torch.where(valid, energy.to(self.weights.dtype), self._low)
        # J of eq. 13, counted from 0: u[J-1] < energy <= u[J], the end partitions open.
        index = torch.ceil((value - self._low) / self._width) - 1
        index = index.clamp(0, self.num_partitions - 1).long().reshape(1)
        # In place: a CUDA graph of a step reads nu where it was captured.
        self.nu.copy_(torch.where(valid, self._multiplier(index), self.nu))
        self._update(index, valid)
        self._count.add_(valid)

    def _multiplier(self, index: Tensor) -> Tensor:
        """Nu of eq. 14 for partition `index`."""
        log_weights = self.weights.log()
        # "theta(J - 1) v 1" in the paper is a clamp of the index (its source, CSGLD, Deng et al.
        # 2020); read as max(theta, 1) it would give nu = -3973 at the first step. Where it would
        # clamp, nu is 1.
        difference = log_weights[index] - log_weights[index - 1]
        nu = 1 + self.zeta * self._tau * difference.reshape(()) / self._width
        if self.clamp is not None:
            nu = nu.clamp(*self.clamp)
        # du is not the width of the two open end partitions: no slope is known there.
        inner = ((index > 0) & (index < self.num_partitions - 1)).reshape(())
        return torch.where(inner, nu, 1.0)

    def _update(self, index: Tensor, valid: Tensor) -> None:
        """Eq. 16, with a floor: theta += lambda theta_J^zeta (1[i = J] - theta)."""
        theta = self.weights
        step_size = (10 / (self._count**0.8 + 100)).clamp(max=1e-2)  # not in the paper
        rate = step_size * theta[index] ** self.zeta
        theta = theta - rate * theta
        theta = theta.index_add(0, index, rate).clamp(min=FLOOR)
        self.weights.copy_(torch.where(valid, theta / theta.sum(), self.weights))

    def coordinates(self) -> tuple[float, float, float]:
        low, width, tau, *_ = self._scalars.tolist()
        return low, low + width * self.num_partitions, tau

    def state(self) -> dict[str, Any]:
        return {"weights": self.weights.tolist(), "scalars": self._scalars.tolist()}

    def check(self, call: str, state: Mapping[str, Any]) -> None:
        """ValueError unless the weights are weights, and of this range.

        Theta is of the partitions in which it was learnt. The temperature only scales what is read
        from it, and is the present one.
        """
        theta = state["weights"]
        if min(theta) <= 0 or max(theta) > 2 or abs(math.fsum(theta) - 1) > 1e-6:
            raise ValueError(f"{call}: weights must be positive with sum 1")
        low, width, tau, count, _ = state["scalars"]
        if not (width > 0 and tau >= 0 and count >= 0):
            raise ValueError(f"{call}: scalars={state['scalars']!r}, but width > 0 is needed")
        # A device without float64 has rounded what it saves.
        near, m = max(map(abs, self.energy_range)) * RELATIVE_ROUNDING, self.num_partitions
        ends = zip(self.energy_range, (low, low + width * m), strict=True)
        if any(abs(own - theirs) > near for own, theirs in ends):
            raise ValueError(
                f"{call}: it has learnt with energy_range=({low:g}, {low + width * m:g}), but "
                f"energy_range={self.energy_range}, as it is here, is needed"
            )

    def load(self, state: Mapping[str, Any]) -> None:
        self.weights.copy_(host_tensor(state["weights"]))
        # Range and temperature are there already, with all their digits.
        _, _, _, count, nu = state["scalars"]
        self._count.fill_(count)
        self.nu.fill_(nu)


class Pace(NamedTuple):
    """What differs between the first hundred energies."""

    rate: float  # the share of an energy in all means
    low: float  # an energy further away than these counts as one at this distance, as t
    high: float
    has_mean: float  # 0 for the first energy, which is the mean itself, else 1
    has_slope: float  # 0 where the slope, which has no bound there, would own its mean for long

    @classmethod
    def of(cls, count: int) -> Pace:
        """That of the `count`-th energy."""
        rate, known = max(1 / max(count, 1), 1 / MEMORY), count > UNLIMITED
        limit = LIMIT / MEAN_ABS if known else math.inf
        return cls(rate, -limit, limit, float(count > 1), float(known))


class MovingPartitions(Partitions):
    """Partitions of z = (energy - recent mean) / recent deviation, over -6 to 6 deviations.

    q is the density of the recent z. A visit is spread over the partitions by a Gaussian k of
    0.4 deviations, q += (k - q) / 100, and the slope is that of q read through k again:

        Theta ~ q^(1 / (1 - zeta)),    nu = 1 + zeta tau dlog Theta/du = 1 + dlog q/dz / 2

    with tau = (1 - zeta) / (2 zeta) deviations. Smoothing by k twice widens a Gaussian's variance
    to 1 + 2 * 0.4^2, by which the slope is corrected, and its own recent mean is taken away. All
    means are of the last 100 energies, weighed exponentially; the deviation is the mean absolute
    one. docs/algorithms/awsgld.md has the reasons.

    Few operators: one packed state follows one packed target by one `lerp_`, and all products with
    q are one `addmv`. Where the CUDA kernels run, all of it is one launch.
    """

    def __init__(self, num_partitions: int, zeta: float, clamp: tuple[float, float] | None) -> None:
        self.num_partitions, self.zeta = num_partitions, zeta
        self.clamp = (-math.inf, math.inf) if clamp is None else clamp

    def allocate(self, device: torch.device) -> None:
        """Begin anew on a device."""
        # A loss has float32's digits; elsewhere than on a CPU float64 is slow or missing.
        dtype = torch.float64 if device.type == "cpu" else torch.float32
        like: dict[str, Any] = {"dtype": dtype, "device": device}
        m, h2 = self.num_partitions, BANDWIDTH**2
        width = 2 * REACH / m
        # Made on the CPU: whatever torch's default device is, and not every device has float64.
        wide: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}
        center = (torch.arange(m, **wide) + 0.5) * width - REACH
        # Log of the Gaussian around z = MEAN_ABS * t, up to what softmax takes away.
        self._log_kernel = (-center * center / (2 * h2)).to(**like)
        self._log_kernel_slope = (center * (MEAN_ABS / h2)).to(**like)
        # With V = [k q, t]: rows of slope * (sum k q c + even * z), sum k q + even, -slope * z.
        slope, even = 0.5 * (1 + 2 * h2) / h2, EVEN / m
        rows = torch.zeros(3, m + 1, **wide)
        rows[0, :m], rows[1, :m] = slope * center, 1.0
        rows[0, m], rows[2, m] = slope * even * MEAN_ABS, -slope * MEAN_ABS
        self._rows = rows.to(**like)
        self._products, self._sums = torch.zeros(m + 1, **like), torch.zeros(3, **like)
        self._offsets = torch.zeros_like(self._sums)
        self._offsets[1] = even
        # Mean, mean absolute deviation, mean of the slope, q; and what they are drawn to.
        self._state, self._target = torch.full((2, m + 3), 1.0 / m, **like).unbind()
        self.nu = torch.ones((), **like)
        tiny = 1e-150 if dtype.itemsize == 8 else 1e-30
        self._tiny = torch.full((), tiny, **like)
        paces = [Pace.of(count) for count in range(MEMORY + 1)]
        self._paces = host_tensor(paces).to(**like)
        self._constants = (REACH, BANDWIDTH, EVEN, MEAN_ABS, RESOLUTION, tiny)
        # Views are made once: a view is an operator too.
        self._mean, self._deviation, self._mean_slope = self._state[:3].unbind()
        self._to_mean, self._to_deviation, self._slope = self._target[:3].unbind()
        self._q, self._kernel, self._kq = self._state[3:], self._target[3:], self._products[:-1]
        self._t = self._products[-1]
        self._up, self._below, self._base = self._sums.unbind()

    def take_on_device(self, energy: Tensor, valid: Tensor | Literal[True], tally: Tally) -> None:
        """As in `Partitions`."""
        if energy.dtype != self.nu.dtype:
            energy = energy.to(self.nu.dtype)
            valid = valid & torch.isfinite(energy)  # a large number of float64 is not, in float32
        super().take_on_device(energy, valid, tally)

    def take(self, energy: Tensor, valid: Tensor | Literal[True], count: int | Tensor) -> None:
        """Nu from the present density, then its update with an energy, 0-d, the `count`-th."""
        if isinstance(count, Tensor):
            # An energy that does not count becomes the mean, and moves nothing.
            energy = torch.where(torch.as_tensor(valid, device=energy.device), energy, self._mean)
            pace: Any = torch.nn.functional.embedding(count.clamp(max=MEMORY), self._paces).unbind()
            mean = torch.lerp(energy, self._mean, pace[3])
        else:
            pace = Pace.of(count)
            mean = energy if count == 1 else self._mean
        rate, low, high, _, has_slope = pace
        # t = z / MEAN_ABS: distance from the mean in mean absolute deviations. Where those have
        # vanished, as after a constant loss, they grow again by the second term.
        distance = torch.sub(energy, mean)
        unit = torch.add(self._deviation, distance.abs(), alpha=RESOLUTION)
        t = torch.clamp(torch.div(distance, unit), low, high, out=self._t)
        log_kernel = torch.addcmul(self._log_kernel, self._log_kernel_slope, t)
        torch.softmax(log_kernel, 0, out=self._kernel)
        torch.mul(self._kernel, self._q, out=self._kq)
        torch.addmv(self._offsets, self._rows, self._products, out=self._sums)
        slope = torch.addcdiv(self._base, self._up, self._below, out=self._slope)
        if not (isinstance(count, int) and count > UNLIMITED):
            slope.mul_(has_slope)
        nu = torch.sub(slope, self._mean_slope).add_(1.0)
        torch.clamp(
            nu if valid is True else torch.where(valid, nu, self.nu), *self.clamp, out=self.nu
        )
        step = torch.mul(t, unit)
        torch.add(mean, step, out=self._to_mean)
        torch.hypot(step, self._tiny, out=self._to_deviation)
        self._state.lerp_(self._target, rate * valid)

    @property
    def weights(self) -> Tensor:
        """Theta, [m], sum 1."""
        q = (1 - EVEN) * self._q.double() + EVEN / self.num_partitions
        return torch.softmax(q.log() / (1 - self.zeta), 0)

    def coordinates(self) -> tuple[float, float, float]:
        """Low and high end of the range, and tau. Synchronises."""
        mean, deviation = self._state[:2].tolist()
        deviation /= MEAN_ABS
        tau = (1 - self.zeta) / (2 * self.zeta) * deviation
        return mean - REACH * deviation, mean + REACH * deviation, tau

    def state(self) -> dict[str, Any]:
        """Plain floats and lists. Synchronises."""
        return {"recent": self._state.tolist(), "nu": float(self.nu)}

    def check(self, call: str, state: Mapping[str, Any]) -> None:
        """ValueError unless the density is one."""
        _, deviation, _, *q = state["recent"]
        if deviation < 0 or min(q) < 0 or max(q) > 2 or abs(math.fsum(q) - 1) > 1e-3:
            raise ValueError(f"{call}: recent={state['recent']!r}, but a density is needed")

    def load(self, state: Mapping[str, Any]) -> None:
        """Restore `state()`."""
        self._state.copy_(host_tensor(state["recent"]))
        # The smallest deviation of float64 is zero in float32, and zero over zero is not a number.
        self._deviation.clamp_(min=self._constants[-1])
        self.nu.fill_(state["nu"])
