"""`EnergyHistogram`: what it promises of nu, as a part of a training, saved and on a device."""

from __future__ import annotations

import copy
import io
import json
import math
import pickle
import re
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from oracles import LoopHistogram, MovingHistogram

from opt3dgs_optim import EnergyHistogram, Phase, PhaseScheduler, Training
from opt3dgs_optim.step import Step

FIXED: dict[str, Any] = {"energy_range": (0.0, 1.0), "temperature": 0.05, "warmup": 4}
KINDS = pytest.mark.parametrize("options", [{}, FIXED], ids=["moving", "fixed"])


def stream(count: int, seed: int = 0) -> list[float]:
    """Losses around 0.5, no two alike."""
    return np.random.default_rng(seed).normal(0.5, 0.1, count).tolist()


def nus_of(histogram: EnergyHistogram, energies: Any) -> np.ndarray:
    return np.array([float(histogram.observe(energy)) for energy in energies])


# -- nu --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clamp", [None, (0.9, 1.1)])
@KINDS
def test_clamp_and_warm_up_are_those_of_the_loops(options: dict[str, Any], clamp: Any) -> None:
    fixed = LoopHistogram(200, (0.0, 1.0), 0.75, 0.05, 20, clamp)
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
    histogram = EnergyHistogram(warmup=9)
    nus_of(histogram, stream(9))
    moments = histogram.mean_multiplier, histogram.multiplier_std, histogram.multiplier
    assert [float(each) for each in moments] == [1.0, 0.0, 1.0]
    assert histogram.numbers() == {}
    nu = float(histogram.observe(0.7))
    assert nu != 1.0
    assert histogram.numbers() == {"nu": nu}
    assert float(histogram.mean_multiplier) == nu


def test_the_papers_settings() -> None:
    histogram = EnergyHistogram.paper()
    assert (histogram.energy_range, histogram.temperature) == ((0.0, 0.2), 2e-3)
    assert (histogram.num_partitions, histogram.zeta, histogram.warmup) == (200, 0.75, 2500)
    assert histogram.clamp == (-5.0, 5.0)
    assert histogram.weights.tolist() == [1 / 200] * 200
    width = 0.2 / 200
    assert histogram.zeta * 2e-3 / width == pytest.approx(1.5)
    assert EnergyHistogram.paper(zeta=0.5).zeta == 0.5


def test_the_defaults_settings() -> None:
    histogram = EnergyHistogram()
    assert (histogram.num_partitions, histogram.zeta, histogram.warmup) == (48, 0.75, 250)
    assert histogram.clamp == (-1.0, 3.0)
    assert EnergyHistogram(energy_range=(0.0, 1.0), temperature=0.1).num_partitions == 200


# -- in a training ---------------------------------------------------------------------------------


def upgraded(*parts: Any, total: int = 100, switch: int = 60) -> tuple[Any, Any, PhaseScheduler]:
    x = torch.nn.Parameter(torch.zeros(4, 3))
    phases = PhaseScheduler(total, switch, parts=list(parts))
    adam = torch.optim.Adam([x], lr=0.1, betas=(0.0, 0.999), eps=1e-15)
    return x, phases.upgrade({"means": adam})["means"], phases


def test_it_scales_the_steps_until_the_switch_and_then_looks_no_more() -> None:
    histogram = EnergyHistogram(warmup=4)
    x, adam, phases = upgraded(histogram, total=30, switch=20)
    steps, nus, learnt = [], [], []
    for energy in stream(30):
        phases.observe(torch.tensor(energy))
        x.grad, before = torch.ones(4, 3), x.detach().clone()
        adam.step()
        steps.append(float((before - x.detach())[0, 0]))
        nus.append(float(histogram.multiplier))
        learnt.append(histogram.state_dict())
        assert phases.numbers() == ({"nu": nus[-1]} if 4 < len(steps) <= 20 else {})
    assert steps[:20] == pytest.approx([0.1 * nu for nu in nus[:20]], rel=1e-4)
    assert np.std(nus[4:20]) > 0.1
    assert steps[20:] == pytest.approx([0.1] * 10, rel=1e-4)
    assert learnt[-1] == learnt[20]  # the first loss after the switch comes before its step


def test_without_energies_it_says_so_once_and_nu_is_one() -> None:
    x, adam, _ = upgraded(EnergyHistogram())
    x.grad = torch.ones(4, 3)
    adam.step()  # an energy may come after it
    with pytest.warns(UserWarning, match=r"no energy has been observed.*call phases\.observe"):
        adam.step()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        adam.step()
    assert float(x.detach()[0, 0]) == pytest.approx(-0.3, rel=1e-4)


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


def test_on_a_cpu_the_factor_is_a_float_that_multiplies() -> None:
    histogram, training = EnergyHistogram(warmup=4), Training([], 10)
    nus_of(histogram, stream(20))
    step = Step(torch.zeros(1), torch.zeros(1), "means", "", {}, {}, 0, -1, factor=2.0)
    histogram.plan(step, training)
    assert type(step.factor) is float
    assert step.factor == 2.0 * float(histogram.multiplier)


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
    for wrong, message in ((torch.zeros(2), "(2,)"), ("0.5", "'0.5'"), (None, "None")):
        with pytest.raises(ValueError, match=re.escape(message)):
            EnergyHistogram().observe(wrong)  # pyright: ignore[reportArgumentType]
    graph = torch.tensor(0.1, requires_grad=True) * 1
    assert not EnergyHistogram().observe(graph).requires_grad


# -- saved -----------------------------------------------------------------------------------------


def by_torch(state: Any) -> Any:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


@pytest.mark.parametrize("warmup", [4, 60])
@KINDS
def test_it_goes_on_as_it_was(options: dict[str, Any], warmup: int) -> None:
    """Saved by torch; copied; pickled. Bit for bit."""
    options = {**options, "warmup": warmup}
    histogram, loaded = EnergyHistogram(**options), EnergyHistogram(**options)
    nus_of(histogram, stream(40))
    loaded.load_state_dict(by_torch(histogram.state_dict()))
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


def test_a_variance_that_rounding_makes_negative_is_zero() -> None:
    """As where nu lies at its clamp all the time."""
    histogram = EnergyHistogram()
    nus_of(histogram, stream(10))
    state = histogram.state_dict()
    state["learnt"][2:5] = 3.0, 3 * 0.7, 3 * 0.7**2 - 1e-15  # of nu^0, nu and nu^2
    histogram.load_state_dict(state)
    assert float(histogram.multiplier_std) == 0.0


def changed(state: dict[str, Any], place: int, value: Any) -> dict[str, Any]:
    learnt = [*state["learnt"]]
    learnt[place] = value
    return {**state, "learnt": learnt}


@KINDS
def test_what_does_not_fit_is_refused_and_nothing_changed(options: dict[str, Any]) -> None:
    histogram = EnergyHistogram(**options)
    nus_of(histogram, stream(40))
    state = json.loads(json.dumps(histogram.state_dict()))
    state["energy_range"] = histogram.energy_range
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
    "options",
    [
        {**FIXED, "num_partitions": 3},
        {**FIXED, "zeta": 0.0},
        {**FIXED, "zeta": 1.0},
        {**FIXED, "temperature": 0.0},
        {**FIXED, "warmup": 0, "clamp": (1.0, 1.0 + 1e-9)},
        {"num_partitions": 24, "clamp": (0.5, 1.0)},
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
        ({**FIXED, "energy_range": "automatic"}, "'automatic'"),
        ({"energy_range": (0.0, 1.0)}, "both are numbers"),
        ({"temperature": 0.1}, "both are 'auto'"),
        ({**FIXED, "temperature": "hot"}, "'hot'"),
        ({**FIXED, "zeta": 1.5}, "zeta=1.5"),
        ({"zeta": 0.0}, "zeta=0.0"),
        ({"zeta": 1.0}, "zeta=1.0"),
        ({**FIXED, "temperature": -1.0}, "temperature=-1.0"),
        ({"warmup": 3}, "warmup=3"),
        ({**FIXED, "warmup": -1}, "warmup=-1"),
        ({"clamp": (5.0, -5.0)}, "clamp"),
        ({"clamp": (1.01, 2.0)}, "on both sides of 1"),
        ({"clamp": (0.0, 0.99)}, "on both sides of 1"),
        ({"clamp": "narrow"}, "clamp"),
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
    assert "energy_range=(0.0, 0.2), temperature=0.002" in repr(EnergyHistogram.paper())


def test_it_acts_while_exploring_and_serves_one_training() -> None:
    histogram = EnergyHistogram()
    assert (histogram.during, histogram.learns) == (Phase.EXPLORATION, True)
    Training([histogram])
    with pytest.raises(ValueError, match="serves another training"):
        Training([histogram])
