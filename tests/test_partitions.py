"""The partitions by themselves: what the histogram's tests do not reach."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch

from opt3dgs_optim import EnergyHistogram
from opt3dgs_optim.partitions import FLOOR, FixedPartitions, MovingPartitions, Tally

CPU = torch.device("cpu")


def fixed(num_partitions: int = 10) -> FixedPartitions:
    law = FixedPartitions(num_partitions, (0.0, 1.0), 0.75, 0.1, None)
    law.allocate(CPU)
    return law


@pytest.mark.parametrize("make", [EnergyHistogram, EnergyHistogram.paper])
def test_nothing_is_known_before_the_first_energy(make: Any) -> None:
    histogram = make(clamp=(0.5, 3.0))
    assert histogram.multiplier == 1
    state = histogram.state_dict()
    assert state["num_observed"] == state["num_taken"] == 0
    assert state.get("scalars", [0.0] * 4)[3] == 0.0


def test_a_weight_below_the_floor_is_lifted() -> None:
    law = fixed()
    law.weights[3] = 1e-300
    law.take(torch.tensor(0.95), True, 1)
    assert float(law.weights[3]) == pytest.approx(FLOOR, rel=0.2)
    assert float(law.weights.sum()) == pytest.approx(1.0, abs=1e-15)


def test_an_energy_that_is_not_finite_leaves_weights_and_count() -> None:
    law = fixed()
    law.take(torch.tensor(0.35), True, 1)
    before = law.state()
    law.take(torch.tensor(float("nan")), torch.tensor(False), 2)
    assert law.state() == before


WEIGHTS, SCALARS = [0.1] * 10, [0.0, 0.1, 0.1, 0.0, 1.0]


@pytest.mark.parametrize("scalars", [SCALARS, [0.0, 0.1, 0.0, 7.0, 1.0]])
def test_what_a_checkpoint_may_hold(scalars: list[float]) -> None:
    fixed().check("call", {"weights": WEIGHTS, "scalars": scalars})


@pytest.mark.parametrize(
    ("weights", "scalars", "message"),
    [
        ([-0.1, 0.3, *WEIGHTS[2:]], SCALARS, "positive with sum 1"),
        ([0.0, 0.2, *WEIGHTS[2:]], SCALARS, "positive with sum 1"),
        ([0.11, *WEIGHTS[1:]], SCALARS, "positive with sum 1"),
        (WEIGHTS, [0.0, 0.0, 0.1, 0.0, 1.0], "width > 0 is needed"),
        (WEIGHTS, [0.0, 0.1, -0.1, 0.0, 1.0], "width > 0 is needed"),
        (WEIGHTS, [0.0, 0.1, 0.1, -1.0, 1.0], "width > 0 is needed"),
    ],
)
def test_what_a_checkpoint_may_not_hold(
    weights: list[float], scalars: list[float], message: str
) -> None:
    with pytest.raises(ValueError, match=f"call: .*{message}"):
        fixed().check("call", {"weights": weights, "scalars": scalars})


def test_a_hundred_energies_are_remembered() -> None:
    """An energy that swings by 1 and rises by half of that: the mean follows by 1 % of the rest."""
    law = MovingPartitions(48, 0.75, None)
    law.allocate(CPU)
    for count in range(1, 501):
        swing = 1.0 if count % 2 else -1.0
        law.take(torch.tensor(swing + 0.5 * (count > 400)), True, count)
    low, high, _ = law.coordinates()
    assert (low + high) / 2 == pytest.approx(0.5 * (1 - 0.99**100), abs=0.02)


def test_theta_is_a_power_of_the_density_and_an_even_share() -> None:
    law = MovingPartitions(48, 0.75, None)
    law.allocate(CPU)
    for count in range(1, 40):
        law.take(torch.tensor(float(count % 7)), True, count)
    q = 0.95 * torch.tensor(law.state()["recent"][3:], dtype=torch.float64) + 0.05 / 48
    torch.testing.assert_close(law.weights, q**4 / (q**4).sum(), rtol=1e-9, atol=0)


def test_a_density_may_be_zero_and_so_may_the_deviation() -> None:
    law = MovingPartitions(48, 0.75, None)
    law.allocate(CPU)
    state = law.state()
    state["recent"][1], state["recent"][3], state["recent"][4] = 0.0, 0.0, 2 / 48
    law.check("test", state)


SEED = np.random.default_rng(2)
SCRIPTS = {
    "stationary": SEED.normal(0.5, 0.1, 400),
    "falling": np.exp(-np.arange(400) / 100 + 0.1 * SEED.normal(size=400)),
    "negative": SEED.normal(-5, 0.3, 400),
    "few digits": np.round(SEED.normal(0.5, 0.1, 400), 2),
    "spike at once": np.r_[300, 1, SEED.normal(0.5, 0.1, 398)],
    "spike after three alike": np.r_[0.5, 0.5, 0.5, 300, SEED.normal(0.5, 0.1, 396)],
}


@pytest.mark.parametrize("device", [False, True], ids=["host", "device"])
@pytest.mark.parametrize("name", SCRIPTS)
def test_nu_has_the_digits_of_its_dtype_from_the_second_energy_on(name: str, device: bool) -> None:
    """Up to the fourth may be 1e6 deviations from the mean: sums that cancel were off by 0.25."""
    nus = []
    for dtype in (torch.float32, torch.float64):
        law = MovingPartitions(48, 0.75, None)
        with mock.patch.object(torch, "float64", dtype):
            law.allocate(CPU)
        assert law.nu.dtype == dtype
        tally, found = Tally(0, law.nu), []
        for count, energy in enumerate(torch.tensor(SCRIPTS[name], dtype=torch.float32), 1):
            if device:
                law.take_on_device(energy, torch.tensor(True), tally)
            else:
                law.take(energy, True, count)
            found.append(float(law.nu))
        nus.append(found)
    # Exponents of up to 100 in float32, before softmax takes the largest away: 6e-6.
    assert np.abs(np.subtract(*nus)).max() < 1e-5


def test_a_deviation_that_float32_does_not_know_is_no_division_of_zero_by_zero() -> None:
    law = MovingPartitions(48, 0.75, None)
    with mock.patch.object(torch, "float64", torch.float32):
        law.allocate(CPU)
    state = law.state()
    state["recent"][:2] = 0.5, 1e-300
    law.load(state)
    law.take(torch.tensor(0.5), True, 7)
    assert np.isfinite(law.state()["nu"])
    assert np.isfinite(law.state()["recent"]).all()


def test_every_energy_counts_once() -> None:
    law = fixed()
    for count in (1, 2, 3):
        law.take(torch.tensor(0.5), True, count)
    assert law.state()["scalars"][3] == 3.0
