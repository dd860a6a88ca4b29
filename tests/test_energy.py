"""The energy histogram against a loop-form oracle, and its invariants."""

from __future__ import annotations

import math
import re
from typing import Literal

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import LoopHistogram

from opt3dgs_optim import EnergyHistogram

SMALL = {"num_partitions": 8, "energy_range": (0.0, 1.0), "temperature": 0.05, "warmup": 3}
energies = st.one_of(
    st.floats(-2.0, 3.0),
    st.integers(0, 8).map(lambda i: i / 8),  # exactly on the edges
    st.sampled_from([math.nan, math.inf, -math.inf, 1e149, -1e149]),
)


@settings(max_examples=200, deadline=None)
@given(st.lists(energies, max_size=60), st.sampled_from([None, (-5.0, 5.0), (0.25, 4.0)]))
def test_matches_loop_oracle(stream: list[float], clamp: tuple[float, float] | None) -> None:
    histogram = EnergyHistogram(**SMALL, clamp=clamp)  # pyright: ignore[reportArgumentType]
    oracle = LoopHistogram(8, (0.0, 1.0), 0.75, 0.05, 3, clamp)
    for energy in stream:
        nu, expected = float(histogram.observe(energy)), oracle.observe(energy)
        if math.isfinite(energy):
            assert nu == pytest.approx(expected, rel=1e-9, abs=1e-9)
    # 60 float64 updates of well-scaled numbers
    assert histogram.weights.tolist() == pytest.approx(oracle.theta, rel=1e-12)


def test_first_multiplier_is_one_and_not_minus_3973() -> None:
    """Erratum: "theta(J - 1) v 1" is an index clamp."""
    histogram = EnergyHistogram.paper(warmup=0)
    assert float(histogram.observe(0.1)) == 1.0


def test_paper_settings() -> None:
    histogram = EnergyHistogram.paper()
    assert histogram.calibrated_range == pytest.approx((0.0, 0.2))
    assert (histogram.num_partitions, histogram.zeta, histogram.warmup) == (200, 0.75, 2500)
    assert histogram.clamp == (-5.0, 5.0)
    assert EnergyHistogram.paper(zeta=0.5).zeta == 0.5


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_energy_changes_nothing(bad: float) -> None:
    histogram = EnergyHistogram(warmup=8, energy="ema")
    for k in range(20):
        histogram.observe(torch.tensor(0.1 + 0.01 * (k % 5)))
    before = histogram.state_dict()
    nu = histogram.observe(torch.tensor(bad))
    after = histogram.state_dict()
    assert not bool(histogram.last_finite)
    assert nu == before["scalars"][-1]
    assert {**after, "num_observed": 0} == {**before, "num_observed": 0}


@pytest.mark.parametrize(
    "updates", [5_000, pytest.param(1_000_000, marks=pytest.mark.slow, id="million")]
)
def test_weights_stay_positive_with_sum_one(updates: int) -> None:
    histogram = EnergyHistogram.paper(warmup=0)
    generator = torch.Generator().manual_seed(0)
    wander = torch.linspace(0, 20, updates, dtype=torch.float64).sin()
    walk = 0.1 + 0.05 * wander
    walk += 0.02 * torch.randn(updates, generator=generator, dtype=torch.float64)
    for energy in walk:
        histogram.observe(energy)
    assert float(histogram.weights.min()) > 0
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12


def test_weights_recover_from_the_floor_after_a_million_updates() -> None:
    """All weight in one partition, the others on the floor, lambda as small as it gets."""
    histogram = EnergyHistogram.paper(warmup=0)
    state = histogram.state_dict()
    state["weights"] = [1e-8] * 199 + [1 - 199e-8]
    state["scalars"][3] = 1e6  # the number of finite energies so far
    histogram.load_state_dict(state)
    for _ in range(2_000):
        nu = float(histogram.observe(0.05))
        assert math.isfinite(nu)
    assert float(histogram.weights.min()) > 0
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12
    assert float(histogram.weights[49]) > 1e-8  # 0.05 is the 50th partition's upper edge


def test_weights_estimate_the_density_to_the_power_four() -> None:
    """theta -> p^(1 / (1 - zeta)), not the cumulative density as the paper's text says."""
    histogram = EnergyHistogram(
        4, (0.0, 4.0), zeta=0.5, temperature=1.0, warmup=0, step_size=1e-3, floor=1e-12
    )
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


def test_automatic_range_and_temperature_follow_the_warm_up() -> None:
    histogram = EnergyHistogram(warmup=400)
    generator = torch.Generator().manual_seed(0)
    for z in torch.randn(400, generator=generator).tolist():
        histogram.observe(5.0 + 0.02 * z)
    low, high = histogram.calibrated_range
    # mean - 30 sd, mean + 4 sd; the recent deviation of about 25 energies is known to 15 %
    assert low == pytest.approx(5.0 - 30 * 0.02, abs=30 * 0.02 * 0.5)
    assert high == pytest.approx(5.0 + 4 * 0.02, abs=4 * 0.02 * 0.5)
    assert histogram.calibrated_temperature == pytest.approx(0.02 / 6, rel=0.5)
    before = histogram.calibrated_range
    for _ in range(100):
        histogram.observe(9.0)
    assert histogram.calibrated_range == before


def test_automatic_range_of_losses_does_not_go_below_zero() -> None:
    histogram = EnergyHistogram(warmup=40)
    for k in range(40):
        histogram.observe(0.01 * (k % 7))
    assert histogram.calibrated_range[0] == 0.0


def test_constant_energy_is_survived() -> None:
    histogram = EnergyHistogram(warmup=8)
    for _ in range(100):
        assert math.isfinite(float(histogram.observe(0.25)))
    assert abs(float(histogram.weights.sum()) - 1) < 1e-12


def test_view_centered_energy_ignores_how_hard_a_view_is() -> None:
    centered = EnergyHistogram(warmup=0, energy="view_centered", **_fixed())
    raw = EnergyHistogram(warmup=0, **_fixed())
    for k in range(600):
        view = k % 3
        centered.observe(0.2 + 0.3 * view, view=view)
        raw.observe(0.2 + 0.3 * view)
    assert int((raw.weights > 2 / 200).sum()) >= 3  # one peak per view
    # After the first visits, all energies are the global mean: one peak, within the ema's ripple.
    peak = int(centered.weights.argmax())
    assert float(centered.weights[max(peak - 12, 0) : peak + 13].sum()) > 0.5


def test_view_centered_energy_needs_a_view() -> None:
    histogram = EnergyHistogram(warmup=0, energy="view_centered", **_fixed())
    with pytest.raises(ValueError, match=re.escape("view=None")):
        histogram.observe(0.1)


def test_least_squares_slope_is_exact_for_a_geometric_density() -> None:
    settings_ = {**SMALL, "num_partitions": 40, "warmup": 0, "clamp": None}
    histogram = EnergyHistogram(slope="least_squares", **settings_)  # pyright: ignore
    backward = EnergyHistogram(slope="backward", **settings_)  # pyright: ignore
    ratio = torch.exp(0.1 * torch.arange(40, dtype=torch.float64))
    for each in (histogram, backward):
        each._weights = ratio / ratio.sum()
    for energy in (0.06, 0.5, 0.93):  # near either end and in the middle
        nu = float(histogram.observe(energy))
        expected = float(backward.observe(energy))
        # the weights moved by one update of at most 1e-2 between construction and comparison
        assert nu == pytest.approx(1 + 0.75 * 0.05 * 0.1 * 40, rel=2e-2)
        assert expected == pytest.approx(1 + 0.75 * 0.05 * 0.1 * 40, rel=2e-2)


def test_mean_multiplier_counts_after_the_warm_up_only() -> None:
    histogram = EnergyHistogram(**SMALL)  # pyright: ignore[reportArgumentType]
    nus = [float(histogram.observe(0.1 + 0.09 * (k % 9))) for k in range(200)]
    counted = torch.tensor(nus[3:], dtype=torch.float64)
    assert float(histogram.mean_multiplier) == pytest.approx(float(counted.mean()), rel=1e-9)
    expected = float(counted.std(correction=0))
    assert float(histogram.multiplier_std) == pytest.approx(expected, rel=1e-9)


def test_resume_is_exact() -> None:
    whole = EnergyHistogram(warmup=50, energy="view_centered")
    first = EnergyHistogram(warmup=50, energy="view_centered")
    second = EnergyHistogram(warmup=50, energy="view_centered")
    stream = [(0.1 + 0.03 * math.sin(k), k % 7) for k in range(300)]
    for k, (energy, view) in enumerate(stream):
        whole.observe(energy, view=view)
        (first if k < 120 else second).observe(energy, view=view)
        if k == 119:
            second.load_state_dict(first.state_dict())
    assert whole.state_dict() == second.state_dict()


@pytest.mark.parametrize("energy", ["raw", "ema"])
def test_state_is_updated_in_place(energy: Literal["raw", "ema"]) -> None:
    """A CUDA graph that has captured observe() and a step reads and writes the same memory."""
    histogram = EnergyHistogram(warmup=8, energy=energy)

    def places() -> list[int]:
        moments = (histogram._recent, histogram._nu_moments, histogram._smooth)
        held = [value for each in (histogram, *moments) for value in vars(each).values()]
        return [value.data_ptr() for value in held if isinstance(value, torch.Tensor)]

    before = places()
    live, kept = histogram.multiplier, []
    for k in range(60):
        kept.append(histogram.observe(0.1 + 0.01 * (k % 7)))
    assert places() == before
    assert float(live) == float(kept[-1])
    assert len({float(nu) for nu in kept}) > 3  # what observe returned does not change later


def test_state_dict_is_plain_and_checked() -> None:
    histogram = EnergyHistogram(8, (0.0, 1.0), temperature=0.1, warmup=0)
    histogram.observe(0.3)
    state = histogram.state_dict()
    torch.save(state, buffer := __import__("io").BytesIO())
    buffer.seek(0)
    assert torch.load(buffer, weights_only=True) == state
    with pytest.raises(ValueError, match="8 weights"):
        EnergyHistogram(9, (0.0, 1.0), temperature=0.1, warmup=0).load_state_dict(state)
    with pytest.raises(ValueError, match="missing"):
        histogram.load_state_dict({"weights": []})
    with pytest.raises(ValueError, match="positive"):
        histogram.load_state_dict({**state, "weights": [1.0] + [0.0] * 7})


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_partitions": 2}, "num_partitions=2"),
        ({"num_partitions": 8.0}, "num_partitions=8.0"),
        ({"energy_range": (1.0, 0.0)}, "low < high"),
        ({"energy_range": "automatic"}, "'auto'"),
        ({"energy_range": (0.0, math.inf)}, "energy_range"),
        ({"zeta": 1.5}, "zeta=1.5"),
        ({"zeta": 0.0}, "zeta=0.0"),
        ({"temperature": -1.0}, "temperature=-1.0"),
        ({"temperature": "hot"}, "'hot'"),
        ({"warmup": -1}, "warmup=-1"),
        ({"warmup": 2}, "at least 4"),
        ({"step_size": 0.0}, "step_size=0.0"),
        ({"step_size": "fast"}, "'decay'"),
        ({"slope": "forward"}, "'backward'"),
        ({"slope_radius": 0}, "slope_radius=0"),
        ({"clamp": (5.0, -5.0)}, "clamp"),
        ({"energy": "loss"}, "'view_centered'"),
        ({"ema_decay": 1.0}, "ema_decay=1.0"),
        ({"floor": 0.0}, "floor=0.0"),
    ],
)
def test_bad_options(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        EnergyHistogram(**options)
    assert "EnergyHistogram" in str(error.value)


def test_energy_must_be_one_number() -> None:
    with pytest.raises(ValueError, match=re.escape("(2,)")):
        EnergyHistogram.paper().observe(torch.zeros(2))


def test_keeps_no_graph() -> None:
    histogram = EnergyHistogram.paper(warmup=0)
    loss = torch.tensor(0.1, requires_grad=True) * 1
    assert not histogram.observe(loss).requires_grad


def _fixed() -> dict:
    return {"energy_range": (0.0, 1.0), "temperature": 0.01}
