"""Multi-modal landscapes with known answers: stationary laws, Kramers' rate, nine modes.

Chains are rows of one parameter where no histogram is on, since nu is of the whole step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from problems import double_well, gradient, kramers_rate, nine_modes
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import AWSGLD, EnergyHistogram, IsotropicNoise


def chains(start: Tensor, lr: float, temperature: float, **options: Any) -> tuple[Any, AWSGLD]:
    noise = IsotropicNoise(temperature, generator=torch.Generator().manual_seed(0))
    x = Parameter(start)
    return x, AWSGLD([x], lr=lr, preconditioner="none", noise=noise, **options)


def test_a_gaussian() -> None:
    """SGLD on x^2 / 2 at temperature T samples N(0, T / (1 - lr / 2)) exactly (AR(1) process)."""
    lr, temperature, moments = 0.2, 0.5, []
    x, walk = chains(torch.zeros(4000), lr, temperature)
    for step in range(120):
        x.grad = x.detach().clone()
        walk.step()
        if step >= 60 and step % 15 == 0:
            moments.append(x.detach().square().mean())
    # relative standard error of a variance from 16,000 nearly independent draws: 1.1 %
    assert float(torch.stack(moments).mean()) == pytest.approx(temperature / 0.9, rel=0.04)
    z = x.detach() / x.detach().std()
    assert float((z**4).mean()) == pytest.approx(3.0, abs=0.4)


def test_a_double_well() -> None:
    """Both wells, and the density between them, at a small step."""
    x, walk = chains(torch.linspace(-1.5, 1.5, 8000, dtype=torch.float64)[:, None], 0.01, 1.0)
    for _ in range(400):
        x.grad = gradient(double_well, x)
        walk.step()
    grid = torch.linspace(-2.5, 2.5, 2001, dtype=torch.float64)
    density = (-double_well(grid[:, None])).exp()
    law = density.cumsum(0) / density.sum()
    empirical = torch.searchsorted(x.detach()[:, 0].sort().values, grid).double() / 8000
    # Kolmogorov-Smirnov of 8,000 draws: 1 % critical value 0.018; 0.01 for the step's own bias
    assert float((empirical - law).abs().max()) < 0.03


def test_kramers_rate() -> None:
    """The share of chains that have left the well in which they began, barrier 4 temperatures."""
    barrier, lr, count, steps = 4.0, 2e-3, 6000, 1000
    x, walk = chains(torch.full((count, 1), -1.0), lr, 1.0)
    shares = []
    for step in range(steps):
        x.grad = gradient(lambda p: double_well(p, barrier), x)
        walk.step()
        if step in (steps // 2 - 1, steps - 1):
            shares.append(float((x.detach() > 0).double().mean()))
    # Right share p: dp/dt = r (1 - 2p). Over the second half, after the start has been forgotten.
    first, last = (-math.log(1 - 2 * p) / 2 for p in shares)
    found = (last - first) / (lr * steps / 2)
    # 6,000 chains of which 2 % cross in that time know it to 9 %; Kramers' formula to 1 / barrier.
    assert found == pytest.approx(kramers_rate(barrier, 1.0), rel=0.35)


def crossings(histogram: EnergyHistogram | None, steps: int) -> int:
    """How often a walk in a double well, h / T = 6, reaches the other minimum."""
    x, walk = chains(torch.ones(1, 1), 6e-3, 1.0, histogram=histogram)
    well, count = 1.0, 0
    for _ in range(steps):
        position = x.detach()
        square = float(position[0, 0]) ** 2
        x.grad = 24 * position * (square - 1)
        if histogram is not None:
            histogram.observe(6 * (square - 1) ** 2)
        walk.step()
        if float(x.detach()[0, 0]) * well < -0.5:
            well, count = -well, count + 1
    return count


def test_the_histogram_crosses_where_the_walk_does_not() -> None:
    flat = EnergyHistogram(energy_range=(0.0, 8.0), temperature=1.0, warmup=0)
    assert crossings(None, 2_000) <= 1  # Kramers: 0.1 in that time
    assert crossings(flat, 4_000) >= 3


@pytest.mark.thorough
def test_reweighted_samples_have_the_law_without_a_histogram() -> None:
    """Of the barrier, which the walk itself visits ten times as often, and of the energy."""
    temperature, steps = 0.2, 20_000
    flat = EnergyHistogram(energy_range=(0.0, 1.5), temperature=temperature, warmup=0)
    x, walk = chains(torch.ones(1, 1, dtype=torch.float64), 0.01, temperature, histogram=flat)
    edges = np.linspace(0.0, 1.5, flat.num_partitions + 1)[1:-1]
    found = []
    for step in range(steps):
        at = x.detach()
        energy = float((at**2 - 1) ** 2)
        x.grad = 4 * at * (at**2 - 1)
        if step > steps // 4:
            log_psi = np.interp(energy, edges, flat.weights.log()[:-1])
            found.append((float(at.abs() < 0.5), energy, math.exp(flat.zeta * log_psi)))
        flat.observe(energy)
        walk.step()
    barrier, energies, weights = np.array(found).T
    grid = np.linspace(-3, 3, 6001)
    law = np.exp(-((grid**2 - 1) ** 2) / temperature)
    exact = np.average(np.abs(grid) < 0.5, weights=law)
    assert barrier.mean() > 5 * exact
    assert np.average(barrier, weights=weights) == pytest.approx(exact, rel=0.3)
    mean = np.average((grid**2 - 1) ** 2, weights=law)
    assert np.average(energies, weights=weights) == pytest.approx(mean, rel=0.2)


def modes_found(histogram: EnergyHistogram | None, steps: int) -> int:
    """Of CSGLD's nine modes, within 0.3 of each, from its corner, with its settings."""
    x, walk = chains(torch.full((1, 2), 2.0), 5e-3, 1.0, histogram=histogram)
    modes, seen = torch.cartesian_prod(*[torch.tensor([-5 / 3, 0.0, 5 / 3])] * 2), set()
    for _ in range(steps):
        x.grad = gradient(nine_modes, x)
        if histogram is not None:
            histogram.observe(nine_modes(x.detach())[0])
        walk.step()
        x.data.clamp_(-2.5, 2.5)
        distance = (modes - x.detach()).norm(dim=1)
        if float(distance.min()) < 0.3:
            seen.add(int(distance.argmin()))
    return len(seen)


@pytest.mark.thorough
def test_nine_modes() -> None:
    """Plain SGLD finds few of them; with a flat histogram it finds all."""
    flat = EnergyHistogram(
        100, (-7.0, 18.0), temperature=1.0, warmup=0, clamp=(-5.0, 5.0), zeta=0.75
    )
    assert modes_found(None, 20_000) <= 6
    assert modes_found(flat, 20_000) == 9
