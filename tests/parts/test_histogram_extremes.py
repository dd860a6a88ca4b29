"""Scripted energies at the edge: what nu's mean, deviation and share at the clamp are then."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from opt3dgs_optim import AWSGLD, EnergyHistogram, PhaseScheduler

COUNT = 3_000
K = np.arange(COUNT)
RANDOM = np.random.default_rng(1)
Z, HEAVY = RANDOM.normal(size=COUNT), RANDOM.standard_t(2, size=COUNT)
VIEWS = RANDOM.normal(size=40)[RANDOM.permuted(np.tile(np.arange(40), (75, 1)), axis=1).ravel()]


def spiked(at: int) -> np.ndarray:
    """One energy 1,000 deviations off."""
    energies = 5 + 0.3 * Z
    energies[at] += 300
    return energies


# name: (energies, bounds of nu's mean, bounds of its deviation), from the 250th energy on
SCRIPTS: dict[str, tuple[np.ndarray, tuple[float, float], tuple[float, float]]] = {
    "stationary": (5 + 0.3 * Z, (0.97, 1.03), (0.4, 0.6)),
    "falls by four decades": (10 ** (-4 * K / COUNT) * np.exp(0.2 * Z), (0.95, 1.05), (0.3, 0.6)),
    "falls, views": (10 ** (-4 * K / COUNT) * (1 + 0.2 * VIEWS), (0.95, 1.05), (0.3, 0.6)),
    "falls without noise": (10 ** (-4 * K / COUNT), (0.95, 1.05), (0.0, 0.1)),
    "falls fast, then noise": (np.exp(-K / 30) + 0.1 + 0.01 * Z, (0.95, 1.05), (0.4, 0.6)),
    "rises by four decades": (10 ** (4 * K / COUNT) * np.exp(0.2 * Z), (0.95, 1.05), (0.4, 0.6)),
    "a few views": (0.1 + 0.02 * VIEWS, (0.95, 1.05), (0.35, 0.65)),
    "heavy tails": (1 + 0.1 * HEAVY, (0.95, 1.05), (0.4, 0.65)),
    "skewed": (np.exp(Z), (0.95, 1.05), (0.35, 0.6)),
    "two levels at random": (5 + (Z > 0) + 0.02 * HEAVY.clip(-3, 3), (0.95, 1.05), (0.0, 0.5)),
    "up by 100 deviations": (5 + 0.3 * Z + 30 * (K > 1_500), (0.95, 1.05), (0.4, 0.6)),
    "down by 100 deviations": (50 + 0.3 * Z - 30 * (K > 1_500), (0.95, 1.05), (0.4, 0.6)),
    "a spike at once": (spiked(0), (0.95, 1.05), (0.4, 0.6)),
    "a spike while measuring": (spiked(60), (0.97, 1.03), (0.4, 0.6)),
    "a spike later": (spiked(1_000), (0.97, 1.03), (0.4, 0.6)),
    "negative": (-5 + 0.3 * Z, (0.97, 1.03), (0.4, 0.6)),
    "far from zero": (1e8 + 0.3 * Z, (0.97, 1.03), (0.4, 0.6)),
}


def run(energies: np.ndarray) -> tuple[np.ndarray, EnergyHistogram]:
    histogram = EnergyHistogram()
    nus = [float(histogram.observe(energy)) for energy in energies.tolist()]
    return np.array(nus[250:]), histogram


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripted_energies(name: str) -> None:
    energies, mean, deviation = SCRIPTS[name]
    nus, histogram = run(energies)
    assert mean[0] <= nus.mean() <= mean[1]
    assert deviation[0] <= nus.std() <= deviation[1]
    assert ((nus <= -1) | (nus >= 3)).mean() < 0.01
    assert float(histogram.weights.sum()) == pytest.approx(1.0)
    assert float(histogram.weights.min()) > 0


@pytest.mark.parametrize("scale", [1e-8, 1e8])
def test_the_unit_does_not_matter(scale: float) -> None:
    nus, _ = run(5 + 0.3 * Z)
    # Rounding of 3,000 steps, over slopes of up to 6 per deviation.
    np.testing.assert_allclose(run((5 + 0.3 * Z) * scale)[0], nus, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(run((5 + 0.3 * Z) * 2.0**27)[0], nus)


@pytest.mark.parametrize("value", [0.0, 1e-30, 0.25, 1e30, -3.0])
def test_a_constant_energy_gives_one(value: float) -> None:
    nus, _ = run(np.full(1_000, value))
    np.testing.assert_allclose(nus, 1.0, rtol=0, atol=1e-12)


def test_an_energy_that_begins_to_vary_is_followed() -> None:
    """Exactly constant for 1,000 energies, as when a training renders nothing yet."""
    nus, _ = run(np.where(K < 1_000, 0.25, 0.25 + 0.01 * Z))
    np.testing.assert_allclose(nus[:750], 1.0, rtol=0, atol=1e-12)
    late = nus[1_750:]  # 1,000 energies later
    assert 0.95 < late.mean() < 1.05
    assert 0.4 < late.std() < 0.6


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_an_energy_that_is_not_finite_changes_nothing(bad: float) -> None:
    """From the first one on, while the deviation is being measured, and after."""
    for make in (EnergyHistogram, EnergyHistogram.paper):
        clean, dirty = make(warmup=20), make(warmup=20)
        dirty.observe(bad)
        for k in range(60):
            if k in (3, 15, 40):
                nu = dirty.observe(torch.tensor(bad))
                assert nu == dirty.multiplier
                assert dirty.last_finite is False
            for histogram in (clean, dirty):
                histogram.observe(0.1 + 0.01 * math.sin(k))
        assert dirty.last_finite is True
        assert {**dirty.state_dict(), "num_observed": 60} == clean.state_dict()


@pytest.mark.parametrize("far", [-1e300, -1e12, 1e12, 1e300])
@pytest.mark.parametrize("make", [EnergyHistogram, EnergyHistogram.paper])
def test_energies_that_are_far_off(make: Callable[..., EnergyHistogram], far: float) -> None:
    """The end partitions are open: nu is near 1 there, and the weights stay weights."""
    histogram = make(warmup=20)
    for k in range(60):
        histogram.observe(0.1 + 0.01 * math.sin(k * k))
    assert float(histogram.observe(far)) == pytest.approx(1.0, abs=0.3)
    for _ in range(200):
        assert math.isfinite(float(histogram.observe(far)))
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12
    assert float(histogram.weights.min()) > 0
    assert math.isfinite(float(histogram.observe(0.1)))


@pytest.mark.parametrize(
    "updates", [2_000, pytest.param(1_000_000, marks=pytest.mark.slow, id="million")]
)
def test_sum_of_the_weights_does_not_drift(updates: int) -> None:
    """With one energy nearly always, which drives the other partitions down."""
    for histogram in (EnergyHistogram(), EnergyHistogram.paper(warmup=0)):
        energies = [torch.tensor(0.05), torch.tensor(0.1501)]
        for k in range(updates):
            histogram.observe(energies[k % 997 == 0])
        assert abs(float(histogram.weights.sum()) - 1) < 1e-9
        assert float(histogram.weights.min()) > 0


def test_the_loss_jumps_by_1e12_at_the_switch() -> None:
    """Another loss after the switch: the histogram does not look, the step goes on."""
    histogram = EnergyHistogram(warmup=10)
    phases = PhaseScheduler(40, 20, parts=[histogram])
    x = torch.nn.Parameter(torch.ones(8, 3))
    group = {"params": [x], "lr": 0.01, "name": "means"}
    optimizer = phases.upgrade({"means": torch.optim.Adam([group])})["means"]
    before: dict = {}
    for iteration in range(40):
        loss = (x * torch.cos(torch.tensor(float(iteration)))).sum()
        loss = loss * (1e12 if iteration >= 20 else 1.0)
        optimizer.zero_grad()
        loss.backward()
        phases.observe(loss)
        optimizer.step()
        if iteration == 19:
            before = histogram.state_dict()
    assert histogram.state_dict() == before
    # Adam's steps are at most sqrt(1 / (1 - beta2)) learning rates after a jump: 32
    assert float((x.detach() - 1).abs().max()) < 20 * 0.01 * 32


def test_the_loss_jumps_by_1e12_without_a_switch() -> None:
    histogram = EnergyHistogram(warmup=20)
    for k in range(60):
        histogram.observe(0.1 + 0.01 * math.sin(k))
    x = torch.nn.Parameter(torch.ones(8, 3))
    optimizer = AWSGLD([x], lr=0.01, histogram=histogram)
    draw = torch.Generator().manual_seed(0)
    for _ in range(50):
        histogram.observe(1e11)
        x.grad = 1e12 * torch.randn(8, 3, generator=draw)
        optimizer.step()
    assert float((x.detach() - 1).abs().max()) < 50 * 0.01 * 3


@pytest.mark.parametrize(
    "first",
    [[], [0.3, 0.3 - 1e-6, 0.25], [0.25, 0.2501, 0.3], [0.3, 0.2999, 0.25], [9.0, 9.0, 0.2]],
)
@pytest.mark.parametrize("seed", range(3))
def test_the_first_energies_do_not_own_the_multiplier(first: list[float], seed: int) -> None:
    """The slope of an energy whose deviation is not known yet has no bound."""
    draw = torch.Generator().manual_seed(seed)
    later = 0.2 + 0.02 * torch.randn(400, generator=draw, dtype=torch.float64)
    histogram = EnergyHistogram()
    nu = [float(histogram.observe(energy)) for energy in [*first, *later.tolist()]]
    assert abs(sum(nu[250:400]) / 150 - 1) < 0.15
