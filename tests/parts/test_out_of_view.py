"""Points out of view: when they are held, how far, and that nothing else is touched."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch.nn import Parameter
from trainers import (
    assert_same,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    step_all,
    train,
    trained_by_adam,
    upgraded,
    values_of,
)

from opt3dgs_optim import Fading, OutOfView, Part
from opt3dgs_optim.parts.out_of_view import BELOW, SAMPLE

POINTS, SEEN = 200, 4  # a view sees 2 % of them
PULL = 1e-3  # of the regulariser; the images' gradients are about 1


def large(total_steps: int, *parts: Part, make: Any = gsplat_optimizers) -> tuple[Any, Any, Any]:
    """As `upgraded`, with many points, of which views have seen 2 % so far."""
    phases = only(total_steps, *parts)
    splats = make_splats(POINTS)
    optimizers = phases.upgrade(make(splats))
    first = optimizers["means"] if isinstance(optimizers, dict) else optimizers
    first.param_groups[0]["visible_share"] = SEEN / POINTS
    return splats, phases, optimizers


def iterate(
    splats: dict[str, Parameter], optimizers: Any, phases: Any, first: int, last: int, *, seen: int
) -> None:
    """Views see so many points in turn; a regulariser pulls at scales and opacities of all."""
    for i in range(first, last):
        rows = torch.arange(seen * i, seen * (i + 1)) % len(splats["means"])
        generator = torch.Generator().manual_seed(i)
        for name, param in splats.items():
            pull = PULL if name in ("scales", "opacities") else 0.0
            param.grad = torch.full_like(param, pull)
            param.grad[rows] += torch.randn(param.grad[rows].shape, generator=generator)
        if phases is not None:
            phases.observe(0.1)
        step_all(optimizers)


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_where_views_see_much_it_is_adam(make: Any) -> None:
    """Two thirds of the points here."""
    splats, phases, optimizers = upgraded(60, OutOfView(), make=make)
    train(splats, optimizers, phases, 0, 40)
    assert_same(splats, trained_by_adam(40))


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_an_emptied_point_out_of_view_makes_a_share_of_a_step(make: Any) -> None:
    moved = {}
    for parts in ((), (OutOfView(),)):
        splats, phases, optimizers = large(2_000, *parts, make=make)
        iterate(splats, optimizers, phases, 0, 100, seen=SEEN)
        for name in ("scales", "opacities"):  # as relocation does
            for moment in ("exp_avg", "exp_avg_sq"):
                state_of(optimizers, splats[name])[moment][0] = 0.0
        before = values_of(splats)
        iterate(splats, optimizers, phases, 101, 141, seen=SEEN)  # none of them sees point 0
        moved[bool(parts)] = {n: (p.detach() - before[n]).abs() for n, p in splats.items()}
    rates = {"scales": 0.005, "opacities": 0.05}
    for name, rate in rates.items():
        assert moved[False][name][0].min() > 30 * rate  # a full step each, and more at first
        most = 40 * rate * (SEEN / POINTS) / BELOW
        assert 0.2 * most < moved[True][name][0].min()  # what no view sees is still let go
        assert moved[True][name][0].max() < 1.3 * most
    for name in ("means", "quats", "sh0"):
        assert torch.equal(moved[True][name], moved[False][name]), name


def test_fading_does_not_undo_it() -> None:
    splats, phases, optimizers = large(600, Fading(share=1.0), OutOfView())
    iterate(splats, optimizers, phases, 0, 290, seen=SEEN)
    second = state_of(optimizers, splats["opacities"])["exp_avg_sq"]
    least = (PULL * BELOW * POINTS / SEEN) ** 2
    assert second.min() > 0.9 * least


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_a_resumed_training_goes_on_as_it_was(make: Any) -> None:
    runs = []
    for stop in (None, 60):
        splats, phases, optimizers = large(2_000, OutOfView(), make=make)
        iterate(splats, optimizers, phases, 0, 60, seen=SEEN)
        if stop is not None:
            saved = values_of(splats)
            every = optimizers if isinstance(optimizers, dict) else {"": optimizers}
            states = {n: copy.deepcopy(each.state_dict()) for n, each in every.items()}
            splats, phases, optimizers = large(2_000, OutOfView(), make=make)
            for name, param in splats.items():
                param.data.copy_(saved[name])
            every = optimizers if isinstance(optimizers, dict) else {"": optimizers}
            for name, each in every.items():
                each.load_state_dict(states[name])
        iterate(splats, optimizers, phases, 60, 90, seen=SEEN)
        runs.append(splats)
    assert_same(runs[0], runs[1])


def test_the_share_is_the_mean_over_a_hundred_views() -> None:
    splats, phases, optimizers = upgraded(60, OutOfView())
    shares = []
    for i in range(3):
        iterate(splats, optimizers, phases, i, i + 1, seen=3)  # of 12
        shares.append(optimizers["means"].param_groups[0]["visible_share"])
    assert shares == pytest.approx([1 - 0.75 * (1 - 0.99**k) for k in (1, 2, 3)], rel=1e-6)


def test_on_a_device_the_share_is_never_read() -> None:
    """The branch for numbers that live on a device, on the host: the same to rounding."""
    runs = []
    for start in (1.0, torch.tensor(1.0)):
        splats, phases, optimizers = large(2_000, OutOfView())
        optimizers["means"].param_groups[0]["visible_share"] = start
        iterate(splats, optimizers, phases, 0, 400, seen=SEEN)
        share = optimizers["means"].param_groups[0]["visible_share"]
        assert isinstance(share, type(start))
        runs.append((splats, float(share)))
    assert runs[0][1] == pytest.approx(runs[1][1], rel=1e-4)
    for name, param in runs[0][0].items():
        torch.testing.assert_close(param, runs[1][0][name], rtol=1e-4, atol=1e-5)


class OnDevice(torch.Tensor):
    """A host's tensor that says that it is none."""

    is_cpu = False  # pyright: ignore[reportAssignmentType, reportIncompatibleMethodOverride]


@pytest.mark.parametrize("seen", [POINTS // 2, 0])
def test_on_a_device_the_bounds_are_those_of_the_host(seen: int) -> None:
    """Above a third nothing changes, though no branch is taken; less than a hundredth is one."""
    _, phases, optimizers = large(2_000, part := OutOfView())
    grad = torch.zeros(POINTS, 3)
    grad[:seen] = 1.0
    group = optimizers["means"].param_groups[0]
    group["visible_share"] = torch.tensor(0.02 if seen == 0 else 0.9)
    for _ in range(1 if seen else 1000):
        phases.take(torch.tensor(0.1))
        part.before(group, grad, grad.as_subclass(OnDevice), {}, phases)
    share, state = float(group["visible_share"]), {"exp_avg_sq": torch.zeros(POINTS)}
    pull = torch.full((POINTS,), PULL)
    part.before(optimizers["opacities"].param_groups[0], pull, pull, state, phases)
    assert share == pytest.approx(0.896 if seen else 0.01, rel=1e-3)
    least = 0.0 if seen else (PULL * BELOW / 0.01) ** 2
    torch.testing.assert_close(state["exp_avg_sq"], torch.full((POINTS,), least), rtol=3e-3, atol=0)


def test_two_trainings_may_share_it() -> None:
    """As they do in the defaults: each goes on as it would alone, in turns with the other."""
    alone, both = [], []
    for shared in (False, True):
        part = OutOfView()
        runs = [large(2_000, part if shared else OutOfView()) for _ in range(2)]
        for i in range(30):
            for (splats, phases, optimizers), seen in zip(runs, (SEEN, 3 * SEEN), strict=True):
                iterate(splats, optimizers, phases, i, i + 1, seen=seen)
        (both if shared else alone).extend(run[0] for run in runs)
    for ours, theirs in zip(both, alone, strict=True):
        assert_same(ours, theirs)


def test_of_many_points_some_are_asked_and_all_are_held() -> None:
    points = 3 * SAMPLE
    _, phases, optimizers = large(2_000, part := OutOfView())
    group = optimizers["means"].param_groups[0]
    grad = torch.zeros(points, 3)
    grad[torch.arange(points) % 16 < 3, 2] = 1.0  # 3 of 16; of every fourth, a quarter
    phases.take(torch.tensor(0.1))
    part.before(group, grad, grad, {}, phases)
    assert group["visible_share"] == pytest.approx(0.02 + 0.01 * (0.25 - 0.02))
    state = {"exp_avg_sq": torch.zeros(points)}
    pull = torch.full((points,), PULL)
    part.before(optimizers["opacities"].param_groups[0], pull, pull, state, phases)
    assert torch.equal(state["exp_avg_sq"] > 0, grad[:, 2] == 0)


def test_the_run_log_has_the_share() -> None:
    splats, phases, optimizers = upgraded(60, OutOfView())
    iterate(splats, optimizers, phases, 0, 3, seen=3)
    assert phases.numbers() == {"visible_share": pytest.approx(1 - 0.75 * (1 - 0.99**3))}


def test_an_iteration_that_does_not_count_leaves_no_trace() -> None:
    splats, phases, optimizers = large(2_000, part := OutOfView())
    optimizers["means"].param_groups[0]["visible_share"] = torch.tensor(0.02)
    iterate(splats, optimizers, phases, 0, 3, seen=SEEN)
    share = float(optimizers["means"].param_groups[0]["visible_share"])
    phases.current += 1
    phases.valid = torch.tensor(False)
    for name in ("means", "scales", "opacities"):
        group, param = optimizers[name].param_groups[0], splats[name]
        state = optimizers[name].state[param]
        before = state["exp_avg_sq"].clone()
        pulled = torch.full_like(param, 0.0 if name == "means" else PULL)
        part.before(group, param, pulled, state, phases)
        assert torch.equal(state["exp_avg_sq"], before)
    assert float(optimizers["means"].param_groups[0]["visible_share"]) == share


def test_without_the_positions_of_this_iteration_it_does_nothing() -> None:
    """They are stepped last, or there are other points than at their last step."""
    splats, phases, optimizers = large(2_000, part := OutOfView())
    iterate(splats, optimizers, phases, 0, 3, seen=SEEN)
    for iteration, points in ((phases.current + 1, POINTS), (phases.current, POINTS + 1)):
        phases.current = iteration
        param = torch.zeros(points)
        state = {"exp_avg_sq": torch.zeros(points)}
        group = optimizers["opacities"].param_groups[0]
        part.before(group, param, torch.full_like(param, PULL), state, phases)
        assert not state["exp_avg_sq"].any()


@pytest.mark.parametrize("shape", [(), (0, 3)])
def test_no_points_are_no_error(shape: tuple[int, ...]) -> None:
    splats, phases, optimizers = upgraded(60, part := OutOfView())
    train(splats, optimizers, phases, 0, 1)
    param = torch.zeros(shape)
    group = optimizers["means"].param_groups[0]
    share = group["visible_share"]
    assert part.before(group, param, param, {}, phases) is param
    assert group["visible_share"] == share


def test_views_that_see_nothing_count_as_a_hundredth() -> None:
    splats, phases, optimizers = large(2_000, OutOfView())
    iterate(splats, optimizers, phases, 0, 400, seen=0)
    share = optimizers["means"].param_groups[0]["visible_share"]
    assert share == pytest.approx(0.01 + 0.01 * 0.99**400, rel=1e-6)


@pytest.mark.parametrize(("share", "acts"), [(0.32, True), (0.35, False)])
def test_it_acts_below_a_third(share: float, acts: bool) -> None:
    splats, phases, optimizers = large(2_000, OutOfView())
    optimizers["means"].param_groups[0]["visible_share"] = share
    iterate(splats, optimizers, phases, 0, 1, seen=SEEN)  # the share falls by a hundredth
    least = state_of(optimizers, splats["opacities"])["exp_avg_sq"][-1].item()
    plain = (1 - 0.999) * PULL**2
    assert (least > 2 * plain) is acts
