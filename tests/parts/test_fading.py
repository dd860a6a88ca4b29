"""Fading: which points, how often, and what happens to them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import devices
import pytest
import torch
from trainers import gsplat_optimizers, inria_optimizer, make_splats, only, state_of, train

from opt3dgs_optim import Fading, PhaseScheduler


class Moments(dict[str, Any]):
    """What a hook sees of a parameter's state."""

    def __init__(self, moments: dict[str, Any], last_step: int | None = None) -> None:
        super().__init__(moments)
        self.last_step = last_step


TOTAL = 60
CPU = torch.device("cpu")


def test_events_are_spread_evenly_and_each_happens_once() -> None:
    fading = Fading(events=300, start=0.03, stop=0.5)
    counts = [fading.events_before(i, 30_000) for i in range(30_001)]
    assert counts[900] == 0
    assert counts[-1] == counts[15_000] == 300
    steps = [b - a for a, b in itertools.pairwise(counts)]
    assert set(steps) == {0, 1}
    # A short run has fewer: they are four iterations apart or more.
    short = [Fading(events=300, start=0.0).events_before(i, 600) for i in range(601)]
    assert short[-1] == 75
    assert max(b - a for a, b in itertools.pairwise(short[::3])) == 1


def test_the_same_points_fade_in_all_parameters_and_the_share_is_right() -> None:
    splats = make_splats(400)
    fading = Fading(share=0.25, events=1, start=0.0, stop=0.5)
    phases = only(TOTAL, fading)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, 29)
    before = {
        name: {key: value.clone() for key, value in opt.state[splats[name]].items()}
        for name, opt in optimizers.items()
    }
    phases.observe(0.1)  # iteration 29: the event is before its step
    chosen = []
    for name, optimizer in optimizers.items():
        group, param = optimizer.param_groups[0], splats[name]
        moments = Moments(optimizer.state[param], 28)
        fading.before(group, param, torch.zeros_like(param), moments, phases)
        state = optimizer.state[splats[name]]
        faded = _ratio(state, before[name], "exp_avg") < 0.5
        chosen.append(faded)
        for key, factor in (("exp_avg", 0.2), ("exp_avg_sq", 0.04)):
            expected = torch.where(faded, factor, 1.0)
            torch.testing.assert_close(_ratio(state, before[name], key), expected)
    assert all(torch.equal(rows, chosen[0]) for rows in chosen)
    assert 60 <= int(chosen[0].sum()) <= 140  # 100 expected, deviation 8.7


def _ratio(after: dict[str, Any], before: dict[str, Any], key: str) -> torch.Tensor:
    """By what each point's moments were multiplied, [N]."""
    old = before[key].reshape(len(before[key]), -1)
    return (after[key].reshape(old.shape) * old).sum(1) / (old * old).sum(1)


def test_of_more_than_ten_thousand_points_fewer_events_happen_evenly_spread() -> None:
    fading = Fading()
    for num_points, every in ((1, 1), (9_999, 1), (10_000, 1), (80_000, 4), (270_000, 9)):
        happened = [event for event in range(300) if fading.happens(event, num_points)]
        assert 300 / every - 1 <= len(happened) <= 300 / every
        assert {b - a for a, b in itertools.pairwise(happened)} <= {every, every + 1}
    assert sum(fading.happens(event, 10_001) for event in range(300)) == 299
    assert not any(fading.happens(event, 0) for event in range(300))


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_only_the_named_parameters_fade(make: Any) -> None:
    after: list[dict[str, torch.Tensor]] = []
    every_parameter = Fading(1.0, events=1, start=0.0)
    named_ones = replace(every_parameter, names=("opacities", "scaling"))  # INRIA's: the scales
    for fading in ([], [named_ones], [every_parameter]):
        splats = make_splats(40)
        phases = only(TOTAL, *fading)
        optimizers = phases.upgrade(make(splats))
        train(splats, optimizers, phases, 0, 31)
        after.append(
            {name: state_of(optimizers, p)["exp_avg_sq"].clone() for name, p in splats.items()}
        )
    plain, some, every = after
    for name in plain:
        assert not torch.equal(plain[name], every[name]), name
        named = name in ("opacities", "scales")
        assert torch.equal(some[name], every[name] if named else plain[name]), name


def test_a_step_after_fading_is_no_longer_than_before() -> None:
    """0.2 / sqrt(0.04) = 1: what the defaults are chosen for."""
    param = torch.nn.Parameter(torch.zeros(500, 3))
    adam = torch.optim.Adam([param], lr=1.0)
    for i in range(200):
        param.grad = torch.randn(500, 3, generator=torch.Generator().manual_seed(i))
        adam.step()
    state = adam.state[param]
    length = (state["exp_avg"] / state["exp_avg_sq"].sqrt()).abs()
    phases = PhaseScheduler(TOTAL, parts=[])
    phases.observe(0.1, iteration=TOTAL // 2)
    Fading(share=1.0, events=1).before({}, param, param, Moments(state, 0), phases)
    faded = (state["exp_avg"] / state["exp_avg_sq"].sqrt()).abs()
    torch.testing.assert_close(faded, length)


# -- each event once, whatever the iterations do --------------------------------------------------


def trained(fading: Fading, iterations: Any, steps: int = 1) -> torch.Tensor:
    """Second moments of points that have the same gradient in each of `steps` per iteration."""
    x = torch.nn.Parameter(torch.ones(500, 3))
    phases = only(100, fading)
    means = phases.upgrade({"means": torch.optim.Adam([x], lr=0.0, betas=(0.9, 0.0))})["means"]
    means.defaults["betas"] = means.param_groups[0]["betas"] = (0.9, 1 - 1e-12)
    phases.observe(0.1, iteration=0)
    x.grad = torch.ones(500, 3)
    means.step()
    means.state[x]["exp_avg_sq"].fill_(1.0)
    for iteration in iterations:
        phases.observe(0.1, iteration=iteration)
        for _ in range(steps):
            x.grad = torch.zeros(500, 3)
            means.step()
    return means.state[x]["exp_avg_sq"][:, 0].log() / torch.tensor(0.04).log()


EVENTS = Fading(share=0.5, events=10, start=0.0, stop=1.0)


def test_an_iteration_that_jumps_loses_no_event() -> None:
    """A trainer that accumulates gradients, or one that resumes: the events in between come."""
    one_by_one = trained(EVENTS, range(1, 100))
    assert float(one_by_one.mean()) == pytest.approx(5, abs=0.3)
    for jumps in (range(4, 101, 5), [60, 99], [99]):
        assert torch.allclose(trained(EVENTS, jumps), one_by_one, atol=1e-3), jumps


def test_several_steps_per_iteration_fade_once() -> None:
    assert torch.allclose(
        trained(EVENTS, range(1, 100), 3), trained(EVENTS, range(1, 100)), atol=1e-3
    )


def test_a_rewound_training_does_not_fade_what_is_over() -> None:
    """Back to an earlier iteration without its checkpoint: nothing is faded for going back."""
    before, after = trained(EVENTS, [55]), trained(EVENTS, [55, 12])
    assert torch.allclose(before, after, atol=1e-3)


def second_moments(
    fading: Fading,
    iteration: int,
    *,
    total_steps: int = 100,
    last_step: int | None = None,
    num_points: int = 50,
) -> torch.Tensor:
    """Of points that were 1, after a step; the first of an Adam that was taken over."""
    param, phases = torch.nn.Parameter(torch.zeros(num_points, 3)), only(total_steps, fading)
    phases.observe(0.1, iteration=iteration - 1)
    moments = {key: torch.ones(num_points, 3) for key in ("exp_avg", "exp_avg_sq")}
    state = Moments(moments, last_step)
    fading.before({}, param, param.detach(), state, phases)
    return state["exp_avg_sq"]


def test_many_events_at_once_are_not_all_made_up_for() -> None:
    halved = Fading(share=1.0, exp_avg=0.5, exp_avg_sq=0.5, events=300, start=0.0, stop=1.0)
    found = second_moments(halved, 999, total_steps=1000, last_step=0)  # of 249
    assert torch.equal(found, torch.full((50, 3), 0.5**32))


@pytest.mark.parametrize(("num_points", "times"), [(10_000, 8), (80_000, 2)])
def test_an_event_that_does_not_happen_fades_nothing(num_points: int, times: int) -> None:
    """Eight events are made up for at once."""
    fading = Fading(share=1.0, exp_avg=0.5, exp_avg_sq=0.5, events=25, start=0.0, stop=1.0)
    found = second_moments(fading, 32, last_step=0, num_points=num_points)
    assert torch.equal(found, torch.full((num_points, 3), 0.5**times))


@pytest.mark.parametrize(("iteration", "factor"), [(50, 0.04), (51, 1.0), (49, 1.0)])
def test_a_training_taken_over_makes_up_for_nothing(iteration: int, factor: float) -> None:
    found = second_moments(Fading(share=1.0, events=10, start=0.0, stop=1.0), iteration)
    torch.testing.assert_close(found, torch.full((50, 3), factor))


def test_a_parameter_without_points_is_left_alone() -> None:
    fading, phases = Fading(share=1.0, events=10, start=0.0, stop=1.0), only(100)
    phases.observe(0.1, iteration=9)  # the first event
    scalar = torch.nn.Parameter(torch.tensor(1.0))
    state = {"exp_avg": torch.tensor(1.0), "exp_avg_sq": torch.tensor(1.0)}
    fading.before({}, scalar, scalar.detach(), Moments(state), phases)
    assert state == {"exp_avg": 1.0, "exp_avg_sq": 1.0}


@pytest.mark.parametrize("on_device", [False, True])
def test_the_event_of_a_dropped_step_has_happened(
    on_device: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a host as on a device, where nobody knows in time that the step is dropped."""
    if on_device:
        devices.on_a_device(monkeypatch)
    x = torch.nn.Parameter(torch.ones(50, 3))
    phases = only(100, Fading(share=1.0, events=1, start=0.0, stop=0.5))
    adam = torch.optim.Adam([x], lr=0.0, fused=True)
    means = phases.upgrade({"means": adam})["means"]
    for iteration, loss in ((0, 0.1), (49, float("nan")), (50, 0.1)):
        phases.observe(loss, iteration=iteration)
        x.grad = torch.zeros(50, 3) if iteration else torch.ones(50, 3)
        before = means.state[x]["exp_avg"].clone() if iteration else x.grad
        means.step()
        ratio = float((means.state[x]["exp_avg"] / before).mean())
        assert ratio == pytest.approx({0: 0.1, 49: 0.2, 50: 0.9}[iteration])


# -- the choice of points --------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2**31, 2**32, 2**40 + 7])
def test_every_seed_chooses_other_points(seed: int) -> None:
    """A CPU's generator reads 32 bits, all of which the event took."""
    chosen = [Fading(seed=seed).chosen(event, 4000, CPU) for event in range(3)]
    others = [Fading(seed=other).chosen(0, 4000, CPU) for other in (3, 5) if other != seed]
    for one, other in itertools.combinations([*chosen, *others], 2):
        # independent choices of 20 % have 4 % in common: 160, deviation 12
        assert 100 < int((one & other).sum()) < 220
    assert torch.equal(chosen[1], Fading(seed=seed).chosen(1, 4000, CPU))


@pytest.mark.parametrize(("seed", "event"), [(0, 7), (5, 100), (2**40 + 7, 3)])
def test_every_version_makes_the_same_choice(seed: int, event: int) -> None:
    """A checkpoint of the last release goes on as it was."""
    generator = torch.Generator().manual_seed((event + seed * 2654435761) % 4294967296)
    expected = torch.rand(500, generator=generator) < 0.2
    assert torch.equal(Fading(seed=seed).chosen(event, 500, CPU), expected)


def test_the_defaults_are_those_that_were_measured() -> None:
    assert Fading() == Fading(0.2, 0.2, 0.04, 300, 0.03, 0.5, 0)


def test_the_log_gets_the_share_of_this_iteration() -> None:
    phases = only(100, Fading(share=0.25, events=10, start=0.0, stop=1.0))
    for iteration, share in ((4, 0.0), (9, 0.25), (10, 0.0), (19, 0.25)):
        phases.observe(0.1, iteration=iteration)
        assert phases.numbers()["faded"] == pytest.approx(share), iteration
