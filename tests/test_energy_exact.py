"""The energy histogram's parts, each against a few lines of numpy, digit by digit."""

from __future__ import annotations

import inspect
import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from opt3dgs_optim import EnergyHistogram

DEFAULTS = {
    "num_partitions": 200,
    "energy_range": "auto",
    "zeta": 0.75,
    "temperature": "auto",
    "warmup": 2500,
    "step_size": "decay",
    "slope": "backward",
    "slope_radius": 5,
    "clamp": (-5.0, 5.0),
    "energy": "raw",
    "ema_decay": 0.9,
    "floor": 1e-8,
    "process_group": None,
}
FIXED: dict[str, Any] = {"energy_range": (0.0, 1.0), "temperature": 0.05, "warmup": 0}


def stream(count: int, seed: int = 0) -> list[float]:
    """Losses around 0.5, no two alike."""
    return np.random.default_rng(seed).normal(0.5, 0.1, count).tolist()


def faded(values: list[float], decay: float) -> tuple[float, float]:
    """Mean and standard deviation, the newest value weighed 1, each older one `decay` less."""
    weights = decay ** np.arange(len(values))[::-1]
    mean = np.average(values, weights=weights)
    return float(mean), float(np.sqrt(np.average((np.array(values) - mean) ** 2, weights=weights)))


# -- options ---------------------------------------------------------------------------------------


def test_defaults_are_the_documented_ones() -> None:
    found = inspect.signature(EnergyHistogram).parameters
    assert {name: p.default for name, p in found.items()} == DEFAULTS


def test_the_paper_has_its_temperature() -> None:
    histogram = EnergyHistogram.paper()
    assert histogram.calibrated_temperature == 2e-3
    width = 0.2 / 200
    assert histogram.zeta * histogram.calibrated_temperature / width == pytest.approx(1.5)


@pytest.mark.parametrize(
    "options",
    [
        {"num_partitions": 3},
        {"zeta": 0.0},
        {"zeta": 1.0},
        {"warmup": 0},
        {"slope": "least_squares", "slope_radius": 1},
        {"ema_decay": 0.0, "energy": "ema"},
        {"floor": 1 / 200},
        {"temperature": 0.0},
        {"temperature": "auto", "warmup": 4},
        {"energy_range": "auto", "warmup": 4},
        {"energy_range": "auto", "temperature": "auto", "warmup": 4},
    ],
    ids=str,
)
def test_the_ends_of_what_is_allowed_work(options: dict[str, Any]) -> None:
    histogram = EnergyHistogram(**{**FIXED, **options})
    for energy in stream(30):
        assert math.isfinite(float(histogram.observe(energy)))
    assert float(histogram.weights.sum()) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"warmup": 3, "energy_range": "auto"}, "warmup=3"),
        ({"warmup": 3, "temperature": "auto"}, "warmup=3"),
        ({"zeta": 0.0, "temperature": "auto", "warmup": 8}, "zeta=0.0"),
        ({"zeta": 1.0, "temperature": "auto", "warmup": 8}, "zeta=1.0"),
        ({"ema_decay": 1.0}, "ema_decay=1.0"),
        ({"ema_decay": 1.5}, "ema_decay=1.5"),
        ({"zeta": 1.5}, "zeta=1.5"),
        ({"floor": 0.006}, "floor=0.006"),
        ({"floor": 0.0}, "floor=0.0"),
        ({"step_size": 1.0}, "step_size=1.0"),
        ({"step_size": 0.0}, "step_size=0.0"),
        ({"step_size": 1.5}, "step_size=1.5"),
        ({"num_partitions": 2}, "num_partitions=2"),
        ({"slope_radius": 0}, "slope_radius=0"),
    ],
)
def test_beyond_the_ends_they_do_not(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EnergyHistogram(**{**FIXED, **options})


def test_a_new_histogram_knows_nothing() -> None:
    histogram = EnergyHistogram(**FIXED)
    assert histogram.num_observed == 0
    assert histogram.weights.tolist() == [1 / 200] * 200
    assert float(histogram.multiplier) == float(histogram.mean_multiplier) == 1.0
    assert float(histogram.multiplier_std) == 0.0
    assert bool(histogram.last_finite)
    assert histogram.calibrated_range == pytest.approx((0.0, 1.0))
    histogram.observe(0.3)
    histogram.observe(math.nan)
    assert histogram.num_observed == 2


def test_before_the_first_finite_energy_nothing_is_measured() -> None:
    histogram = EnergyHistogram(warmup=8)
    for _ in range(3):
        assert histogram.calibrated_range == pytest.approx((0.0, 1.0))
        assert histogram.calibrated_temperature == 0.0
        assert float(histogram.observe(math.nan)) == 1.0


# -- measuring range and temperature ---------------------------------------------------------------


@pytest.mark.parametrize(("warmup", "measured", "decay"), [(80, 40, 0.8), (20, 10, 0.5)])
def test_the_measured_range_and_temperature(warmup: int, measured: int, decay: float) -> None:
    """Over an eighth of the warm-up, at least two energies; 30 deviations down, 4 up."""
    histogram = EnergyHistogram(warmup=warmup, zeta=0.6)
    values = [-1.0, *stream(warmup + 20)]  # a negative one: the range may be negative too
    for count, energy in enumerate(values, start=1):
        histogram.observe(energy)
        mean, deviation = faded(values[: min(count, measured)], decay)
        if count > 1:
            # the running variance and numpy's, in float64
            expected = (mean - 30 * deviation, mean + 4 * deviation)
            assert histogram.calibrated_range == pytest.approx(expected, rel=1e-8)
            expected_tau = pytest.approx(0.4 / 1.2 * deviation, rel=1e-8)
            assert histogram.calibrated_temperature == expected_tau


def test_only_what_is_automatic_is_measured() -> None:
    values = stream(100)
    mean, deviation = faded(values[:20], 0.6)
    cut = EnergyHistogram(temperature=0.3, warmup=40)
    warm = EnergyHistogram(energy_range=(0.2, 0.9), warmup=40)
    for energy in values:
        cut.observe(energy)
        warm.observe(energy)
    # no energy was negative, so neither is the range
    assert cut.calibrated_range == pytest.approx((0.0, mean + 4 * deviation), rel=1e-9)
    assert cut.calibrated_temperature == 0.3
    assert warm.calibrated_range == pytest.approx((0.2, 0.9), rel=1e-12)
    assert warm.calibrated_temperature == pytest.approx(deviation / 6, rel=1e-9)


def test_the_weights_wait_for_the_range() -> None:
    """They are estimated from the second half of the warm-up on, nu comes after all of it."""
    histogram = EnergyHistogram(20, warmup=40)
    nus = []
    for k, energy in enumerate(stream(160)):
        nus.append(float(histogram.observe(energy)))
        assert bool((histogram.weights == histogram.weights[0]).all()) == (k < 20)
        assert k >= 40 or float(histogram.mean_multiplier) == nus[k] == 1.0
    assert len(set(nus[40:])) > 20
    assert float(histogram.mean_multiplier) == pytest.approx(np.mean(nus[40:]), rel=1e-12)
    assert float(histogram.multiplier_std) == pytest.approx(np.std(nus[40:]), rel=1e-9)


# -- nu --------------------------------------------------------------------------------------------


def having(weights: Tensor, **options: Any) -> EnergyHistogram:
    """A histogram with these weights, at its next energy."""
    settings = {**FIXED, "num_partitions": len(weights), "clamp": None, **options}
    histogram = EnergyHistogram(**settings)
    state = histogram.state_dict()
    histogram.load_state_dict({**state, "weights": (weights / weights.sum()).tolist()})
    return histogram


def uneven(count: int = 24) -> Tensor:
    return torch.rand(count, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.1


@pytest.mark.parametrize("index", range(24))
@pytest.mark.parametrize("radius", [1, 3, 40])
def test_least_squares_slope_of_every_partition(index: int, radius: int) -> None:
    """numpy's line through the neighbours; the window is cut off at the ends."""
    weights = uneven()
    histogram = having(weights, slope="least_squares", slope_radius=radius)
    nu = float(histogram.observe((index + 0.5) / 24))
    near = np.arange(max(index - radius, 0), min(index + radius, 23) + 1)
    slope = np.polyfit(near, np.log(weights.numpy())[near], 1)[0]
    inner = 0 < index < 23
    assert nu == pytest.approx(1 + 0.75 * 0.05 * slope * 24 if inner else 1.0, rel=1e-9)


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


def test_one_counted_multiplier_is_the_mean() -> None:
    histogram = having(uneven())
    nu = float(histogram.observe(10.5 / 24))
    assert nu != 1.0
    assert float(histogram.mean_multiplier) == nu
    assert float(histogram.multiplier_std) == 0.0


@pytest.mark.parametrize("count", [0, 1, 1000, 100_000])
def test_the_decaying_step_size(count: int) -> None:
    """lambda = min(1e-2, 10 / (k^0.8 + 100)), seen on the weights of two partitions."""
    histogram = having(torch.ones(4, dtype=torch.float64))
    state = histogram.state_dict()
    state["scalars"][3] = float(count)
    histogram.load_state_dict(state)
    histogram.observe(0.3)
    rate = min(1e-2, 10 / (count**0.8 + 100)) * 0.25**0.75
    expected = [0.25 + rate * ((k == 1) - 0.25) for k in range(4)]
    assert histogram.weights.tolist() == pytest.approx(expected, rel=1e-12)


def test_a_constant_step_size() -> None:
    histogram = having(torch.ones(4, dtype=torch.float64), step_size=0.2)
    histogram.observe(0.3)
    rate = 0.2 * 0.25**0.75
    expected = [0.25 + rate * ((k == 1) - 0.25) for k in range(4)]
    assert histogram.weights.tolist() == pytest.approx(expected, rel=1e-12)


def test_the_floor_holds() -> None:
    histogram = having(torch.ones(4, dtype=torch.float64), step_size=0.9, floor=0.1)
    theta = np.full(4, 0.25)
    for _ in range(50):
        histogram.observe(0.3)
        rate = 0.9 * theta[1] ** 0.75
        theta = np.maximum(theta + rate * (np.eye(4)[1] - theta), 0.1)
        theta /= theta.sum()
    assert histogram.weights.tolist() == pytest.approx(theta.tolist(), rel=1e-12)


@pytest.mark.parametrize(("energy", "counts"), [(1e150, True), (1.1e150, False), (-1e150, True)])
def test_the_largest_energy(energy: float, counts: bool) -> None:
    histogram = EnergyHistogram(**FIXED)
    histogram.observe(energy)
    assert bool(histogram.last_finite) is counts
    assert histogram.state_dict()["scalars"][3] == counts


# -- which energy ----------------------------------------------------------------------------------


@pytest.mark.parametrize("energy", ["ema", "view_centered"])
def test_the_energy_that_is_looked_at(energy: Any) -> None:
    """A raw histogram that is given the transformed losses gives the same nu."""
    ours = EnergyHistogram(**{**FIXED, "energy": energy, "ema_decay": 0.7})
    raw = EnergyHistogram(**FIXED)
    seen: list[float] = []
    of_view: dict[int, list[float]] = {}
    for k, loss in enumerate(stream(300)):
        seen.append(loss)
        of_view.setdefault(k % 3, []).append(loss)
        looked_at = faded(seen, 0.7)[0]
        if energy == "view_centered":
            looked_at += loss - faded(of_view[k % 3], 0.7)[0]
        nu = float(ours.observe(loss, view=k % 3))
        assert nu == pytest.approx(float(raw.observe(looked_at)), rel=1e-9)
    assert ours.weights.tolist() == pytest.approx(raw.weights.tolist(), rel=1e-9)


@pytest.mark.parametrize("energy", ["raw", "ema"])
def test_a_view_may_be_anything_where_it_is_not_used(energy: Any) -> None:
    histogram = EnergyHistogram(**{**FIXED, "energy": energy})
    for view in (None, 1.5, ("a", 2)):
        assert math.isfinite(float(histogram.observe(0.5, view=view)))


@pytest.mark.parametrize("view", [3, "left"])
def test_a_view_is_a_number_or_a_name(view: Any) -> None:
    histogram = EnergyHistogram(**{**FIXED, "energy": "view_centered"})
    histogram.observe(0.5, view=view)
    assert histogram.state_dict()["views"]["views"] == [view]


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
def test_an_energy_of_one_element(shape: tuple[int, ...]) -> None:
    histogram = EnergyHistogram(**FIXED)
    assert histogram.observe(torch.full(shape, 0.5)).shape == ()
    assert float(histogram.weights.max()) > 1 / 200


@pytest.mark.parametrize("loss", [0.0, 7.0])
def test_the_narrowest_range_of_a_constant_energy(loss: float) -> None:
    """A deviation of 1e-12 of the mean, or the inverse of the largest energy."""
    histogram = EnergyHistogram(warmup=8)
    for _ in range(20):
        histogram.observe(loss)
    deviation = max(1e-12 * loss, 1e-150)
    low, high = histogram.calibrated_range
    # differences of numbers near 7, of 1e-11: float64 has four digits of them
    assert high - low == pytest.approx((34 if loss else 4) * deviation, rel=1e-3, abs=0)
    assert histogram.calibrated_temperature == pytest.approx(deviation / 6, rel=1e-9, abs=0)


def test_a_state_of_an_older_version_leaves_nothing_behind() -> None:
    """What it does not know starts anew, whatever the histogram had learnt before."""
    old = EnergyHistogram(warmup=8).state_dict()
    for key in ("recent", "nu_moments", "smooth", "views"):
        del old[key]
    used, new = (EnergyHistogram(warmup=8) for _ in "ab")
    for energy in stream(50):
        used.observe(energy)
    assert float(used.mean_multiplier) != 1.0
    used.load_state_dict(old)
    assert used.state_dict() == new.state_dict()
    for energy in stream(50, seed=1):
        assert float(used.observe(energy)) == float(new.observe(energy))


def test_state_lives_on_the_energys_device() -> None:
    """On one without data (meta), from the first energy on and after some elsewhere."""
    far = torch.zeros((), device="meta")
    for before in (0, 3):
        histogram = EnergyHistogram(warmup=8)
        for _ in range(before):
            histogram.observe(0.1)
        assert histogram.observe(far).device.type == "meta"
        assert histogram.weights.device.type == "meta"
        assert histogram.last_finite.device.type == "meta"


class Elsewhere(Tensor):
    """A tensor on another device, as far as it says."""

    @property
    def device(self) -> torch.device:  # pyright: ignore[reportIncompatibleVariableOverride]
        return torch.device("cpu", 0)  # torch's own say "cpu" without a number


def test_what_has_been_learnt_moves_to_where_the_energy_is() -> None:
    here, moved = (EnergyHistogram(warmup=20, energy="ema") for _ in "ab")
    for k, energy in enumerate(stream(60)):
        value = torch.tensor(energy)
        there = value.as_subclass(Elsewhere) if k in (0, 10, 30, 31) else value
        assert float(here.observe(value)) == float(moved.observe(there))
    assert here.state_dict() == moved.state_dict()
