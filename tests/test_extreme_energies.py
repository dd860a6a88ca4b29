"""Energies at the edge of what can be computed: far off, constant, tiny, huge, broken, jumping."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from trainers import (
    everything,
    gsplat_optimizers,
    make_splats,
    view_loss,
)

from opt3dgs_optim import AWSGLD, EnergyHistogram


def points(rows: int = 8) -> Tensor:
    return torch.nn.Parameter(torch.ones(rows, 3))


def rows_of_noise(steps: int, rows: int = 8, seed: int = 0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(rows, 3, generator=generator) for _ in range(steps)]


def calm(histogram: EnergyHistogram, steps: int = 60) -> EnergyHistogram:
    for k in range(steps):
        histogram.observe(0.1 + 0.01 * math.sin(k))
    return histogram


@pytest.mark.parametrize("far", [-1e12, -1.0, 1e12, 1e149])
def test_energy_outside_of_the_range(far: float) -> None:
    """The end partitions are open: nu is 1 there, and the weights stay weights."""
    histogram = calm(EnergyHistogram(warmup=20))
    for _ in range(200):
        assert float(histogram.observe(far)) == 1.0
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12
    assert float(histogram.weights.min()) > 0
    assert math.isfinite(float(histogram.observe(0.1)))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e200, -1e300])
@pytest.mark.parametrize("energy", ["raw", "ema", "view_centered"])
def test_energy_that_cannot_be_squared_changes_nothing(bad: float, energy: Any) -> None:
    """From the first one on, while the range is being measured, and after."""
    clean = EnergyHistogram(warmup=20, energy=energy)
    dirty = EnergyHistogram(warmup=20, energy=energy)
    dirty.observe(bad, view=0)
    for k in range(60):
        if k in (3, 15, 40):
            dirty.observe(bad, view=0)
            assert not bool(dirty.last_finite)
        for histogram in (clean, dirty):
            histogram.observe(0.1 + 0.01 * math.sin(k), view=k % 3)
    ours, theirs = dirty.state_dict(), clean.state_dict()
    if energy == "view_centered":  # the first bad energy gave view 0 its place, nothing else
        assert ours["views"]["views"][0] == theirs["views"]["views"][0]
    del ours["num_observed"], theirs["num_observed"]
    assert ours == theirs


@pytest.mark.parametrize("value", [0.0, 1e-30, 0.25, 1e30, -3.0])
def test_constant_energy(value: float) -> None:
    histogram = EnergyHistogram(warmup=20)
    for _ in range(200):
        nu = float(histogram.observe(value))
        assert -5 <= nu <= 5
    low, high = histogram.calibrated_range
    assert low <= value <= high
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12


@pytest.mark.parametrize("scale", [2.0**-100, 2.0**-40, 2.0**40, 2.0**100])
def test_loss_scale_leaves_nu_alone(scale: float) -> None:
    """An automatic range and temperature are in the loss's own units: 1e-30 to 1e30."""
    nus = []
    for unit in (1.0, scale):
        histogram = EnergyHistogram(warmup=50)
        stream = (0.1 + 0.02 * math.sin(k * k) for k in range(300))
        nus.append([float(histogram.observe(energy * unit)) for energy in stream])
    assert nus[0] == nus[1]
    assert len({round(nu, 6) for nu in nus[0]}) > 50


def test_energy_jumps_by_1e12_at_the_switch() -> None:
    """Another loss after the switch: the histogram does not look, the step goes on."""
    splats = make_splats()
    histogram = EnergyHistogram(warmup=10)
    phases = everything(40, 20, multiplier=histogram)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    before: dict = {}
    for iteration in range(40):
        loss = view_loss(splats, iteration % 5, phases) * (1e12 if iteration >= 20 else 1.0)
        loss.backward()
        phases.observe(loss)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        if iteration == 19:
            before = histogram.state_dict()
    assert histogram.state_dict() == before
    for name, param in splats.items():
        assert bool(torch.isfinite(param).all())
        # Adam's steps are at most sqrt(1 / (1 - beta2)) learning rates after a jump: 32
        assert float(param.detach().abs().max()) < 10, name


def test_energy_jumps_by_1e12_without_a_switch() -> None:
    histogram = calm(EnergyHistogram(warmup=20))
    x = points()
    optimizer = AWSGLD([x], lr=0.01, histogram=histogram)
    for g in rows_of_noise(50):
        histogram.observe(1e11)
        x.grad = g * 1e12
        optimizer.step()
    assert bool(torch.isfinite(x).all())
    assert float((x.detach() - 1).abs().max()) < 50 * 0.01 * 5


@pytest.mark.parametrize(
    "updates", [2_000, pytest.param(1_000_000, marks=pytest.mark.slow, id="million")]
)
def test_sum_of_the_weights_does_not_drift(updates: int) -> None:
    """With one constant energy, which drives the other partitions to the floor."""
    histogram = EnergyHistogram.paper(warmup=0, step_size=0.05)
    energies = [torch.tensor(0.05), torch.tensor(0.1501)]
    for k in range(updates):
        histogram.observe(energies[k % 997 == 0])
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12  # renormalised in each update
    assert float(histogram.weights.min()) >= 0.9e-8
