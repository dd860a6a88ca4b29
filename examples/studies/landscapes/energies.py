"""What is known of the landscapes: minima, exact laws and exact escape rates."""

from __future__ import annotations

import math

import torch
from torch import Tensor

WAVE = 1.2 * math.pi
BOUNDARY = 2.5
# Local maxima of the waves, to 0.02: the lines between the nine wells' cells.
CELL_EDGE = 0.82


def nine_modes(x: Tensor) -> Tensor:
    """Energy [C] at x [C, 2] on CSGLD's landscape (Deng, Lin and Liang 2020)."""
    square = (x * x).sum(1)
    return (square / 10 - (WAVE * x).cos().sum(1)) / 0.3 + (square - 7).clamp(min=0)


def cell_of(x: Tensor) -> Tensor:
    """Which of the nine wells' cells [C], 0 to 8, each of the positions [C, 2] is in."""
    column = (x > CELL_EDGE).long() - (x < -CELL_EDGE).long() + 1
    return 3 * column[:, 0] + column[:, 1]


def nine_minima() -> Tensor:
    """[9, 2], in the order of `cell_of`; found by Newton's method in each coordinate."""
    at = torch.tensor([-1.6, 0.0, 1.6], dtype=torch.float64)
    for _ in range(20):  # the waves and the bowl separate; r^2 < 7 at all nine
        slope = at / 5 + WAVE * (WAVE * at).sin()
        at = at - slope / (0.2 + WAVE**2 * (WAVE * at).cos())
    return torch.cartesian_prod(at, at)


def nine_masses(bins: int = 1000) -> Tensor:
    """[9]: the share of exp(-energy) in each cell, by the midpoint rule."""
    axis = (torch.arange(bins, dtype=torch.float64) + 0.5) / bins * 2 * BOUNDARY - BOUNDARY
    points = torch.cartesian_prod(axis, axis)
    density = (-nine_modes(points)).exp()
    masses = torch.zeros(9, dtype=torch.float64).index_add_(0, cell_of(points), density)
    return masses / masses.sum()


def kl(counts: Tensor, truth: Tensor) -> float:
    """Kullback-Leibler divergence of the normalised counts from the truth, in nats."""
    share = counts / counts.sum()
    return float(torch.where(share > 0, share * (share / truth).log(), 0.0).sum())


def kramers_rate(height: float) -> float:
    """Kramers (1940), temperature 1: sqrt(8h 4h) / 2 pi exp(-h) escapes per unit of time."""
    return math.sqrt(32) * height / (2 * math.pi) * math.exp(-height)


GRID = torch.linspace(-3.0, 3.0, 60_001, dtype=torch.float64)


def exact_rate(potential: Tensor) -> float:
    """1 / (mean first passage time from -1 to 1) on `GRID`, for overdamped motion at temperature 1.

    T(-1 -> 1) = int_-1^1 dy exp(W(y)) int_-inf^y dz exp(-W(z)); Kramers' rate is its limit for
    high barriers.
    """
    step = float(GRID[1] - GRID[0])
    inner = (-potential).exp().cumsum(0) * step
    between = (GRID >= -1) & (GRID < 1)
    return 1 / float(((potential[between]).exp() * inner[between]).sum() * step)


def well_potential(height: float) -> Tensor:
    """The double well h (x^2 - 1)^2 on `GRID`."""
    return height * (GRID**2 - 1) ** 2


def flattened_potential(
    height: float, partitions: int, low: float, high: float, zeta: float, clamp: tuple[float, float]
) -> tuple[Tensor, float]:
    """What eq. 14 makes of the double well when theta is exactly the law's mass per partition.

    The drift is nu(U) U', so the potential is the integral of nu over the energy.

    Returns:
        the potential on `GRID`, and the mean of nu under its law.
    """
    energy, width = well_potential(height), (high - low) / partitions
    index = (((energy - low) / width).ceil().long() - 1).clamp(0, partitions - 1)
    mass = torch.zeros(partitions, dtype=torch.float64).index_add_(0, index, (-energy).exp())
    log_mass = (mass / mass.sum()).clamp(min=1e-8).log()
    nu = 1 + zeta * log_mass.diff(prepend=log_mass[:1]) / width
    nu = nu.clamp(*clamp)
    nu[0] = nu[-1] = 1.0
    edges = low + width * torch.arange(partitions, dtype=torch.float64)
    reached = torch.cat([torch.zeros(1, dtype=torch.float64), (nu * width).cumsum(0)[:-1]])
    potential = reached[index] + nu[index] * (energy - edges[index])
    potential = potential - potential.min()
    law = (-potential).exp()
    return potential, float((nu[index] * law).sum() / law.sum())
