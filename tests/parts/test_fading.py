"""Fading: which points an event fades, when there are events, and how long the steps become."""

from __future__ import annotations

import copy
import itertools
import math

import pytest
import torch
from gaussians import adams_of, parameters, same_tensors, steps
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import Fading, PhaseScheduler
from opt3dgs_optim.clock import Clock
from opt3dgs_optim.parts.fading import events_before
from opt3dgs_optim.step import chosen_rows

CPU = torch.device("cpu")


def before(part: Fading, iteration: int, clock: Clock) -> int:
    """How many events there were before an iteration."""
    total = None if clock.open_end else clock.end_step
    return events_before(iteration, total, clock.fall_step, part.start, part.stop, part.events)


@given(
    event=st.integers(0, 2**20), seed=st.integers(0, 2**31), share=st.sampled_from([0.05, 0.2, 0.7])
)
def test_a_share_of_the_points_is_chosen(event: int, seed: int, share: float) -> None:
    """By a hash: within five deviations of the share; other events and seeds choose others."""
    count = 20_000
    part = Fading(share=share, seed=seed)
    chosen = chosen_rows(part.fade(event), count, CPU)
    assert abs(int(chosen.sum()) - share * count) < 5 * (count * share * (1 - share)) ** 0.5
    for other in (
        chosen_rows(part.fade(event + 1), count, CPU),
        chosen_rows(Fading(share, seed=seed + 1).fade(event), count, CPU),
    ):
        both = float((chosen & other).sum()) / count
        assert abs(both - share**2) < 0.03


@given(
    total=st.integers(1, 50_000),
    events=st.integers(1, 5_000),
    start=st.floats(0, 0.9),
    length=st.floats(0.01, 1.0),
)
def test_events_are_in_their_stretch_and_four_iterations_apart(
    total: int, events: int, start: float, length: float
) -> None:
    stop = min(start + length, 1.0)
    clock = Clock(total)
    part = Fading(events=events, start=start, stop=stop)
    assert before(part, int(start * total), clock) == 0
    whole = before(part, total, clock)
    assert whole <= min(events, (stop - start) * total / 4 + 1)
    assert whole == before(part, int(stop * total) + 1, clock)
    middle = int((start + stop) / 2 * total)
    counts = [before(part, i, clock) for i in range(middle, middle + 40)]
    assert all(b - a in (0, 1) for a, b in itertools.pairwise(counts))
    assert all(b - a <= 1 for a, b in zip(counts, counts[3:], strict=False))


@given(events=st.integers(1, 3_000), fall=st.integers(1, 50_000))
def test_events_become_rarer_where_no_end_is_planned(events: int, fall: int) -> None:
    part, clock = Fading(events=events), Clock()
    counts = [before(part, i, clock) for i in range(0, 50_000, 4)]
    assert all(b - a in (0, 1) for a, b in itertools.pairwise(counts))
    assert counts[-1] - counts[6_250] == pytest.approx(events / 3 * math.log(2), abs=1.1)
    clock.plan_fall(fall, fall + 100)
    assert before(part, fall + 100, clock) == before(part, fall, clock)


def test_nothing_is_faded_in_the_fall() -> None:
    """Three events would fade in iterations 10, 29, 80 and 218; torch's Adam goes on as it does."""
    params = parameters(6)
    phases = PhaseScheduler(parts=[Fading(events=3)])
    optimizers = phases.upgrade(adams_of(params))
    steps(optimizers, params, 60)
    phases.finish_in(60)
    plain = copy.deepcopy(params)
    stock = adams_of(plain)
    for name, each in stock.items():
        each.load_state_dict(copy.deepcopy(optimizers[name].state_dict()))
    for adams, of in ((optimizers, params), (stock, plain)):
        steps(adams, of, 60, seed=1)
    assert same_tensors(params, plain)


@pytest.mark.parametrize(
    ("steps_of_run", "points", "times"),
    [
        (30_000, 100, 300),
        (30_000, 10_000, 300),
        (30_000, 50_000, 102),
        (30_000, 1_000_000, 100),
        (600, 100, 100),
        (600, 0, 0),
    ],
)
def test_how_many_events_a_run_has(steps_of_run: int, points: int, times: int) -> None:
    """A third where points are many. In 600 iterations, 4 apart in 67 % of them."""
    part = Fading()
    events = range(before(part, steps_of_run, Clock(steps_of_run)))
    assert sum(part.happens(event, points) for event in events) == times


def test_of_events_that_came_between_two_steps_any_fades() -> None:
    """Of so many points the first of two events fades some, and the second none."""
    part, rows, clock = Fading(names=("scales",)), 30_000, Clock(300)
    due = [i for i in range(300) if before(part, i + 1, clock) > before(part, i, clock)]
    some = [part.happens(event, rows) for event in range(len(due))]
    at = next(e for e in range(len(due)) if some[e : e + 2] == [True, False])
    left_out = range(due[at], due[at + 1])  # the last step before was without both
    param = Parameter(torch.zeros(rows, 1))
    optimizer = PhaseScheduler(300, parts=[part]).upgrade(
        Adam([{"params": [param], "name": "scales"}], lr=1.0)
    )
    for iteration in range(left_out.stop + 1):
        param.grad = None if iteration in left_out else torch.ones(rows, 1)
        optimizer.step()
    chosen = chosen_rows(part.fade(at + 1), rows, CPU)
    moments = optimizer.state[param]["exp_avg"][:, 0]
    assert bool((moments[chosen] < moments[~chosen].amin()).all())


def test_events_end_each_part_of_the_stretch() -> None:
    """The 24th, 32nd, 40th and 48th of 64 steps end the quarters of it."""
    part, phases = Fading(0.4, events=4, start=0.25, stop=0.75), PhaseScheduler(64)
    counts = [before(part, iteration, phases) for iteration in range(65)]
    assert [i for i in range(1, 65) if counts[i] > counts[i - 1]] == [24, 32, 40, 48]


def test_a_faded_step_is_as_long_as_before_then_up_to_five_times() -> None:
    """exp_avg^2 = exp_avg_sq of the factors; a constant gradient shows it."""
    param = Parameter(torch.zeros(1000, 1))
    part = Fading(events=1, start=0.5, stop=0.505, names=("scales",))
    optimizer = PhaseScheduler(1000, parts=[part]).upgrade(
        Adam([{"params": [param], "name": "scales"}], lr=1.0, eps=0.0)
    )
    lengths = []
    for _ in range(600):
        before = param.detach().clone()
        param.grad = torch.ones(1000, 1)
        optimizer.step()
        lengths.append((before - param.detach()).abs())
    at = next(i for i, each in enumerate(lengths) if each.amax() > each.amin() * 1.01)
    faded = (lengths[at + 5] > 2 * lengths[at - 1]).flatten()
    assert torch.equal(faded, chosen_rows(part.fade(0), 1000, CPU))
    assert max(float(each.amax()) for each in lengths) <= 5.0
    assert max(float(each.amax()) for each in lengths) > 3.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"share": 0.0}, r"share=0.0.*\(0.0, 1.0\]"),
        ({"exp_avg": 1.5}, "exp_avg=1.5"),
        ({"exp_avg_sq": -1}, "exp_avg_sq=-1"),
        ({"exp_avg_sq": 1.5}, "exp_avg_sq=1.5"),
        ({"events": 0}, "events=0.*at least 1"),
        ({"start": 1.5}, "start=1.5"),
        ({"start": 0.7}, r"stop=0.7.*\(0.7, 1.0\]"),
        ({"stop": 1.5}, "stop=1.5"),
        ({"seed": -1}, "seed=-1"),
    ],
)
def test_options_that_are_refused(options: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Fading(**options)


def test_the_defaults_are_what_it_says_of_itself() -> None:
    assert repr(Fading()) == (
        "Fading(share=0.2, exp_avg=0.2, exp_avg_sq=0.04, events=300, start=0.03, stop=0.7, seed=0)"
    )
