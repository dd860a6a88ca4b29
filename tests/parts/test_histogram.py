"""The flat histogram: the paper's update against loops, the default against what it promises."""

from __future__ import annotations

import io
import math
import pickle
import re
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import LoopHistogram, MovingHistogram
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from opt3dgs_optim import Course, EnergyHistogram, cuda, partitions
from opt3dgs_optim.parts import histogram as module

FIXED: dict[str, Any] = {"energy_range": (0.0, 1.0), "temperature": 0.05, "warmup": 0}
MOVING: dict[str, Any] = {"warmup": 8}
ENERGIES = st.one_of(
    st.floats(-2.0, 3.0),
    st.integers(0, 8).map(lambda i: i / 8),  # exactly on the edges
    st.sampled_from([math.nan, math.inf, -math.inf, 1e149, -1e149]),
)


class OnDevice(EnergyHistogram):
    """A histogram for which the CPU is a device: the host is not told which energies are finite."""

    def _allocate(self, device: torch.device) -> None:
        with mock.patch.object(module, "_is_host", return_value=False):
            super()._allocate(device)


class NothingIsReadBack(TorchDispatchMode):
    """AssertionError where the host reads a tensor, for which it would wait for a device."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        name = str(func)
        waiting = ("_local_scalar_dense", "is_nonzero", "nonzero", "equal.", "masked_select")
        assert not any(word in name for word in waiting), name
        if name == "aten.index.Tensor":  # the host counts a mask
            assert all(index.dtype == torch.int64 for index in args[1])
        return func(*args, **(kwargs or {}))


def stream(count: int, seed: int = 0) -> list[float]:
    """Losses around 0.5, no two alike."""
    return np.random.default_rng(seed).normal(0.5, 0.1, count).tolist()


def nus_of(histogram: EnergyHistogram, energies: Any) -> np.ndarray:
    return np.array([float(histogram.observe(energy)) for energy in energies])


@pytest.mark.parametrize("kind", [EnergyHistogram, OnDevice])
@pytest.mark.parametrize("options", [{}, FIXED], ids=["moving", "fixed"])
def test_a_pickled_one_goes_on_as_its_original(
    options: dict[str, Any], kind: type[EnergyHistogram]
) -> None:
    histogram = kind(**{"warmup": 4, **options})
    nus_of(histogram, stream(40))
    twin = pickle.loads(pickle.dumps(histogram))
    assert twin.state_dict() == histogram.state_dict()
    later = [nus_of(each, stream(40, seed=1)) for each in (histogram, twin)]
    assert later[0].tolist() == later[1].tolist()
    assert twin.state_dict() == histogram.state_dict()
    assert repr(twin) == repr(histogram)


# -- the paper's update ----------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(st.lists(ENERGIES, max_size=60), st.sampled_from([None, (-5.0, 5.0), (0.25, 4.0)]))
def test_the_papers_update_is_its_loops(
    energies: list[float], clamp: tuple[float, float] | None
) -> None:
    histogram = EnergyHistogram(8, (0.0, 1.0), temperature=0.05, warmup=3, clamp=clamp)
    oracle = LoopHistogram(8, (0.0, 1.0), 0.75, 0.05, 3, clamp)
    for energy in energies:
        nu, expected = float(histogram.observe(energy)), oracle.observe(energy)
        if math.isfinite(energy):
            assert nu == pytest.approx(expected, rel=1e-9, abs=1e-9)
    # 60 float64 updates of well-scaled numbers
    assert histogram.weights.tolist() == pytest.approx(oracle.theta, rel=1e-12)


def test_first_multiplier_is_one_and_not_minus_3973() -> None:
    """Erratum: "theta(J - 1) v 1" is an index clamp."""
    histogram = EnergyHistogram.paper(warmup=0)
    assert float(histogram.observe(0.1)) == 1.0


def test_the_papers_settings() -> None:
    histogram = EnergyHistogram.paper()
    assert histogram.coordinates[:2] == pytest.approx((0.0, 0.2))
    assert (histogram.num_partitions, histogram.zeta, histogram.warmup) == (200, 0.75, 2500)
    assert histogram.clamp == (-5.0, 5.0)
    assert histogram.coordinates[2] == 2e-3
    width = 0.2 / 200
    assert histogram.zeta * histogram.coordinates[2] / width == pytest.approx(1.5)
    assert EnergyHistogram.paper(zeta=0.5).zeta == 0.5


def having(weights: Tensor, **options: Any) -> EnergyHistogram:
    """A fixed histogram with these weights, at its next energy."""
    histogram = EnergyHistogram(
        **{**FIXED, "num_partitions": len(weights), "clamp": None} | options
    )
    state = histogram.state_dict()
    histogram.load_state_dict({**state, "weights": (weights / weights.sum()).tolist()})
    return histogram


def uneven(count: int = 24) -> Tensor:
    return torch.rand(count, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.1


@pytest.mark.parametrize("index", range(24))
@pytest.mark.parametrize("low", [-5.0, 0.0, 2.0])
def test_backward_difference_of_every_partition(index: int, low: float) -> None:
    weights = uneven()
    histogram = having(weights, energy_range=(low, low + 3.0))
    nu = float(histogram.observe(low + 3.0 * (index + 0.5) / 24))
    slope = float((weights[index] / weights[index - 1]).log()) * 24 / 3.0
    inner = 0 < index < 23
    assert nu == pytest.approx(1 + 0.75 * 0.05 * slope if inner else 1.0, rel=1e-12)
    assert int((histogram.weights - weights / weights.sum()).argmax()) == index


def test_a_clamp_bounds_nu() -> None:
    weights = uneven()
    free = [float(having(weights).observe((k + 0.5) / 24)) for k in range(24)]
    held = [float(having(weights, clamp=(0.9, 1.05)).observe((k + 0.5) / 24)) for k in range(24)]
    assert held == [min(max(nu, 0.9), 1.05) for nu in free]
    assert {0.9, 1.05} < set(held)


@pytest.mark.parametrize("count", [0, 1, 1000, 100_000])
def test_the_decaying_step_size(count: int) -> None:
    """lambda = min(1e-2, 10 / (k^0.8 + 100)), seen on the weights of four partitions."""
    histogram = having(torch.ones(4, dtype=torch.float64))
    state = histogram.state_dict()
    state["scalars"][3] = float(count)
    histogram.load_state_dict(state)
    histogram.observe(0.3)
    rate = min(1e-2, 10 / (count**0.8 + 100)) * 0.25**0.75
    expected = [0.25 + rate * ((k == 1) - 0.25) for k in range(4)]
    assert histogram.weights.tolist() == pytest.approx(expected, rel=1e-12)


@pytest.mark.thorough
def test_the_papers_weights_estimate_the_density_to_the_power_of_two() -> None:
    """theta -> p^(1 / (1 - zeta)), not the cumulative density as the paper's text says."""
    histogram = EnergyHistogram(4, (0.0, 4.0), zeta=0.5, temperature=1.0, warmup=0)
    p = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    draws = torch.multinomial(p, 30_000, replacement=True, generator=generator)
    mean = torch.zeros(4, dtype=torch.float64)
    for k, j in enumerate(draws.tolist()):
        histogram.observe(j + 0.5)
        if k >= 10_000:
            mean += histogram.weights / 20_000
    expected = p**2 / (p**2).sum()  # 1 / (1 - .5) = 2
    # Deviation of the time average over 20,000 correlated draws: about 0.01.
    assert torch.allclose(mean, expected, atol=0.03)


@pytest.mark.parametrize(
    "updates", [5_000, pytest.param(1_000_000, marks=pytest.mark.slow, id="million")]
)
def test_the_papers_weights_stay_positive_with_sum_one(updates: int) -> None:
    histogram = EnergyHistogram.paper(warmup=0)
    generator = torch.Generator().manual_seed(0)
    walk = 0.1 + 0.05 * torch.linspace(0, 20, updates, dtype=torch.float64).sin()
    walk += 0.02 * torch.randn(updates, generator=generator, dtype=torch.float64)
    for energy in walk:
        histogram.observe(energy)
    assert float(histogram.weights.min()) > 0
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12


def test_the_papers_weights_recover_from_the_floor_after_a_million_updates() -> None:
    """All weight in one partition, the others on the floor, lambda as small as it gets."""
    histogram = EnergyHistogram.paper(warmup=0)
    state = histogram.state_dict()
    state["weights"] = [1e-8] * 199 + [1 - 199e-8]
    state["scalars"][3] = 1e6  # the number of finite energies so far
    histogram.load_state_dict(state)
    for _ in range(2_000):
        assert math.isfinite(float(histogram.observe(0.05)))
    assert float(histogram.weights.min()) > 0
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12
    assert float(histogram.weights[49]) > 1e-8  # 0.05 is the 50th partition's upper edge


# -- partitions that follow the energy -------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(
    # Not within 1e-100 of zero: a deviation below 1e-150 is that, here.
    st.lists(st.floats(-2.0, 3.0).map(lambda e: round(e, 100)), min_size=1, max_size=60),
    st.sampled_from([None, (-1.0, 3.0), (0.9, 1.1)]),
)
def test_the_default_is_its_loops(energies: list[float], clamp: tuple[float, float] | None) -> None:
    histogram = EnergyHistogram(warmup=4, clamp=clamp)
    oracle = MovingHistogram(4, clamp)
    for energy in energies:
        nu, expected = float(histogram.observe(energy)), oracle.observe(energy)
        # Rounding, over slopes of up to 1 / 0.4^2 per deviation.
        assert nu == pytest.approx(expected, abs=1e-9)
    low, high = histogram.coordinates[:2]
    assert (high - low) / 12 == pytest.approx(oracle.deviation, rel=1e-9)
    assert (high + low) / 2 == pytest.approx(oracle.mean, rel=1e-9, abs=1e-9 * (high - low))


def test_the_default_is_its_loops_when_it_forgets() -> None:
    """After a hundred energies the oldest weigh less and less."""
    histogram, oracle = EnergyHistogram(), MovingHistogram(250, (-1.0, 3.0))
    for energy in stream(400):
        assert float(histogram.observe(energy)) == pytest.approx(oracle.observe(energy), abs=1e-9)


def test_where_a_launch_takes_the_energy_torch_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    histogram, given = OnDevice(), []
    monkeypatch.setattr(partitions, "obstacle", lambda *_: None)
    monkeypatch.setattr(cuda, "take_energy", lambda *all: given.append(all))
    before = histogram.state_dict()
    histogram.observe(0.5)
    assert len(given) == 1
    # How far away an energy may be is the same, wherever it is taken.
    assert given[0][7] == partitions.Pace.of(partitions.MEMORY).high
    assert histogram.state_dict() == {**before, "num_observed": 1}


@pytest.mark.parametrize("zeta", [0.25, 0.5, 0.75])
def test_nus_error_is_known(zeta: float) -> None:
    """On a stationary Gaussian energy |nu - 1| = z / 2, so its deviation is 1/2 by design."""
    z = np.random.default_rng(0).normal(size=6_000)
    nus = nus_of(EnergyHistogram(zeta=zeta), 0.3 + 0.02 * z)[3_000:]
    # 3,000 draws of deviation 1/2: 0.01.
    assert nus.mean() == pytest.approx(1.0, abs=0.03)
    assert nus.std() == pytest.approx(0.5, rel=0.2)
    slope, _ = np.polyfit(z[3_000:], nus, 1)
    assert slope == pytest.approx(-0.5, rel=0.2)
    out = np.abs(z[3_000:])
    two_out = np.abs(nus - 1)[(out > 1.8) & (out < 2.2)].mean()
    assert two_out == pytest.approx(1.0, rel=0.2)


def test_zeta_is_in_theta_and_not_in_nu() -> None:
    """Theta = q^(1 / (1 - zeta)), and tau takes that exponent away again."""
    flat, steep = (EnergyHistogram(zeta=zeta) for zeta in (0.5, 0.75))
    assert nus_of(flat, stream(600)).tolist() == nus_of(steep, stream(600)).tolist()
    q = flat.weights.sqrt()
    assert torch.allclose(steep.weights, q**4 / (q**4).sum(), rtol=1e-9)
    assert flat.coordinates[2] == pytest.approx(3 * steep.coordinates[2])


def test_the_range_follows_the_energy() -> None:
    histogram = EnergyHistogram()
    nus_of(histogram, stream(600))
    low, high = histogram.coordinates[:2]
    # Mean and deviation of about 100 energies: known to 7 and 10 %.
    assert (low + high) / 2 == pytest.approx(0.5, abs=0.05)
    assert (high - low) / 12 == pytest.approx(0.1, rel=0.35)
    assert histogram.coordinates[2] == pytest.approx((high - low) / 12 / 6)
    nus_of(histogram, [0.01 * u for u in stream(2_000, seed=1)])
    low, high = histogram.coordinates[:2]
    assert (high - low) / 12 == pytest.approx(0.001, rel=0.35)


def test_weights_are_weights() -> None:
    histogram = EnergyHistogram()
    assert histogram.weights.tolist() == pytest.approx([1 / 48] * 48)
    nus_of(histogram, stream(600))
    assert float(histogram.weights.min()) > 0
    assert float(histogram.weights.sum()) == pytest.approx(1.0)
    assert 20 <= int(histogram.weights.argmax()) <= 27  # near the middle of 48


def test_nu_is_one_in_the_warm_up() -> None:
    nus = nus_of(histogram := EnergyHistogram(warmup=40), stream(200))
    assert set(nus[:40]) == {1.0}
    assert len(set(nus[40:])) > 150
    assert float(histogram.mean_multiplier) == pytest.approx(nus[40:].mean(), rel=1e-9)
    assert float(histogram.multiplier_std) == pytest.approx(nus[40:].std(), rel=1e-9)


def test_the_fixed_range_counts_after_the_warm_up_only_too() -> None:
    options: dict[str, Any] = {**FIXED, "num_partitions": 8, "warmup": 3}
    histogram = EnergyHistogram(**options)
    nus = nus_of(histogram, [0.1 + 0.09 * (k % 9) for k in range(200)])
    assert float(histogram.mean_multiplier) == pytest.approx(nus[3:].mean(), rel=1e-9)
    assert float(histogram.multiplier_std) == pytest.approx(nus[3:].std(), rel=1e-9)


# -- as a part -------------------------------------------------------------------------------------


class Operators(TorchDispatchMode):
    """Counts what torch dispatches."""

    count = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        self.count += 1
        return func(*args, **(kwargs or {}))


def test_few_operators() -> None:
    course = Course([histogram := EnergyHistogram(warmup=8)])
    nus_of(histogram, stream(20))
    energy = torch.tensor(0.4)
    with Operators() as operators:
        histogram.observe(energy, True, course)
        for _ in range(6):
            histogram.factor({}, course)
    assert operators.count <= 18


def test_a_part_of_a_course() -> None:
    course = Course([histogram := EnergyHistogram(warmup=8)], total_steps=100)
    assert histogram.factor({}, course) is None
    alone, nu = EnergyHistogram(warmup=8), 1.0
    for k, energy in enumerate(stream(30)):
        course.current = k
        course.take(torch.tensor(energy))
        nu = float(alone.observe(torch.tensor(energy)))
        assert histogram.factor({}, course) == nu
        assert ("nu" in course.numbers()) == (k >= 8)
    assert course.numbers() == {"nu": nu}
    before = histogram.state_dict()
    course.take(torch.tensor(math.nan))
    assert course.valid is False
    assert {**histogram.state_dict(), "num_observed": 30} == before


def same(there: dict[str, Any], here: dict[str, Any]) -> None:
    """AssertionError unless a device has learnt what the host has.

    All but nu, its sums and the mean of its slope bit for bit: the device does not know on the host
    that it is past the fourth energy, and adds the slope's terms in another order. That rounding is
    up to 1 / 0.4^2 deviations times the largest distance of the first four energies, 1e6, in eps.
    """
    assert set(there) == set(here)
    for name, expected in here.items():
        found = there[name]
        if name == "recent":
            assert found[:2] == expected[:2]
            assert found[2] == pytest.approx(expected[2], abs=1e-9)
            assert found[3:] == expected[3:]
        elif name in ("nu", "sums"):
            assert found == pytest.approx(expected, rel=1e-9, abs=1e-9)
        else:
            assert found == expected


@settings(max_examples=60, deadline=None)
@given(
    st.lists(ENERGIES.map(lambda e: round(e, 100) if math.isfinite(e) else e), max_size=40),
    st.sampled_from([{}, {"clamp": None}, FIXED, {**FIXED, "clamp": (1.5, 2.0)}]),
    st.integers(4, 9),
)
def test_a_device_has_learnt_what_the_host_has(
    energies: list[float], options: dict[str, Any], warmup: int
) -> None:
    """Whichever energies are finite, the first one too."""
    options = {**options, "warmup": warmup}
    here, there = EnergyHistogram(**options), OnDevice(**options)
    for energy in energies:
        value = torch.tensor(energy, dtype=torch.float64)
        expected = float(here.observe(value))
        with NothingIsReadBack():
            found = there.observe(value)
        assert float(found) == pytest.approx(expected, abs=1e-9)
        assert bool(there.last_finite) == here.last_finite
        same(there.state_dict(), here.state_dict())
    assert repr(there) == repr(here)
    assert there.weights.tolist() == here.weights.tolist()


@pytest.mark.parametrize("warmup", [4, 20])
@pytest.mark.parametrize("broken", [(0,), (0, 1, 2), (3,), (0, 5, 19, 20, 21), tuple(range(30))])
def test_the_warm_up_is_so_many_finite_energies(broken: tuple[int, ...], warmup: int) -> None:
    """And the mean begins at the first of them."""
    for options in ({}, FIXED):
        here, there = (
            kind(**{**options, "warmup": warmup}) for kind in (EnergyHistogram, OnDevice)
        )
        finite = 0
        for k, energy in enumerate(stream(60)):
            value = torch.tensor(math.nan if k in broken else energy)
            nus = [float(histogram.observe(value)) for histogram in (here, there)]
            finite += k not in broken
            assert nus[1] == pytest.approx(nus[0], abs=1e-9)
            assert there.state_dict()["num_taken"] == finite
            if finite <= warmup:
                assert nus == [1.0, 1.0]
            if finite == 1 and options is MOVING:
                low, high = there.coordinates[:2]
                assert (low + high) / 2 == float(torch.tensor(stream(60)[k]))
        assert there.state_dict()["sums"][0] == 60 - len(broken) - warmup
        assert float(there.mean_multiplier) == pytest.approx(float(here.mean_multiplier), rel=1e-9)
        assert float(there.multiplier_std) == pytest.approx(float(here.multiplier_std), abs=1e-9)


def test_what_is_not_valid_changes_nothing_to_the_last_bit() -> None:
    """Whatever number it is."""
    for options in (MOVING, FIXED):
        there = OnDevice(**options)
        for k, energy in enumerate(stream(200)):
            there.observe(torch.tensor(energy))
            before = there.state_dict()
            for value in (math.nan, math.inf, 0.7):
                kept = there.observe(torch.tensor(value), torch.tensor(False))
                assert torch.equal(kept, there.multiplier)
            after = there.state_dict()
            assert after.pop("num_observed") == before.pop("num_observed") + 3 == 4 * (k + 1)
            assert after == before


def test_an_energy_that_is_known_to_be_finite_is_one_on_a_device_too() -> None:
    told, asked = OnDevice(warmup=8), OnDevice(warmup=8)
    for energy in stream(30):
        value = torch.tensor(energy)
        with NothingIsReadBack():
            told.observe(value, True)
        asked.observe(value)
    assert told.state_dict() == asked.state_dict()


def test_an_energy_beyond_float32_counts_as_one_that_is_not_finite() -> None:
    """On a device that computes in float32, of a loss in float64."""
    with mock.patch.object(torch, "float64", torch.float32):
        there = OnDevice(warmup=4)
    nus_of(there, stream(20))
    before = there.state_dict()
    assert there.multiplier.dtype == torch.float32
    for far in (1e300, -1e300):
        there.observe(torch.tensor(far, dtype=torch.double))
    assert there.state_dict() == {**before, "num_observed": 22}


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.int32], ids=str)
def test_energies_of_few_digits(dtype: torch.dtype) -> None:
    """They are taken as the numbers that they are, by all kinds."""
    for options in (MOVING, FIXED):
        exact, here, there = (
            EnergyHistogram(**options),
            EnergyHistogram(**options),
            OnDevice(**options),
        )
        for energy in stream(60):
            value = torch.tensor(8 * energy - 5).to(dtype)  # negative ones too
            expected = float(exact.observe(float(value)))
            assert float(here.observe(value)) == expected
            assert float(there.observe(value)) == pytest.approx(expected, abs=1e-9)
        assert here.state_dict() == exact.state_dict()
        same(there.state_dict(), exact.state_dict())


@pytest.mark.parametrize("value", [0.0, 0.25, -3.0])
def test_a_constant_energy_gives_one_on_a_device(value: float) -> None:
    """A resume there too, which finds a deviation of float64 that is zero in float32."""
    here = EnergyHistogram(warmup=4)
    nus_of(here, [value] * 10)
    with mock.patch.object(torch, "float64", torch.float32):
        begun, resumed = OnDevice(warmup=4), OnDevice(warmup=4)
    assert torch.tensor(here.state_dict()["recent"][1], dtype=torch.float32) == 0
    resumed.load_state_dict(here.state_dict())
    for there in (begun, resumed):
        nus = nus_of(there, [torch.tensor(value)] * 300)
        np.testing.assert_allclose(nus, 1.0, rtol=0, atol=1e-6)  # digits of float32


def test_a_part_on_a_device_waits_for_nothing() -> None:
    course = Course([histogram := OnDevice(warmup=4)], total_steps=100)
    columns = []
    for k, energy in enumerate([math.nan, *stream(12)]):
        course.current, value = k, torch.tensor(energy)
        with NothingIsReadBack():
            valid = torch.isfinite(value)
            assert histogram.observe(value, valid, course) is histogram.multiplier
            assert histogram.factor({}, course) is histogram.multiplier
            columns.append(histogram.numbers(course))
            assert histogram.evidence(course) is not None
    # One energy early: the host counts those that are not finite, too.
    assert [len(each) for each in columns] == [0] * 4 + [1] * 9
    assert [float(each["nu"]) == 1.0 for each in columns[4:6]] == [True, False]
    assert histogram.state_dict()["num_taken"] == 12


def test_few_operators_on_a_device() -> None:
    """Where no CUDA kernel takes their place."""
    course = Course([histogram := OnDevice(warmup=8)])
    nus_of(histogram, stream(20))
    energy, valid = torch.tensor(0.4, dtype=torch.float64), torch.tensor(True)
    with Operators() as operators:
        histogram.observe(energy, valid, course)
    assert operators.count <= 32


def test_what_is_one_all_the_time_is_left_out() -> None:
    course = Course([], total_steps=1_000)
    two_levels = EnergyHistogram(20, (0.0, 1.0), temperature=1e-4, warmup=0)
    moving = EnergyHistogram(warmup=8)
    reasons: list[list[str | None]] = [[], []]
    for k, energy in enumerate(stream(1_000)):
        for said, histogram in zip(reasons, (two_levels, moving), strict=True):
            histogram.observe(energy)
            if k % 100 == 99:
                seen = histogram.evidence(course)
                assert seen is not None
                said.append(histogram.useless(seen.tolist(), course))
    assert reasons[0][:2] == [None, None]
    assert reasons[0][2] is not None
    assert re.fullmatch(r"nu was 1\.0\d+; its deviation was .* over 300 energies", reasons[0][2])
    assert set(reasons[1]) == {None}


def test_a_constant_other_than_one_stays() -> None:
    """Without it the training would go on at another learning rate."""
    weights = torch.softmax(0.5 * torch.arange(20, dtype=torch.float64), 0)
    histogram = having(weights, temperature=0.05)
    fixed = histogram.weights
    for _ in range(500):
        histogram.observe(0.5)
        histogram._law.weights.copy_(fixed)
    course = Course([], total_steps=1_000)
    seen = histogram.evidence(course)
    assert seen is not None
    assert float(histogram.multiplier_std) < 1e-6
    assert histogram.useless(seen.tolist(), course) is None


@pytest.mark.parametrize(
    ("evidence", "useless"),
    [
        ((1_000.0, 1.0, 0.0, 0.0), True),
        ((999.0, 1.0, 0.0, 0.0), False),  # a thirtieth of 30,000
        ((1_000.0, 1.0, 0.0, 0.5), True),
        ((1_000.0, 1.0, 0.0, 0.51), False),  # most of Theta lies above the range
        ((1_000.0, 1.09, 0.09, 0.0), True),
        ((1_000.0, 1.09, 0.11, 0.0), False),
        ((1_000.0, 0.89, 0.0, 0.0), False),
    ],
    ids=str,
)
def test_where_nu_does_nothing(evidence: tuple[float, ...], useless: bool) -> None:
    """By count, mean and deviation of nu, and Theta's share in the open partition at the top."""
    count, mean, deviation, above = evidence
    sums = [count, count * mean, count * (mean * mean + deviation * deviation), above]
    said = EnergyHistogram().useless(sums, Course([], total_steps=30_000))
    assert (said is not None) == useless


def test_before_anything_is_known() -> None:
    histogram = EnergyHistogram()
    assert (histogram.warmup, histogram.last_finite) == (250, True)
    assert (float(histogram.mean_multiplier), float(histogram.multiplier_std)) == (1.0, 0.0)
    histogram.observe(math.nan)
    assert (histogram.factor({}), histogram.last_finite) == (1.0, False)


def test_mean_and_deviation_of_few_and_of_equal_numbers() -> None:
    histogram = having(uneven(), temperature=0.05)
    nu = float(histogram.observe(0.3))
    assert nu != 1.0
    assert float(histogram.mean_multiplier) == pytest.approx(nu)
    deviations = []
    for equal in np.linspace(0.9, 1.1, 21):  # rounding leaves variances just below zero, too
        histogram._sums = [sum([equal**power] * 10) for power in range(3)]
        deviations.append(float(histogram.multiplier_std))
    assert deviations == pytest.approx([0.0] * 21, abs=1e-7)


# -- state -----------------------------------------------------------------------------------------

BOTH = pytest.mark.parametrize("options", [{"warmup": 50}, FIXED], ids=["moving", "fixed"])


@pytest.mark.parametrize("kind", [EnergyHistogram, OnDevice])
@BOTH
def test_resume_is_exact(options: dict[str, Any], kind: type[EnergyHistogram]) -> None:
    whole, first, second = (kind(**options) for _ in range(3))
    for k, energy in enumerate([math.nan, *stream(300)]):
        whole.observe(energy)
        (first if k < 120 else second).observe(energy)
        if k == 119:
            second.load_state_dict(first.state_dict())
            assert second.state_dict() == first.state_dict()
            assert second.factor({}) == first.factor({})
    assert whole.state_dict() == second.state_dict()
    assert whole.state_dict()["num_taken"] == 300
    assert float(whole.multiplier) == float(second.multiplier)


@BOTH
def test_what_a_device_has_saved_the_host_goes_on_with(options: dict[str, Any]) -> None:
    here, there = EnergyHistogram(**options), OnDevice(**options)
    for k, energy in enumerate([math.nan, *stream(300), math.inf]):
        here.observe(energy)
        there.observe(energy)
        if k in (0, 20, 51, 119, 200):  # there and back
            later = (EnergyHistogram if isinstance(there, OnDevice) else OnDevice)(**options)
            later.load_state_dict(there.state_dict())
            same(later.state_dict(), here.state_dict())
            there = later
    same(there.state_dict(), here.state_dict())


def test_a_checkpoint_that_has_counted_too_many_loads() -> None:
    """Until 2026-11-25 a device counted the energies that are not finite, too."""
    histogram = EnergyHistogram(warmup=50)
    nus_of(histogram, stream(48))
    state = {**histogram.state_dict(), "num_observed": 50, "num_taken": 50}
    for kind in (EnergyHistogram, OnDevice):
        later = kind(warmup=50)
        later.load_state_dict(state)
        assert later.state_dict() == state
        assert float(later.observe(0.3)) != 1.0


@BOTH
def test_state_is_updated_in_place(options: dict[str, Any]) -> None:
    """A CUDA graph that has captured observe() and a step reads and writes the same memory."""
    histogram = EnergyHistogram(**options)
    live, kept = histogram.multiplier, []
    for energy in stream(120):
        kept.append(histogram.observe(energy))
    assert live is histogram.multiplier
    assert float(live) == float(kept[-1])
    assert len({float(nu) for nu in kept}) > 3  # what observe returned does not change later


@BOTH
def test_state_dict_is_plain_and_checked(options: dict[str, Any]) -> None:
    histogram = EnergyHistogram(**{"num_partitions": 32, **options})
    nus_of(histogram, stream(80))
    state = histogram.state_dict()
    torch.save(state, buffer := io.BytesIO())
    buffer.seek(0)
    assert torch.load(buffer, weights_only=True) == state
    with pytest.raises(ValueError, match="num_partitions=40"):
        EnergyHistogram(**{"num_partitions": 40, **options}).load_state_dict(state)
    with pytest.raises(ValueError, match="missing"):
        histogram.load_state_dict({"weights": []})
    key = "weights" if "weights" in state else "recent"
    for bad in ([math.nan] * len(state[key]), [0.0] * len(state[key]), "x", None):
        with pytest.raises(ValueError, match="load_state_dict"):
            histogram.load_state_dict({**state, key: bad})
    assert histogram.state_dict() == state


RANGES: dict[str, Any] = {
    "another high end": {"energy_range": (0.0, 0.2)},
    "another low end": {"energy_range": (-1.0, 1.0)},
    "moved": {"energy_range": (5.0, 6.0)},
    "of another unit": {"energy_range": (0.0, 1e-3)},
    "more partitions": {"num_partitions": 64},
    "fewer partitions": {"num_partitions": 30},
    "automatic": {"energy_range": "auto", "temperature": "auto", "warmup": 4},
}


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("other", RANGES)
def test_what_was_learnt_of_other_partitions_is_refused(other: str, reverse: bool) -> None:
    """Nothing is changed then; what was counted elsewhere would be read in the wrong place."""
    made = [{"num_partitions": 32, **FIXED}, {"num_partitions": 32, **FIXED, **RANGES[other]}]
    here, there = (EnergyHistogram(**options) for options in (made[::-1] if reverse else made))
    nus_of(here, stream(80))
    nus_of(there, stream(5, seed=1))
    before = there.state_dict()
    with pytest.raises(ValueError, match=r"EnergyHistogram\.load_state_dict: "):
        there.load_state_dict(here.state_dict())
    assert there.state_dict() == before


def test_the_range_may_be_rounded_and_the_temperature_is_the_present_one() -> None:
    """A device without float64 saves a range of float32; tau scales nu, and Theta is without it."""
    options: dict[str, Any] = {**FIXED, "num_partitions": 32, "energy_range": (0.1, 0.7)}
    here = EnergyHistogram(**options)
    nus_of(here, stream(80))
    state = here.state_dict()
    rounded = [float(np.float32(number)) for number in state["scalars"]]
    there = EnergyHistogram(**{**options, "temperature": 0.2})
    there.load_state_dict({**state, "scalars": rounded})
    assert there.coordinates == pytest.approx((0.1, 0.7, 0.2), rel=1e-12)
    again = EnergyHistogram(**options)
    again.load_state_dict(state)
    assert again.state_dict() == state
    energies = stream(40, seed=2)
    assert nus_of(again, energies).tolist() == nus_of(here, energies).tolist()


class Elsewhere(Tensor):
    """A tensor on another device, as far as it says."""

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return torch.device("cpu", 0)  # torch's own say "cpu" without a number


@BOTH
def test_what_has_been_learnt_moves_to_where_the_energy_is(options: dict[str, Any]) -> None:
    here, moved = (EnergyHistogram(**options) for _ in "ab")
    for k, energy in enumerate(stream(120)):
        value = torch.tensor(energy)
        there = value.as_subclass(Elsewhere) if k in (0, 10, 60, 61) else value
        assert float(here.observe(value)) == float(moved.observe(there))
    assert here.state_dict() == moved.state_dict()


@BOTH
def test_on_a_device_all_state_is_there(options: dict[str, Any]) -> None:
    histogram = EnergyHistogram(**options)
    nus_of(histogram, stream(10))
    nu = histogram.observe(torch.empty((), device="meta"))  # a device without memory
    tally = histogram._tally
    assert tally is not None
    state = (nu, histogram.multiplier, histogram.weights, tally.sums, tally.count)
    assert {each.device.type for each in state} == {"meta"}
    assert (tally.sums.shape, tally.count.shape) == ((3,), ())
    assert (tally.count.dtype, tally.warmup) == (torch.int64, histogram.warmup)
    assert histogram.factor({}) is histogram.multiplier
    assert histogram.num_observed == 11
    if isinstance(histogram._law, partitions.MovingPartitions):
        assert histogram._law._constants[-1] == 1e-30  # the smallest deviation in float32


# -- options ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {**FIXED, "num_partitions": 3},
        {**FIXED, "zeta": 0.0},
        {**FIXED, "zeta": 1.0},
        {**FIXED, "temperature": 0.0},
        {"num_partitions": 24},
        {"warmup": 4},
        {"zeta": 0.01},
    ],
    ids=str,
)
def test_the_ends_of_what_is_allowed_work(options: dict[str, Any]) -> None:
    histogram = EnergyHistogram(**options)
    assert np.isfinite(nus_of(histogram, stream(30))).all()
    assert float(histogram.weights.sum()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_partitions": 23}, "num_partitions=23"),
        ({**FIXED, "num_partitions": 2}, "num_partitions=2"),
        ({**FIXED, "num_partitions": 8.0}, "num_partitions=8.0"),
        ({**FIXED, "energy_range": (1.0, 0.0)}, "low < high"),
        ({**FIXED, "energy_range": (0.0, math.inf)}, "energy_range"),
        ({"energy_range": "automatic"}, "'automatic'"),
        ({"energy_range": (0.0, 1.0)}, "both are numbers"),
        ({"temperature": 0.1}, "both are 'auto'"),
        ({"temperature": "hot"}, "'hot'"),
        ({**FIXED, "zeta": 1.5}, "zeta=1.5"),
        ({"zeta": 0.0}, "zeta=0.0"),
        ({"zeta": 1.0}, "zeta=1.0"),
        ({**FIXED, "temperature": -1.0}, "temperature=-1.0"),
        ({"warmup": 3}, "warmup=3"),
        ({**FIXED, "warmup": -1}, "warmup=-1"),
        ({"clamp": (5.0, -5.0)}, "clamp"),
        ({"clamp": "narrow"}, "clamp"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        EnergyHistogram(**options)
    assert "EnergyHistogram" in str(error.value)


def test_energy_must_be_one_number() -> None:
    with pytest.raises(ValueError, match=re.escape("(2,)")):
        EnergyHistogram().observe(torch.zeros(2))


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
@BOTH
def test_an_energy_of_one_element(options: dict[str, Any], shape: tuple[int, ...]) -> None:
    assert EnergyHistogram(**options).observe(torch.full(shape, 0.5)).shape == ()


@BOTH
def test_keeps_no_graph(options: dict[str, Any]) -> None:
    loss = torch.tensor(0.1, requires_grad=True) * 1
    assert not EnergyHistogram(**options).observe(loss).requires_grad


def test_says_what_it_is() -> None:
    histogram = EnergyHistogram(warmup=10)
    assert repr(histogram) == (
        "EnergyHistogram(zeta=0.75, clamp=(-1.0, 3.0)): nu 1, warm-up: 0 of 10 energies"
    )
    nus_of(histogram, stream(10))
    assert repr(histogram).endswith(": nu 1, warm-up: 10 of 10 energies")
    nus_of(histogram, stream(100))
    assert re.search(r": nu [\d.]+, mean [\d.]+ \+- [\d.]+$", repr(histogram))
    assert "energy_range=(0.0, 0.2), temperature=0.002" in repr(EnergyHistogram.paper())
