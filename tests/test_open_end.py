"""A training of no planned end: it goes on, falls to an end when it is told to, and may go on."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from gaussians import adams_of, parameters, same_tensors, steps

from opt3dgs_optim import (
    Averaging,
    Curvature,
    FreshMoments,
    Part,
    PhaseScheduler,
    SquaredLoss,
)
from opt3dgs_optim.parts.averaging import SHARE_OF_FALL
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training

ROWS = 6


def begun(parts: Any = None, **options: Any) -> tuple[PhaseScheduler, Any, Any]:
    """A scheduler without a number, its optimizers, and the Gaussians."""
    params = parameters(ROWS)
    phases = PhaseScheduler(parts=parts, **options)
    return phases, phases.upgrade(adams_of(params)), params


@pytest.mark.parametrize("moments", [32, 16])
def test_it_ends_at_the_mean_of_the_last_fifth_of_its_fall(moments: Any) -> None:
    phases, optimizers, params = begun([Averaging()], moments=moments)
    steps(optimizers, params, 33)
    phases.finish_in(100)
    iterates: list[Any] = []
    for i in range(100):
        steps(optimizers, params, 1, seed=i)
        if 100 - int(SHARE_OF_FALL * 100) <= i < 98:
            iterates.append(params["sh0"].detach().double())
    mean = torch.stack(iterates).mean(0)
    assert (params["sh0"].double() - mean).abs().max() < 0.01
    assert (iterates[-1] - mean).abs().max() > 0.02
    assert phases.total_steps == 133
    assert phases.end_line() is None


def test_steps_fall_to_the_end_and_are_as_long_as_before_after_it(caplog: Any) -> None:
    caplog.set_level("INFO")
    phases, optimizers, params = begun()
    rates = []
    for count in (200, 50, 20):
        for i in range(count):
            steps(optimizers, params, 1, seed=i)
            rates.append(float(phases.numbers()["own_frame_rate"]))
        if count == 200:
            phases.finish_in(50)
    fall = rates[200:250]
    assert fall == sorted(fall, reverse=True)
    assert fall[-1] < 0.1 * fall[0]
    assert rates[250] > 0.9 * rates[199]
    assert phases.total_steps is None
    said = "after the end that was planned at 250, so that the parameters are the last iterate"
    assert said in str(phases.end_line())
    assert caplog.text.count("the end that was planned, at iteration 250, is over; the") == 1
    assert "opt3dgs_optim: no planned end, OwnFrame, Fading, " in caplog.text
    phases.finish_in(10)
    steps(optimizers, params, 10)
    assert phases.total_steps == 280
    assert phases.end_line() is None


def test_what_holds_no_gaussians_is_averaged_and_forgets_it_too() -> None:
    params = {**parameters(ROWS), "cameras": torch.nn.Parameter(torch.zeros(4, 9))}
    phases = PhaseScheduler(parts=[Averaging(names=None)])
    optimizers = phases.upgrade(adams_of(params))
    cameras = params["cameras"]
    phases.finish_in(100)
    steps(optimizers, params, 95)
    mean = optimizers["cameras"].state[cameras]["averaging.mean"].clone()
    assert not torch.equal(cameras, mean)
    phases.finish()
    assert torch.equal(cameras, mean)
    phases.finish_in(60)
    assert "averaging.mean" not in optimizers["cameras"].state[cameras]


def test_after_finish_it_may_be_ended_again() -> None:
    phases, optimizers, params = begun([Averaging()])
    for _ in range(2):
        steps(optimizers, params, 20)
        phases.finish_in(60)
        steps(optimizers, params, 60)
        assert phases.ended
        assert "averaging.mean" in optimizers["sh0"].state[params["sh0"]]
        phases.finish()
        phases.finish_in(30)
        steps(optimizers, params, 30)


def test_the_end_is_known_until_another_is_planned() -> None:
    """A trainer may look after two steps."""
    phases, optimizers, params = begun()
    assert not phases.ended
    phases.finish_in(11)
    ended = []
    for _ in range(8):
        steps(optimizers, params, 2)
        ended.append(phases.ended)
    assert ended == [False] * 5 + [True] * 3
    phases.finish_in(10)
    assert not phases.ended


def test_back_to_a_checkpoint_from_before_the_end() -> None:
    phases, optimizers, params = begun()
    steps(optimizers, params, 50)
    trunk = {name: copy.deepcopy(each.state_dict()) for name, each in optimizers.items()}
    phases.finish_in(20)
    steps(optimizers, params, 21)
    for name, each in optimizers.items():
        each.load_state_dict(trunk[name])
    assert (phases.iteration, phases.fall_step, phases.total_steps) == (49, None, None)
    assert not phases.ended
    phases.finish_in(30)
    assert phases.total_steps == 80


def test_back_into_the_fall_with_the_positions_loaded_last() -> None:
    phases, optimizers, params = begun([Averaging()])
    steps(optimizers, params, 40)
    phases.finish_in(60)
    steps(optimizers, params, 56)
    saved = {name: copy.deepcopy(each.state_dict()) for name, each in optimizers.items()}
    steps(optimizers, params, 10)
    for name in reversed(list(optimizers)):
        optimizers[name].load_state_dict(saved[name])
    assert all("averaging.mean" in optimizers[n].state[params[n]] for n in params)


def test_a_mean_of_a_fall_is_none_of_a_planned_end() -> None:
    """They count iterates by their own measure."""
    phases, optimizers, params = begun([Averaging()])
    steps(optimizers, params, 10)
    phases.finish_in(90)
    steps(optimizers, params, 85)
    planned = PhaseScheduler(100, parts=[Averaging()])
    others = planned.upgrade(adams_of(params))
    for name, each in others.items():
        each.load_state_dict(optimizers[name].state_dict())
        assert "averaging.mean" not in each.state[params[name]]


def test_pairs_of_one_fall_are_none_of_the_next() -> None:
    phases, optimizers, params = begun([Curvature()])
    phases.finish_in(20)
    steps(optimizers, params, 20)
    state = optimizers["means"].state[params["means"]]
    assert "curvature.history" in state
    steps(optimizers, params, 1)
    assert "curvature.history" not in state


@pytest.mark.parametrize("saved_at", [50, 75, 98])
def test_a_checkpoint_knows_of_the_fall(saved_at: int) -> None:
    phases, optimizers, params = begun()
    steps(optimizers, params, 40)
    phases.finish_in(60)
    steps(optimizers, params, saved_at - 40, seed=1)
    saved = {name: copy.deepcopy(each.state_dict()) for name, each in optimizers.items()}
    values = {name: p.detach().clone() for name, p in params.items()}
    again, others, new = begun()
    for name, each in others.items():
        new[name].data.copy_(values[name])
        each.load_state_dict(saved[name])
    assert (again.fall_step, again.total_steps) == (40, 100)
    for its, of in ((optimizers, params), (others, new)):
        steps(its, of, 100 - saved_at, seed=2)
    assert same_tensors(params, new)


def test_a_planned_training_goes_on_without_an_end_and_the_other_way_round() -> None:
    for first, then in ((100, None), (None, 100)):
        params = parameters(ROWS)
        optimizers: Any = PhaseScheduler(first).upgrade(adams_of(params))
        steps(optimizers, params, 99)
        phases = PhaseScheduler(then)
        phases.upgrade(optimizers)
        assert phases.iteration == 98
        assert phases.total_steps == then
        steps(optimizers, params, 1)
        kept = "averaging.mean" in optimizers["sh0"].state[params["sh0"]]
        assert kept is (then == 100)


def test_its_moments_begin_anew_and_its_loss_is_squared() -> None:
    """The loss is that of the coming iteration."""
    phases, optimizers, params = begun([FreshMoments(), SquaredLoss()])
    half, none = torch.full((4,), 0.5), torch.zeros(4)
    steps(optimizers, params, 5)
    phases.finish_in(10)
    losses, counts = [], []
    for i in range(12):
        losses.append(float(phases.pixel_loss(half, none)))
        steps(optimizers, params, 1, seed=i)
        counts.append(int(optimizers["sh0"].state[params["sh0"]]["step"]))
    assert losses == [0.25] * 10 + [0.5] * 2
    assert counts == list(range(1, 13))


def test_its_length_may_be_told_later() -> None:
    """The last sixth is the fall, or what is left of it."""
    phases, optimizers, params = begun()
    assert phases.total_steps is None
    steps(optimizers, params, 20)
    for total, start in ((600, 500), (90, 75), (54, 44), (30, 20), (120, 100)):
        phases.total_steps = total
        assert (phases.fall_step, phases.total_steps) == (start, total)
    told = copy.deepcopy((phases, optimizers, params))
    for count in (60, 20, 20):
        steps(*told[1:], count)
    steps(optimizers, params, 60)
    phases.finish_in(20)  # enough: an end that has not begun gives way
    assert (phases.fall_step, phases.total_steps) == (80, 100)
    phases.total_steps = 120
    steps(optimizers, params, 20)
    phases.finish_in(20)
    steps(optimizers, params, 20)
    assert phases.ended
    assert told[0].end_line() is phases.end_line() is None
    assert same_tensors(params, told[2])
    steps(optimizers, params, 1)
    assert phases.total_steps is None


def test_what_parts_keep_is_kept_until_the_end_begins() -> None:
    class Sum(Part):
        names = ("means",)

        def plan(self, step: Step, training: Training) -> None:
            step.keep(step.state, "sum.of", step.param.shape).add_(1)

    phases, optimizers, params = begun([Sum()])
    steps(optimizers, params, 20)
    state = optimizers["means"].state[params["means"]]
    phases.total_steps = 60
    phases.finish_in(20)
    assert "sum.of" in state


def test_it_has_ended_after_its_last_step() -> None:
    """And not where a trainer puts the clock there, before the step."""
    phases, optimizers, params = begun()
    steps(optimizers, params, 20)
    phases.finish_in(10)
    steps(optimizers, params, 9)
    phases.observe(iteration=29)
    assert not phases.ended
    steps(optimizers, params, 1)
    assert (phases.iteration, phases.ended) == (29, True)


def test_a_jump_up_to_the_fall_is_none_in_it() -> None:
    phases, optimizers, params = begun()
    steps(optimizers, params, 1)
    phases.total_steps = 600
    phases.observe(iteration=500)
    with pytest.raises(ValueError, match="to 501 at most"):
        phases.observe(iteration=502)


def test_a_checkpoint_from_before_finish_ends_again() -> None:
    phases, optimizers, params = begun([Averaging()])
    phases.finish_in(60)
    steps(optimizers, params, 54)
    saved = {name: copy.deepcopy(each.state_dict()) for name, each in optimizers.items()}
    phases.finish()
    for name, each in optimizers.items():
        each.load_state_dict(saved[name])
    steps(optimizers, params, 6)
    for name, each in optimizers.items():
        assert torch.equal(each.state[params[name]]["averaging.mean"], params[name]), name


def test_a_length_before_the_first_step_is_refused() -> None:
    phases, _, _ = begun()
    with pytest.raises(ValueError, match=r"no step has been made yet; give it, PhaseScheduler\(9"):
        phases.total_steps = 90


@pytest.mark.parametrize("total", [29, 0, 40.0, None])
def test_a_length_that_is_over_or_no_number_is_refused(total: Any) -> None:
    phases, optimizers, params = begun()
    steps(optimizers, params, 20)
    phases.total_steps = 100
    with pytest.raises(ValueError, match=r"total_steps=.* an integer at least 30"):
        phases.total_steps = total
    assert phases.total_steps == 100


@pytest.mark.parametrize("count", [9, 0, -1, 12.5, True, None])
def test_what_is_no_number_of_iterations_is_refused(count: Any) -> None:
    phases, _, _ = begun()
    with pytest.raises(ValueError, match=r"finish_in: iterations=.* an integer at least 10"):
        phases.finish_in(count)


def test_an_end_that_is_planned_or_begun_is_refused() -> None:
    phases, optimizers, params = begun()
    steps(optimizers, params, 3)
    phases.finish_in(15)
    steps(optimizers, params, 1)
    with pytest.raises(ValueError, match="finish_in: the end has begun, from iteration 3 to 18"):
        phases.finish_in(15)
    phases.total_steps = 18  # that is so already
    with pytest.raises(ValueError, match="total_steps = 90: the end has begun, from iteration 3"):
        phases.total_steps = 90
    planned = PhaseScheduler(100)
    with pytest.raises(ValueError, match="total_steps=100 plans the end; "):
        planned.finish_in(15)
    with pytest.raises(ValueError, match="total_steps = 90: total_steps=100 plans the end; "):
        planned.total_steps = 90


def test_a_jump_in_the_fall_is_refused() -> None:
    """It could leave out the end, as of a trainer that counts images."""
    phases, optimizers, params = begun()
    phases.observe(iteration=400)
    steps(optimizers, params, 1)
    phases.finish_in(20)
    phases.observe(iteration=401)
    with pytest.raises(ValueError, match="to 402 at most; the end counts steps: leave out"):
        phases.observe(iteration=404)
    with pytest.raises(ValueError, match="401 of 421 and goes forward"):
        phases.observe(iteration=3)


def test_what_ends_without_a_fall_is_told(caplog: Any) -> None:
    phases, optimizers, params = begun()
    steps(optimizers, params, 7)
    assert "ended at iteration 7 of no planned end, so" in (phases.end_line() or "")
    phases.finish_in(10)
    steps(optimizers, params, 4)
    assert "ended at iteration 11 of 17, so" in (phases.end_line() or "")
    phases.finish()
    assert "the parameters stay the last iterate" in caplog.text


class _Lengths(Part):
    """What a part of the user's own sees of the clock."""

    def __init__(self) -> None:
        self.seen: list[tuple[Any, float]] = []

    def plan(self, step: Any, training: Any) -> None:
        self.seen.append((training.total_steps, training.fallen))


def test_a_part_sees_how_far_the_fall_is() -> None:
    part = _Lengths()
    phases, optimizers, params = begun([part])
    steps(optimizers, {"means": params["means"]}, 2)
    phases.finish_in(10)
    steps(optimizers, {"means": params["means"]}, 11)
    fall = [(12, pytest.approx(i / 10)) for i in range(10)]
    assert part.seen == [(None, 0.0), (None, 0.0), *fall, (None, 0.0)]
