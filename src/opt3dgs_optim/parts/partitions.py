"""How the visits of the energy's partitions are counted, and the multiplier nu that follows.

`FixedPartitions` is the paper's: a fixed range, Theta by stochastic approximation.
`MovingPartitions` is the default: partitions of the energy's recent deviations, and Theta from a
smoothed density of the recent visits. Both are plain torch, the same on every device, and read
nothing back. Equation numbers count every displayed equation of the Opt3DGS paper: 7 partition, 13
index, 14 multiplier, 16 update of the weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

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
SMALLEST = 1e-30  # and as a number: zero over zero is none


@dataclass(eq=False)
class FixedPartitions:
    """Eq. 7, 13, 14 and 16 of the paper, errata mended. The state is Theta, [num_partitions].

    Options as in `EnergyHistogram`.
    """

    num_partitions: int
    energy_range: tuple[float, float]
    zeta: float
    tau: float

    def place(self, device: torch.device, dtype: torch.dtype) -> None:
        """As in `MovingPartitions`."""
        m = self.num_partitions
        self.state = torch.full((m,), 1.0 / m, dtype=dtype, device=device)

    def take(self, energy: Tensor, valid: Tensor, count: Tensor) -> Tensor:
        """As in `MovingPartitions`. In the first and in the last partition nu is 1."""
        theta, (low, high) = self.state, self.energy_range
        width = (high - low) / self.num_partitions
        # J of eq. 13, counted from 0: u[J-1] < energy <= u[J], the end partitions open.
        index = torch.ceil((torch.where(valid, energy, low) - low) / width) - 1
        index = index.clamp(0, self.num_partitions - 1).long().reshape(1)
        # "theta(J - 1) v 1" in eq. 14 is a clamp of the index (from CSGLD, Deng et al. 2020), and
        # not max(theta, 1), nu = -3973 at the first step. Where it would clamp nu is 1, and
        # so it is in the last partition: du is not the width of the two open ends.
        difference = theta[index].log() - theta[index - 1].log()
        nu = 1 + self.zeta * self.tau * difference / width
        nu = torch.where((index > 0) & (index < self.num_partitions - 1), nu, 1.0)
        # Eq. 16, with a floor: theta += lambda theta_J^zeta (1[i = J] - theta). lambda's schedule
        # is not in the paper.
        step_size = (10 / ((count - 1) ** 0.8 + 100)).clamp(max=1e-2)
        rate = step_size * theta[index] ** self.zeta
        updated = (theta - rate * theta).index_add(0, index, rate).clamp(min=FLOOR)
        self.state = torch.where(valid, updated / updated.sum(), theta)
        return nu.reshape(())

    @property
    def weights(self) -> Tensor:
        """As in `MovingPartitions`."""
        return self.state

    def fits(self, state: Sequence[float]) -> bool:
        """As in `MovingPartitions`: positive weights with sum 1."""
        return min(state) > 0 and abs(math.fsum(state) - 1) < 1e-3


@dataclass(eq=False)
class MovingPartitions:
    """Partitions of z = (energy - recent mean) / recent deviation, over -6 to 6 deviations.

    q is the density of the recent z. A visit is spread over the partitions by a Gaussian k of
    0.4 deviations, q += (k - q) / 100, and the slope is that of q read through k again:

        Theta ~ q^(1 / (1 - zeta)),    nu = 1 + zeta tau dlog Theta/du = 1 + dlog q/dz / 2

    with tau = (1 - zeta) / (2 zeta) deviations. Smoothing by k twice widens a Gaussian's variance
    to 1 + 2 * 0.4^2, by which the slope is corrected, and its own recent mean is taken away. All
    means are of the last 100 energies, weighed exponentially; the deviation is the mean absolute
    one. docs/algorithms/awsgld.md has the reasons.

    The state is [3 + num_partitions]: mean, mean absolute deviation, mean of the slope, and q. It
    follows one target by one `lerp`.
    """

    num_partitions: int
    zeta: float

    def place(self, device: torch.device, dtype: torch.dtype) -> None:
        """Begin anew on a device."""
        m, h2 = self.num_partitions, BANDWIDTH**2
        # Made on the CPU: not every device has float64.
        wide: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}
        center = (torch.arange(m, **wide) + 0.5) * (2 * REACH / m) - REACH
        # Log of the Gaussian around z = MEAN_ABS * t, up to what softmax takes away.
        log_kernel, log_kernel_slope = -center * center / (2 * h2), center * (MEAN_ABS / h2)
        # With V = [k q, t]: rows of slope * (sum k q c + even * z), sum k q + even, -slope * z.
        slope, even = 0.5 * (1 + 2 * h2) / h2, EVEN / m
        rows, offsets = torch.zeros(3, m + 1, **wide), torch.tensor([0.0, even, 0.0], **wide)
        rows[0, :m], rows[1, :m] = slope * center, 1.0
        rows[0, m], rows[2, m] = slope * even * MEAN_ABS, -slope * MEAN_ABS
        constants = (log_kernel, log_kernel_slope, rows, offsets)
        self._constants = [each.to(device, dtype) for each in constants]
        self.state = torch.tensor([0.0, SMALLEST, 0.0, *[1 / m] * m], dtype=dtype, device=device)

    def take(self, energy: Tensor, valid: Tensor, count: Tensor) -> Tensor:
        """Nu of the state as it is, 0-d, without a clamp; then the state's update.

        Args:
            energy: 0-d, of the state's dtype and device.
            valid: 0-d bool, whether it is finite; where it is not, the state stays.
            count: 0-d, of the state's dtype: how many have been finite, with this one.
        """
        log_kernel, log_kernel_slope, rows, offsets = self._constants
        mean, deviation, mean_slope = self.state[:3].unbind()
        energy = torch.where(valid, energy, mean)
        mean = torch.where(count > 1, mean, energy)
        is_known = count > UNLIMITED
        # t = z / MEAN_ABS: distance from the mean in mean absolute deviations. Where those have
        # vanished, as after a constant loss, they grow again by the second term.
        distance = energy - mean
        unit = torch.add(deviation, distance.abs(), alpha=RESOLUTION)
        t = distance / unit
        furthest = LIMIT / MEAN_ABS
        t = torch.where(is_known, t.clamp(-furthest, furthest), t)
        kernel = torch.softmax(torch.addcmul(log_kernel, log_kernel_slope, t), 0)
        products = torch.cat([kernel * self.state[3:], t.reshape(1)])
        up, below, base = torch.addmv(offsets, rows, products).unbind()
        # It has no bound while the deviation is not known, and would own its mean for long.
        slope = torch.where(is_known, torch.addcdiv(base, up, below), 0.0)
        step = t * unit
        recent = torch.stack([mean + step, step.abs().clamp(min=SMALLEST), slope])
        rate = valid / count.clamp(1, MEMORY)
        self.state = torch.lerp(self.state, torch.cat([recent, kernel]), rate)
        return slope - mean_slope + 1.0

    @property
    def weights(self) -> Tensor:
        """Theta, [num_partitions], positive, sum 1."""
        q = (1 - EVEN) * self.state[3:] + EVEN / self.num_partitions
        return torch.softmax(q.log() / (1 - self.zeta), 0)

    def fits(self, state: Sequence[float]) -> bool:
        """Whether so many numbers may be a state: a deviation, and a density."""
        _, deviation, _, *q = state
        return deviation > 0 and min(q) >= 0 and abs(math.fsum(q) - 1) < 1e-3
