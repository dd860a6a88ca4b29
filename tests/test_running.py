"""Running means and deviations against numpy's weighted ones."""

from __future__ import annotations

import pytest
import torch
from test_energy_exact import faded, stream

from opt3dgs_optim._running import RunningMoments, ViewMeans


@pytest.mark.parametrize("decay", [0.5, 0.9, 1.0])
def test_running_moments_are_the_weighted_ones(decay: float) -> None:
    moments = RunningMoments(decay, torch.float64, torch.device("cpu"))
    assert float(moments.variance) == float(moments.mean) == float(moments.weight) == 0.0
    values = stream(50)
    for k, value in enumerate(values, start=1):
        moments.update(torch.tensor(value, dtype=torch.float64), torch.tensor(True))
        moments.update(torch.tensor(1e9, dtype=torch.float64), torch.tensor(False))
        mean, deviation = faded(values[:k], decay)
        assert float(moments.mean) == pytest.approx(mean, rel=1e-12)
        assert float(moments.variance) == pytest.approx(deviation**2, rel=1e-9, abs=1e-15)
        assert float(moments.low) == min(values[:k])
        assert float(moments.weight) == pytest.approx(sum(decay**i for i in range(k)), rel=1e-12)


def test_running_moments_of_a_large_mean() -> None:
    """A deviation of 1 on a mean of 1e8: the sum of squares would have no digit of it."""
    moments = RunningMoments(1.0, torch.float64, torch.device("cpu"))
    values = [1e8 + (k % 3) for k in range(300)]
    for value in values:
        moments.update(torch.tensor(value, dtype=torch.float64), torch.tensor(True))
    assert float(moments.variance) == pytest.approx(2 / 3, rel=1e-6)


def test_running_moments_are_restored() -> None:
    first, second = (RunningMoments(0.9, torch.float64, torch.device("cpu")) for _ in "ab")
    for value in stream(20):
        first.update(torch.tensor(value, dtype=torch.float64), torch.tensor(True))
    second.load(first.state())
    assert second.state() == first.state()
    assert float(second.variance) == float(first.variance) > 0


def test_view_means_are_those_of_each_view() -> None:
    views = ViewMeans(0.8, torch.float64, torch.device("cpu"))
    seen: dict[int, list[float]] = {}
    for k, value in enumerate(stream(400)):
        view = (k * k) % 130  # more than the table has room for at first
        tensor = torch.tensor(value, dtype=torch.float64)
        unchanged = float(views.update(view, tensor * 1e6, torch.tensor(False)))
        # what does not count changes no mean; where there is none yet, it is returned
        before = faded(seen[view], 0.8)[0] if view in seen else value * 1e6
        assert unchanged == pytest.approx(before, rel=1e-12)
        seen.setdefault(view, []).append(value)
        found = float(views.update(view, tensor, torch.tensor(True)))
        assert found == pytest.approx(faded(seen[view], 0.8)[0], rel=1e-12)
    state = views.state()
    assert state["views"] == list(seen)
    assert state["means"] == pytest.approx([faded(v, 0.8)[0] for v in seen.values()], rel=1e-12)
    assert len(state["weights"]) == len(seen)
    again = ViewMeans(0.8, torch.float64, torch.device("cpu"))
    again.load(state)
    assert again.state() == state
    one = torch.tensor(1.0, dtype=torch.float64)
    assert float(again.update("new", one, torch.tensor(True))) == 1.0


def test_a_variance_is_never_negative() -> None:
    """With decay 0 the mean is the last value, but for its rounding, whose sign is anybody's."""
    moments = RunningMoments(0.0, torch.float64, torch.device("cpu"))
    generator = torch.Generator().manual_seed(0)
    sizes = 10 ** (16 * torch.rand(300, generator=generator, dtype=torch.float64) - 8)
    below = 0
    for value in sizes:
        moments.update(value, torch.tensor(True))
        assert 0 <= float(moments.variance) <= 1e-12 * float(sizes.max()) ** 2
        below += moments.state()[2] < 0
    assert below > 10  # the sum that it is made of
