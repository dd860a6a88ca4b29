"""`EnergyHistogram` and its partitions: against loops, on scripted energies, in a training."""

from __future__ import annotations

import copy
import json
import math
import pickle
import re
from typing import Any

import numpy as np
import pytest
import torch
from gaussians import through_a_file
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import LoopHistogram, MovingHistogram

from opt3dgs_optim import EnergyHistogram, PhaseScheduler, Training
from opt3dgs_optim.parts.partitions import FLOOR, MEAN_ABS, FixedPartitions, MovingPartitions
from opt3dgs_optim.step import Step

FIXED: dict[str, Any] = {"energy_range": (0.0, 1.0), "temperature": 0.05, "warmup": 4}
KINDS = pytest.mark.parametrize("options", [{}, FIXED], ids=["moving", "fixed"])


def stream(count: int, seed: int = 0) -> list[float]:
    """Losses around 0.5, no two alike."""
    return np.random.default_rng(seed).normal(0.5, 0.1, count).tolist()


def nus_of(histogram: EnergyHistogram, energies: Any) -> np.ndarray:
    return np.array([float(histogram.observe(energy)) for energy in energies])


# -- the paper's partitions, and the default's, by themselves --------------------------------------


def fixed(
    num_partitions: int = 8, ends: tuple[float, float] = (0.0, 1.0), **options: Any
) -> FixedPartitions:
    made = FixedPartitions(num_partitions, ends, **{"zeta": 0.75, "tau": 0.05, **options})
    made.place(torch.device("cpu"), torch.float64)
    return made


def moving(dtype: torch.dtype = torch.float64, zeta: float = 0.75) -> MovingPartitions:
    made = MovingPartitions(48, zeta)
    made.place(torch.device("cpu"), dtype)
    return made


def take(partitions: Any, energy: float, count: int) -> float:
    """Nu, unclamped, and the update, as `EnergyHistogram` has them made."""
    like: Any = {"dtype": partitions.state.dtype}
    value, number = torch.tensor(energy, **like), torch.tensor(float(count), **like)
    found = partitions.take(value, torch.tensor(True), number)
    assert found.shape == ()
    return float(found)


def taken(partitions: Any, energies: Any) -> list[float]:
    return [take(partitions, float(energy), k) for k, energy in enumerate(energies, 1)]


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.one_of(st.floats(-2.0, 3.0), st.integers(0, 8).map(lambda i: i / 8)), max_size=40),
    st.sampled_from([0.0, 0.5, 0.75, 1.0]),
)
def test_the_papers_update_is_its_loops(energies: list[float], zeta: float) -> None:
    """Eighths lie exactly on the edges."""
    partitions, oracle = fixed(zeta=zeta), LoopHistogram(8, (0.0, 1.0), zeta, 0.05, 0, None)
    expected = [oracle.observe(energy) for energy in energies]
    assert taken(partitions, energies) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    # 40 float64 updates of well-scaled numbers
    assert partitions.weights.tolist() == pytest.approx(oracle.theta, rel=1e-12)


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


@settings(max_examples=40, deadline=None)
@given(
    # Not within 1e-20 of zero: a deviation below 1e-30 is that, here.
    st.lists(st.floats(-2.0, 3.0).map(lambda e: round(e, 20)), min_size=1, max_size=40)
)
def test_the_default_is_its_loops(energies: list[float]) -> None:
    partitions, oracle = moving(), MovingHistogram(0, None)
    expected = [oracle.observe(energy) for energy in energies]
    # Rounding, over slopes of up to 1 / 0.4^2 per deviation.
    assert taken(partitions, energies) == pytest.approx(expected, abs=1e-9)
    mean, deviation = partitions.state[:2].tolist()
    deviation /= MEAN_ABS
    assert deviation == pytest.approx(oracle.deviation, rel=1e-9, abs=1e-15)
    assert mean == pytest.approx(oracle.mean, rel=1e-9, abs=1e-8 * deviation)


def test_the_default_is_its_loops_when_it_forgets() -> None:
    """After a hundred energies the oldest weigh less and less."""
    oracle = MovingHistogram(0, None)
    expected = [oracle.observe(energy) for energy in stream(300)]
    assert taken(partitions := moving(), stream(300)) == pytest.approx(expected, abs=1e-9)
    assert partitions.state[3:].tolist() == pytest.approx(oracle.q.tolist(), abs=1e-12)


def test_theta_is_a_power_of_the_density_and_an_even_share() -> None:
    """Theta = q^(1 / (1 - zeta)), and nu does not depend on that exponent."""
    flat, steep = moving(zeta=0.5), moving(zeta=0.75)
    assert taken(flat, stream(60)) == taken(steep, stream(60))
    q = 0.95 * steep.state[3:] + 0.05 / 48
    torch.testing.assert_close(steep.weights, q**4 / (q**4).sum(), rtol=1e-9, atol=0)
    torch.testing.assert_close(flat.weights, q**2 / (q**2).sum(), rtol=1e-9, atol=0)


DIGITS = np.random.default_rng(2)
NARROW = {
    "stationary": DIGITS.normal(0.5, 0.1, 200),
    "falling": np.exp(-np.arange(200) / 50 + 0.1 * DIGITS.normal(size=200)),
    "negative": DIGITS.normal(-5, 0.3, 200),
    "few digits": np.round(DIGITS.normal(0.5, 0.1, 200), 2),
    "spike at once": np.r_[300, 1, DIGITS.normal(0.5, 0.1, 198)],
    "spike after three alike": np.r_[0.5, 0.5, 0.5, 300, DIGITS.normal(0.5, 0.1, 196)],
}


@pytest.mark.parametrize("name", NARROW)
def test_float32_of_a_device_has_its_digits(name: str) -> None:
    energies = torch.tensor(NARROW[name], dtype=torch.float32)  # the same numbers for both
    found, expected = (taken(moving(dtype), energies) for dtype in (torch.float32, torch.float64))
    # Exponents of up to 100 in float32, before softmax takes the largest away: 6e-6.
    assert found == pytest.approx(expected, abs=2e-5)


# -- scripted energies with known answers ----------------------------------------------------------


COUNT, FIRST = 1_000, 250
K = np.arange(COUNT)
RANDOM = np.random.default_rng(1)
Z, HEAVY = RANDOM.normal(size=COUNT), RANDOM.standard_t(2, size=COUNT)
VIEWS = RANDOM.normal(size=40)[RANDOM.permuted(np.tile(np.arange(40), (25, 1)), axis=1).ravel()]
FALL = 10 ** (-4 * K / 3_000)


def spiked(at: int) -> np.ndarray:
    """One energy 1,000 deviations off."""
    energies = 5 + 0.3 * Z
    energies[at] += 300
    return energies


# name: (energies, bounds of nu's mean, bounds of its deviation), from the 250th energy on. By
# design they are 1 and 1/2 for a Gaussian, which 750 draws and a memory of 100 know to 0.05. The
# deviation that a jump leaves is forgotten by a hundredth an energy, and nu is nearer to 1 so long.
SCRIPTS: dict[str, tuple[np.ndarray, tuple[float, float], tuple[float, float]]] = {
    "stationary": (5 + 0.3 * Z, (0.95, 1.05), (0.4, 0.6)),
    "falls by a decade": (FALL * np.exp(0.2 * Z), (0.95, 1.05), (0.3, 0.6)),
    "falls without noise": (FALL, (0.95, 1.05), (0.0, 0.1)),
    "falls fast, then noise": (np.exp(-K / 30) + 0.1 + 0.01 * Z, (0.95, 1.1), (0.35, 0.6)),
    "a few views": (0.1 + 0.02 * VIEWS, (0.95, 1.05), (0.35, 0.65)),
    "heavy tails": (1 + 0.1 * HEAVY, (0.95, 1.05), (0.4, 0.65)),
    "skewed": (np.exp(Z), (0.95, 1.05), (0.35, 0.6)),
    "down by 100 deviations": (50 + 0.3 * Z - 30 * (K > 600), (0.95, 1.1), (0.3, 0.6)),
    "a spike at once": (spiked(0), (0.95, 1.05), (0.4, 0.6)),
    "a spike later": (spiked(500), (0.95, 1.05), (0.4, 0.6)),
    "far from zero": (1e8 + 0.3 * Z, (0.95, 1.05), (0.4, 0.6)),
}


def run(energies: np.ndarray, **options: object) -> tuple[np.ndarray, EnergyHistogram]:
    histogram = EnergyHistogram(**options)  # pyright: ignore[reportArgumentType]
    nus = [float(histogram.observe(energy)) for energy in energies.tolist()]
    return np.array(nus[FIRST:]), histogram


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripted_energies(name: str) -> None:
    energies, mean, deviation = SCRIPTS[name]
    nus, histogram = run(energies)
    assert mean[0] <= nus.mean() <= mean[1]
    assert deviation[0] <= nus.std() <= deviation[1]
    assert ((nus <= -1) | (nus >= 3)).mean() < 0.01
    assert float(histogram.weights.sum()) == pytest.approx(1.0)
    assert float(histogram.weights.min()) > 0


@pytest.mark.parametrize("unit", [2.0**-40, 2.0**40])
def test_the_unit_does_not_matter(unit: float) -> None:
    """A loss scaled by 1e-12 or 1e12."""
    energies = 5 + 0.3 * Z[:400]
    np.testing.assert_array_equal(run(energies * unit)[0], run(energies)[0])


@pytest.mark.parametrize("value", [0.0, 1e-30, 0.25, 1e30, -3.0])
def test_a_constant_energy_gives_one(value: float) -> None:
    nus, _ = run(np.full(300, value))
    np.testing.assert_allclose(nus, 1.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize("far", [-1e300, -1e12, 1e12, 1e300])
@pytest.mark.parametrize("make", [EnergyHistogram, EnergyHistogram.paper])
def test_energies_that_are_far_off(make: type[EnergyHistogram], far: float) -> None:
    """The end partitions are open: nu is near 1 there, and the weights stay weights."""
    histogram = make(warmup=20)
    for k in range(60):
        histogram.observe(0.1 + 0.01 * math.sin(k * k))
    assert float(histogram.observe(far)) == pytest.approx(1.0, abs=0.3)
    for _ in range(60):
        assert math.isfinite(float(histogram.observe(far)))
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12
    assert float(histogram.weights.min()) > 0
    assert math.isfinite(float(histogram.observe(0.1)))


@pytest.mark.parametrize("first", [[], [0.3, 0.3 - 1e-6, 0.25], [0.25, 0.2501, 0.3], [9, 9, 0.2]])
def test_the_first_energies_do_not_own_the_multiplier(first: list[float]) -> None:
    """The slope of an energy whose deviation is not known yet has no bound."""
    nus, _ = run(np.r_[first, 0.2 + 0.02 * Z[:400]])
    assert abs(nus[:150].mean() - 1) < 0.15


# -- what it says of nu ----------------------------------------------------------------------------


@pytest.mark.parametrize("clamp", [None, (0.9, 1.1)])
@KINDS
def test_clamp_and_warm_up_are_those_of_the_loops(options: dict[str, Any], clamp: Any) -> None:
    fixed = LoopHistogram(40, (0.0, 1.0), 0.75, 0.05, 20, clamp)  # half a temperature wide
    oracle: Any = fixed if options else MovingHistogram(20, clamp)
    histogram = EnergyHistogram(**{**options, "clamp": clamp, "warmup": 20})
    energies = stream(120)
    nus = nus_of(histogram, energies)
    np.testing.assert_allclose(nus, [oracle.observe(e) for e in energies], rtol=0, atol=1e-9)
    assert set(nus[:20]) == {1.0}
    assert len(set(nus[20:].round(12))) > (5 if clamp else 80)
    assert float(histogram.mean_multiplier) == pytest.approx(nus[20:].mean(), rel=1e-9)
    assert float(histogram.multiplier_std) == pytest.approx(nus[20:].std(), rel=1e-9)
    assert float(histogram.multiplier) == nus[-1]


def test_moments_of_nu_before_there_are_any() -> None:
    histogram, training = EnergyHistogram(warmup=9), Training([])
    nus_of(histogram, stream(9))
    moments = histogram.mean_multiplier, histogram.multiplier_std, histogram.multiplier
    assert [float(each) for each in moments] == [1.0, 0.0, 1.0]
    assert histogram.numbers(training) == {}
    nu = float(histogram.observe(0.7))
    assert nu != 1.0
    assert histogram.numbers(training) == {"nu": nu}
    assert float(histogram.mean_multiplier) == nu


# -- in a training ---------------------------------------------------------------------------------


def test_after_the_switch_it_looks_no_more_and_tells_no_nu() -> None:
    x = torch.nn.Parameter(torch.zeros(4, 3))
    phases = PhaseScheduler(30, parts=[histogram := EnergyHistogram(warmup=4)], switch=2 / 3)
    adam, learnt = phases.upgrade(torch.optim.Adam([{"params": [x], "name": "means"}])), []
    for step, energy in enumerate(stream(30), 1):
        phases.observe(torch.tensor(energy))
        x.grad = torch.ones(4, 3)
        adam.step()
        learnt.append(histogram.state_dict())
        nu = {"nu": float(histogram.multiplier)}
        assert phases.numbers() == (nu if 4 < step <= 20 else {})
    assert learnt[-1] == learnt[19]  # the next loss may be another: `SquaredLoss` squares it


@KINDS
def test_on_a_device_nu_stays_there(options: dict[str, Any]) -> None:
    """On torch's device without memory whatever reads a number raises; it moves there first."""
    histogram = EnergyHistogram(**options)
    nus_of(histogram, stream(10))
    energy = torch.empty((), device="meta")
    nu, training = histogram.observe(energy), Training([], 10)
    step = Step(torch.zeros(1), torch.zeros(1), "means", "", {}, {}, 0, -1)
    histogram.plan(step, training)
    for each in (nu, step.factor, histogram.mean_multiplier, histogram.multiplier_std):
        assert (each.device.type, each.dtype, each.shape) == ("meta", torch.float32, ())
    histogram.num_observed = 1_000
    assert histogram.numbers(training)["nu"] is nu


class Elsewhere(torch.Tensor):
    """A tensor on another device, as far as it says."""

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return torch.device("cpu", 0)  # torch's own say "cpu" without a number


@KINDS
def test_what_has_been_learnt_moves_to_where_the_energy_is(options: dict[str, Any]) -> None:
    here, moved = (EnergyHistogram(**options) for _ in "ab")
    for k, energy in enumerate(stream(60)):
        value = torch.tensor(energy, dtype=torch.float64)
        there = value.as_subclass(Elsewhere) if k in (0, 10, 40, 41) else value
        assert float(here.observe(value)) == float(moved.observe(there))
    assert here.state_dict() == moved.state_dict()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@KINDS
def test_an_energy_that_is_not_finite_changes_nothing(options: dict[str, Any], bad: float) -> None:
    """From the first one on, in the warm-up, and after."""
    clean, dirty = (EnergyHistogram(**{**options, "warmup": 6}) for _ in "ab")
    dirty.observe(bad)
    for k, energy in enumerate(stream(30)):
        if k in (3, 5, 20):
            assert float(dirty.observe(torch.tensor(bad))) == float(dirty.multiplier)
        assert float(dirty.observe(energy)) == float(clean.observe(energy))
    assert dirty.state_dict() == clean.state_dict()
    assert (dirty.num_observed, clean.num_observed) == (34, 30)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.int32])
@KINDS
def test_energies_are_the_numbers_that_they_are(options: dict[str, Any], dtype: Any) -> None:
    exact, given = (EnergyHistogram(**options) for _ in "ab")
    for energy in stream(30):
        value = torch.tensor([8 * energy - 5]).to(dtype)  # one element; negative ones too
        found = given.observe(value)
        assert found.shape == ()
        assert float(found) == float(exact.observe(float(value)))


def test_what_is_no_energy() -> None:
    with pytest.raises(ValueError, match=r"'0\.5'"):
        EnergyHistogram().observe("0.5")  # pyright: ignore[reportArgumentType]
    graph = torch.tensor(0.1, requires_grad=True) * 1
    assert not EnergyHistogram().observe(graph).requires_grad


# -- saved -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("warmup", [4, 60])
@KINDS
def test_it_goes_on_as_it_was(options: dict[str, Any], warmup: int) -> None:
    """Saved by torch; copied; pickled. Bit for bit."""
    options = {**options, "warmup": warmup}
    histogram, loaded = EnergyHistogram(**options), EnergyHistogram(**options)
    nus_of(histogram, stream(40))
    loaded.load_state_dict(through_a_file(histogram.state_dict()))
    copies = copy.deepcopy(histogram), pickle.loads(pickle.dumps(histogram)), loaded
    assert len({float(each.multiplier) for each in (histogram, *copies)}) == 1
    expected = nus_of(histogram, stream(40, seed=1)).tolist()
    for each in copies:
        assert nus_of(each, stream(40, seed=1)).tolist() == expected
        assert each.state_dict() == histogram.state_dict()
        assert repr(each) == repr(histogram)


@pytest.mark.parametrize("left", [0, 5])
def test_under_a_longer_warm_up_nu_is_one_until_it_is_over(left: int) -> None:
    short, long = EnergyHistogram(warmup=4), EnergyHistogram(warmup=40 + left)
    nus_of(short, stream(40))
    long.load_state_dict(short.state_dict())
    assert float(long.multiplier) == 1.0
    nus = nus_of(long, stream(10, seed=1))
    assert nus[:left].tolist() == [1.0] * left
    assert 1.0 not in nus[left:]


def changed(state: dict[str, Any], place: int, value: Any) -> dict[str, Any]:
    learnt = [*state["learnt"]]
    learnt[place] = value
    return {**state, "learnt": learnt}


@KINDS
def test_what_does_not_fit_is_refused_and_nothing_changed(options: dict[str, Any]) -> None:
    histogram = EnergyHistogram(**options)
    nus_of(histogram, stream(40))
    state = json.loads(json.dumps(histogram.state_dict()))
    learnt, others = state["learnt"], EnergyHistogram(**({} if options else FIXED)).state_dict()
    moved = {**state, "energy_range": (0.0, 0.5)}
    damaged = [changed(state, k, v) for k in (0, 1, 3, -1) for v in (math.nan, "x", None)]
    wrong = [{}, others, moved, {**state, "learnt": learnt[:-1]}, {**state, "learnt": "x"}]
    for each in [*wrong, *damaged, changed(state, 0, -1.0), changed(state, -1, -1.0)]:
        before = histogram.state_dict()
        with pytest.raises(ValueError, match=r"EnergyHistogram\.load_state_dict: it is damaged"):
            histogram.load_state_dict(each)
        assert histogram.state_dict() == before
    histogram.load_state_dict(changed(state, 0, 0.0))
    assert histogram.num_observed == 0


# -- options ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_partitions": 23}, "num_partitions=23"),
        ({**FIXED, "num_partitions": 2}, "num_partitions=2"),
        ({**FIXED, "energy_range": (1.0, 0.0)}, "low < high"),
        ({**FIXED, "energy_range": (0.0, math.inf)}, "=inf, but a finite number is needed"),
        ({"energy_range": (0.0, 1.0)}, "both are numbers"),
        ({"temperature": 0.1}, "both are 'auto'"),
        ({**FIXED, "zeta": 1.5}, "zeta=1.5"),
        ({"zeta": 0.0}, "zeta=0.0"),
        ({"zeta": 1.0}, "zeta=1.0"),
        ({**FIXED, "temperature": -1.0}, "=-1.0, but a finite number at least 0.0 is"),
        ({"warmup": 3}, "warmup=3"),
        ({**FIXED, "warmup": -1}, "warmup=-1"),
        ({"clamp": (5.0, -5.0)}, "clamp"),
        ({"clamp": (1.01, 2.0)}, "on both sides of 1"),
        ({"clamp": (0.0, 0.99)}, "on both sides of 1"),
    ],
)
def test_bad_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        EnergyHistogram(**options)
    assert "EnergyHistogram" in str(error.value)


def test_says_what_it_is() -> None:
    histogram = EnergyHistogram(warmup=10)
    assert repr(histogram) == (
        "EnergyHistogram(zeta=0.75, clamp=(-1.0, 3.0)): nu 1, warm-up: 0 of 10 energies"
    )
    nus_of(histogram, stream(10))
    assert repr(histogram).endswith(": nu 1, warm-up: 10 of 10 energies")
    nus_of(histogram, stream(10))
    assert re.search(r": nu [-\d.]+, mean [\d.]+ \+- [\d.]+$", repr(histogram))
    assert repr(EnergyHistogram.paper(zeta=0.5)) == (
        "EnergyHistogram(energy_range=(0.0, 0.2), temperature=0.002, zeta=0.5, "
        "clamp=(-5.0, 5.0)): nu 1, warm-up: 0 of 2500 energies"
    )
    assert EnergyHistogram.paper().weights.tolist() == [1 / 200] * 200


def test_another_scheduler_goes_on_with_what_was_learnt() -> None:
    param = torch.nn.Parameter(torch.ones(4, 3))
    adam, learnt = torch.optim.Adam([{"params": [param], "name": "means"}]), []
    for total in (100, 200):
        phases = PhaseScheduler(total, parts=[histogram := EnergyHistogram(**FIXED)])
        phases.upgrade(adam)
        learnt.append(histogram.state_dict())
        for energy in stream(20):
            param.grad = torch.ones_like(param)
            phases.observe(energy)
            adam.step()
        learnt.append(histogram.state_dict())
    assert learnt[1] == learnt[2] != learnt[0]
