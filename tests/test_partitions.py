"""The two kinds of partitions by themselves: the paper's update and the default against loops."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import LoopHistogram, MovingHistogram
from torch import Tensor

from opt3dgs_optim.parts.partitions import FLOOR, MEAN_ABS, FixedPartitions, MovingPartitions

CPU = torch.device("cpu")
Partitions: TypeAlias = FixedPartitions | MovingPartitions


def fixed(
    num_partitions: int = 8, ends: tuple[float, float] = (0.0, 1.0), **options: Any
) -> FixedPartitions:
    made = FixedPartitions(num_partitions, ends, **{"zeta": 0.75, "tau": 0.05, **options})
    made.place(CPU, torch.float64)
    return made


def moving(dtype: torch.dtype = torch.float64, zeta: float = 0.75) -> MovingPartitions:
    made = MovingPartitions(48, zeta)
    made.place(CPU, dtype)
    return made


def take(partitions: Partitions, energy: float, count: int, valid: bool = True) -> float:
    """Nu, unclamped, and the update, as `EnergyHistogram` has them made."""
    like: Any = {"dtype": partitions.state.dtype}
    value, number = torch.tensor(energy, **like), torch.tensor(float(count), **like)
    found = partitions.take(value, torch.tensor(valid), number)
    assert found.shape == ()
    return float(found)


def nus_of(partitions: Partitions, energies: Any) -> list[float]:
    return [take(partitions, float(e), k) for k, e in enumerate(energies, 1)]


def stream(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.5, 0.1, count)


# -- the paper's -----------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.one_of(st.floats(-2.0, 3.0), st.integers(0, 8).map(lambda i: i / 8)), max_size=40),
    st.sampled_from([0.0, 0.5, 0.75, 1.0]),
)
def test_the_papers_update_is_its_loops(energies: list[float], zeta: float) -> None:
    """Eighths lie exactly on the edges."""
    partitions, oracle = fixed(zeta=zeta), LoopHistogram(8, (0.0, 1.0), zeta, 0.05, 0, None)
    expected = [oracle.observe(energy) for energy in energies]
    assert nus_of(partitions, energies) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    # 40 float64 updates of well-scaled numbers
    assert partitions.weights.tolist() == pytest.approx(oracle.theta, rel=1e-12)


def test_the_first_multiplier_is_one_and_not_minus_3973() -> None:
    """Erratum: "theta(J - 1) v 1" is an index clamp."""
    assert take(fixed(200, (0.0, 0.2), tau=1.0), 0.1, 1) == 1.0


def uneven(count: int = 24) -> Tensor:
    weights = torch.rand(count, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return (weights + 0.1) / (weights + 0.1).sum()


@pytest.mark.parametrize("low", [-5.0, 0.0, 2.0])
def test_the_slope_is_the_backward_difference_of_every_inner_partition(low: float) -> None:
    for index in range(24):
        partitions = fixed(24, (low, low + 3.0))
        partitions.state = weights = uneven()
        nu = take(partitions, low + 3.0 * (index + 0.5) / 24, 1)
        slope = float((weights[index] / weights[index - 1]).log()) * 24 / 3.0
        inner = 0 < index < 23
        assert nu == pytest.approx(1 + 0.75 * 0.05 * slope if inner else 1.0, rel=1e-12)
        grown = partitions.weights - weights
        assert int(grown.argmax()) == index  # it is the one that was visited


@pytest.mark.parametrize("seen", [0, 1, 1000, 100_000])
def test_the_step_size_decays(seen: int) -> None:
    """lambda = min(1e-2, 10 / (k^0.8 + 100)), seen on the weights of four partitions."""
    partitions = fixed(4)
    take(partitions, 0.3, seen + 1)
    rate = min(1e-2, 10 / (seen**0.8 + 100)) * 0.25**0.75
    expected = [0.25 + rate * ((k == 1) - 0.25) for k in range(4)]
    assert partitions.weights.tolist() == pytest.approx(expected, rel=1e-12)


def test_a_weight_below_the_floor_is_lifted() -> None:
    partitions = fixed(10)
    partitions.state = torch.tensor([1e-300, *[1 / 9] * 9], dtype=torch.float64)
    take(partitions, 0.95, 1)
    assert float(partitions.weights[0]) == pytest.approx(FLOOR, rel=1e-6)
    assert float(partitions.weights.sum()) == pytest.approx(1.0, abs=1e-15)


def test_weights_recover_from_the_floor_however_late() -> None:
    """All weight in one partition, the others on the floor, lambda as small as it gets."""
    partitions = fixed(200, (0.0, 0.2), tau=2e-3)
    partitions.state = torch.tensor([1e-8] * 199 + [1 - 199e-8], dtype=torch.float64)
    nus = [take(partitions, 0.05, 1_000_000 + k) for k in range(300)]
    assert np.isfinite(nus).all()
    assert float(partitions.weights[49]) > 1.5e-8  # 0.05 is the 50th partition's upper edge
    assert abs(float(partitions.weights.sum()) - 1) < 1e-12


def test_theta_estimates_the_density_to_a_power() -> None:
    """theta -> p^(1 / (1 - zeta)), not the cumulative density as the paper's text says."""
    partitions = fixed(4, (0.0, 4.0), zeta=0.5, tau=1.0)
    p = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    draws = torch.multinomial(p, 4_000, replacement=True, generator=generator)
    mean = torch.zeros(4, dtype=torch.float64)
    for k, j in enumerate(draws.tolist(), 1):
        take(partitions, j + 0.5, k)
        mean += partitions.weights / 2_500 * (k > 1_500)
    # 1 / (1 - .5) = 2; deviation of the time average over 2,500 correlated draws: about 0.02.
    assert torch.allclose(mean, p**2 / (p**2).sum(), atol=0.05)


# -- the default -----------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    # Not within 1e-20 of zero: a deviation below 1e-30 is that, here.
    st.lists(st.floats(-2.0, 3.0).map(lambda e: round(e, 20)), min_size=1, max_size=40)
)
def test_the_default_is_its_loops(energies: list[float]) -> None:
    partitions, oracle = moving(), MovingHistogram(0, None)
    expected = [oracle.observe(energy) for energy in energies]
    # Rounding, over slopes of up to 1 / 0.4^2 per deviation.
    assert nus_of(partitions, energies) == pytest.approx(expected, abs=1e-9)
    mean, deviation = partitions.state[:2].tolist()
    deviation /= MEAN_ABS
    assert deviation == pytest.approx(oracle.deviation, rel=1e-9, abs=1e-15)
    assert mean == pytest.approx(oracle.mean, rel=1e-9, abs=1e-8 * deviation)


def test_the_default_is_its_loops_when_it_forgets() -> None:
    """After a hundred energies the oldest weigh less and less."""
    oracle = MovingHistogram(0, None)
    expected = [oracle.observe(energy) for energy in stream(300).tolist()]
    assert nus_of(partitions := moving(), stream(300)) == pytest.approx(expected, abs=1e-9)
    assert partitions.state[3:].tolist() == pytest.approx(oracle.q.tolist(), abs=1e-12)


def test_theta_is_a_power_of_the_density_and_an_even_share() -> None:
    """Theta = q^(1 / (1 - zeta)), and nu does not depend on that exponent."""
    flat, steep = moving(zeta=0.5), moving(zeta=0.75)
    assert nus_of(flat, stream(60)) == nus_of(steep, stream(60))
    q = 0.95 * steep.state[3:] + 0.05 / 48
    torch.testing.assert_close(steep.weights, q**4 / (q**4).sum(), rtol=1e-9, atol=0)
    torch.testing.assert_close(flat.weights, q**2 / (q**2).sum(), rtol=1e-9, atol=0)


RANDOM = np.random.default_rng(2)
SCRIPTS = {
    "stationary": RANDOM.normal(0.5, 0.1, 200),
    "falling": np.exp(-np.arange(200) / 50 + 0.1 * RANDOM.normal(size=200)),
    "negative": RANDOM.normal(-5, 0.3, 200),
    "few digits": np.round(RANDOM.normal(0.5, 0.1, 200), 2),
    "spike at once": np.r_[300, 1, RANDOM.normal(0.5, 0.1, 198)],
    "spike after three alike": np.r_[0.5, 0.5, 0.5, 300, RANDOM.normal(0.5, 0.1, 196)],
}


@pytest.mark.parametrize("name", SCRIPTS)
def test_float32_of_a_device_has_its_digits(name: str) -> None:
    energies = torch.tensor(SCRIPTS[name], dtype=torch.float32)  # the same numbers for both
    found, expected = (nus_of(moving(dtype), energies) for dtype in (torch.float32, torch.float64))
    # Exponents of up to 100 in float32, before softmax takes the largest away: 6e-6.
    assert found == pytest.approx(expected, abs=2e-5)


def test_float32_of_a_device_has_the_papers_digits() -> None:
    narrow, wide = fixed(200, (0.0, 0.2), tau=2e-3), fixed(200, (0.0, 0.2), tau=2e-3)
    narrow.place(CPU, torch.float32)
    energies = torch.tensor(0.1 + 0.02 * RANDOM.normal(size=600), dtype=torch.float32)
    found, expected = nus_of(narrow, energies), nus_of(wide, energies)
    # An energy on an edge, to rounding, is of either partition; otherwise slopes of 1.5 / 1e-3.
    same = np.isclose(found, expected, atol=1e-3)
    assert same.mean() > 0.99


# -- both ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [fixed, moving])
@pytest.mark.parametrize("before", [0, 1, 3, 40])
def test_an_energy_that_is_not_finite_leaves_the_state(make: Any, before: int) -> None:
    partitions = make()
    nus_of(partitions, stream(before))
    state = partitions.state.clone()
    for bad in (math.nan, math.inf, -math.inf):
        take(partitions, bad, before, valid=False)
        assert torch.equal(partitions.state, state)
    clean = make()
    nus_of(clean, stream(before))
    for k, energy in enumerate(stream(20, seed=1), before + 1):
        assert take(partitions, energy, k) == take(clean, energy, k)


@pytest.mark.parametrize("make", [fixed, moving])
def test_nothing_is_read_back(make: Any) -> None:
    """On torch's device without memory whatever reads a number raises."""
    partitions = make()
    meta = torch.device("meta")
    partitions.place(meta, torch.float32)
    value = torch.empty((), device="meta")
    nu = partitions.take(value, torch.isfinite(value), value)
    for each in (nu, partitions.state, partitions.weights):
        assert (each.device, each.dtype) == (meta, torch.float32)


@pytest.mark.parametrize("make", [fixed, moving])
def test_states_that_fit(make: Any) -> None:
    partitions = make()
    assert partitions.fits(partitions.state.tolist())  # before the first energy
    nus_of(partitions, stream(30))
    state = partitions.state.tolist()
    assert partitions.fits(state)
    for place in (-1, -2):
        for wrong in (-0.01, 0.5):
            assert not partitions.fits([*state[:place], wrong, *state[place:][1:]])


def test_a_weight_of_zero_fits_the_density_alone() -> None:
    assert not fixed(4).fits([0.0, 0.5, 0.25, 0.25])
    assert moving().fits([0.5, 0.1, 0.0, 0.0, 1.0, *[0.0] * 46])
    assert not moving().fits([0.5, 0.0, 0.0, 0.0, 1.0, *[0.0] * 46])  # no deviation
