"""Points out of view: when they are held, how far, and that nothing else is touched."""

from __future__ import annotations

import copy
from typing import Any

import devices
import pytest
import torch
from simulated_device import SimulatedDevice, on_device, on_host
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
from opt3dgs_optim.parts.out_of_view import (
    MAX_POINTS_LOOKED_AT,
    MAX_SEEN_SHARE,
    _is_looked_at,
    _mean_share,
)

POINTS, SEEN = 200, 4  # a view sees 2 % of them
FIRST_LOOKED_AT = (2, 5, 10)  # views, from 1
PULL = 1e-3  # of the regulariser; the images' gradients are about 1


def numbers_of(optimizers: Any) -> dict[str, torch.Tensor]:
    """What is kept for the positions."""
    first = optimizers["means"] if isinstance(optimizers, dict) else optimizers
    return first._records[0][0].numbers


def share_of(optimizers: Any) -> float:
    return float(numbers_of(optimizers)["OutOfView.seen_share"])


def set_share(optimizers: Any, share: float) -> None:
    numbers_of(optimizers)["OutOfView.seen_share"] = torch.tensor(share)


def hook(phases: Any, optimizer: Any, param: torch.Tensor, grad: torch.Tensor) -> torch.Tensor:
    """The part's `before` for a parameter in the place of the optimizer's; its second moments."""
    group, record = optimizer.param_groups[0], optimizer._records[0][0]
    group["params"], param.grad = [param], grad
    moments = {"exp_avg_sq": torch.zeros_like(param)}
    view = record.view(param, moments, phases.declared, phases.kept_numbers)
    phases.part(OutOfView).before(group, param, grad, view.of("OutOfView"), phases)
    return moments["exp_avg_sq"]


def large(total_steps: int, *parts: Part, make: Any = gsplat_optimizers) -> tuple[Any, Any, Any]:
    """As `upgraded`, with many points, of which views have seen 2 % so far."""
    phases = only(total_steps, *parts)
    splats = make_splats(POINTS)
    optimizers = phases.upgrade(make(splats))
    set_share(optimizers, SEEN / POINTS)
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
        most = 40 * rate * (SEEN / POINTS) / MAX_SEEN_SHARE
        assert 0.2 * most < moved[True][name][0].min()  # what no view sees is still let go
        assert moved[True][name][0].max() < 1.3 * most
    for name in ("means", "quats", "sh0"):
        assert torch.equal(moved[True][name], moved[False][name]), name


def test_fading_does_not_undo_it() -> None:
    splats, phases, optimizers = large(600, Fading(share=1.0), OutOfView())
    iterate(splats, optimizers, phases, 0, 290, seen=SEEN)
    second = state_of(optimizers, splats["opacities"])["exp_avg_sq"]
    least = (PULL * MAX_SEEN_SHARE * POINTS / SEEN) ** 2
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
    shares, looks = [], []
    for i in range(10):
        iterate(splats, optimizers, phases, i, i + 1, seen=3)  # of 12
        shares.append(share_of(optimizers))
        looks.append(sum(view <= i + 1 for view in FIRST_LOOKED_AT))
    assert shares == pytest.approx([1 - 0.75 * (1 - 0.96**k) for k in looks], rel=1e-6)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 5, 7, 8, 16, 50])
def test_one_view_in_four_is_looked_at_whatever_their_order(order: int) -> None:
    """Of each camera of a rig, say, whose photos come in turns."""
    assert tuple(view for view in range(1, 11) if _is_looked_at(view)) == FIRST_LOOKED_AT
    for first in range(order):
        looked_at = [_is_looked_at(view) for view in range(first, 100 * order, order)]
        assert 18 <= sum(looked_at) <= 32


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
    points = 3 * MAX_POINTS_LOOKED_AT
    _, phases, optimizers = large(2_000, OutOfView())
    grad = torch.zeros(points, 3)
    grad[torch.arange(points) % 16 < 3, 2] = 1.0  # 3 of 16; of every fourth, a quarter
    phases.take(torch.tensor(0.1))
    hook(phases, optimizers["means"], torch.zeros(points, 3), grad)
    assert share_of(optimizers) == pytest.approx(0.02 + 0.04 * (0.25 - 0.02))
    found = hook(phases, optimizers["opacities"], torch.zeros(points), torch.full((points,), PULL))
    assert torch.equal(found > 0, grad[:, 2] == 0)


def test_of_twice_as_many_points_as_are_looked_at_every_second_is_asked() -> None:
    _, phases, optimizers = large(2_000, OutOfView())
    grad = torch.zeros(MAX_POINTS_LOOKED_AT + 1, 3)
    grad[1::2] = 1.0  # the others
    grad[0] = 1.0
    phases.take(torch.tensor(0.1))
    hook(phases, optimizers["means"], torch.zeros_like(grad), grad)
    assert share_of(optimizers) == pytest.approx(0.02 + 0.04 * (0.01 - 0.02))


@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 3)])
def test_positions_of_any_shape(shape: tuple[int, ...]) -> None:
    """One number of a point is enough to be seen."""
    _, phases, optimizers = large(2_000, OutOfView())
    grad = torch.zeros(POINTS, *shape)
    grad.view(POINTS, -1)[:SEEN, -1] = 1.0
    phases.take(torch.tensor(0.1))
    hook(phases, optimizers["means"], torch.zeros_like(grad), grad)
    found = hook(phases, optimizers["opacities"], torch.zeros(POINTS), torch.full((POINTS,), PULL))
    assert torch.equal(found > 0, torch.arange(POINTS) >= SEEN)


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_share_that_is_not_read_from_a_gpu(share: float) -> None:
    """There it is a tensor, and it is the factor that says whether anything is raised."""
    splats, phases, optimizers = large(2_000, OutOfView())
    iterate(splats, optimizers, phases, 0, 1, seen=SEEN)
    unseen = torch.arange(POINTS) >= SEEN
    phases.publish("seen_share", splats["means"], torch.tensor(share))
    phases.publish("out_of_view", splats["means"], unseen)
    pull = torch.full((POINTS,), PULL)
    found = hook(phases, optimizers["opacities"], torch.zeros(POINTS), pull)
    least = (PULL / (3 * share)) ** 2 if share < MAX_SEEN_SHARE else 0.0
    torch.testing.assert_close(found, torch.where(unseen, least, 0.0), rtol=1e-5, atol=0.0)


def test_the_run_log_has_the_share() -> None:
    splats, phases, optimizers = upgraded(60, OutOfView())
    assert phases.numbers() == {"visible_share": 1.0}, "before the first view"
    iterate(splats, optimizers, phases, 0, 3, seen=3)
    assert phases.numbers() == {"visible_share": pytest.approx(1 - 0.75 * 0.04)}


@pytest.mark.parametrize("on_device", [False, True])
def test_an_iteration_that_does_not_count_leaves_no_trace(
    on_device: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if on_device:
        devices.on_a_device(monkeypatch)
    splats, phases, optimizers = large(2_000, OutOfView(), make=fused)
    iterate(splats, optimizers, phases, 0, FIRST_LOOKED_AT[1] - 1, seen=SEEN)
    share, before = share_of(optimizers), values_of(splats)
    second = state_of(optimizers, splats["opacities"])["exp_avg_sq"].clone()
    for name, param in splats.items():
        param.grad = torch.full_like(param, PULL if name in ("scales", "opacities") else 0.0)
    phases.observe(float("nan"))
    step_all(optimizers)
    assert_same(before, splats)
    assert share_of(optimizers) == share
    assert torch.equal(state_of(optimizers, splats["opacities"])["exp_avg_sq"], second)


def fused(splats: dict[str, Parameter]) -> Any:
    return gsplat_optimizers(splats, fused=True)


def test_where_the_positions_come_later_it_looks_at_their_gradient() -> None:
    splats, phases, optimizers = large(2_000, OutOfView())
    iterate(splats, optimizers, phases, 0, 3, seen=SEEN)
    set_share(optimizers, 0.2)
    phases.take(torch.tensor(0.1))
    phases.current = FIRST_LOOKED_AT[1] - 1
    splats["means"].grad = torch.zeros(POINTS, 3)
    splats["means"].grad[:SEEN] = 1.0
    pull = torch.full((POINTS,), PULL)
    found = hook(phases, optimizers["opacities"], torch.zeros(POINTS), pull)
    share = 0.2 + 0.04 * (SEEN / POINTS - 0.2)  # what it will be after the positions' step
    least = torch.full((POINTS,), (PULL / (3 * share)) ** 2)
    least[:SEEN] = 0.0
    torch.testing.assert_close(found, least, rtol=1e-5, atol=0.0)
    assert share_of(optimizers) == pytest.approx(0.2), "this view is counted at the positions"


@pytest.mark.parametrize(("seen", "looks"), [(SEEN, True), (POINTS, False)])
def test_where_views_see_much_nobody_asks_who_is_out_of_view(seen: int, looks: bool) -> None:
    """It would be a tensor of all points, for nothing."""
    splats, phases, optimizers = large(2_000, OutOfView())
    set_share(optimizers, seen / POINTS)
    iterate(splats, optimizers, phases, 0, 1, seen=seen)
    published = phases.published("out_of_view", splats["means"])
    assert (published is not None) is looks


def test_without_the_positions_of_this_iteration_it_does_nothing() -> None:
    """Nobody has a gradient of theirs, or there are other points than at their last step."""
    splats, phases, optimizers = large(2_000, OutOfView())
    iterate(splats, optimizers, phases, 0, 3, seen=SEEN)
    splats["means"].grad = None
    for iteration, points in ((phases.current + 1, POINTS), (phases.current, POINTS + 1)):
        phases.current = iteration
        pull = torch.full((points,), PULL)
        assert not hook(phases, optimizers["opacities"], torch.zeros(points), pull).any()


@pytest.mark.parametrize("shape", [(), (0, 3)])
def test_no_points_are_no_error(shape: tuple[int, ...]) -> None:
    splats, phases, optimizers = upgraded(60, OutOfView())
    train(splats, optimizers, phases, 0, 1)
    share = share_of(optimizers)
    hook(phases, optimizers["means"], torch.zeros(shape), torch.zeros(shape))
    assert share_of(optimizers) == share


def test_views_that_see_next_to_nothing_count_as_a_hundredth() -> None:
    splats, phases, optimizers = large(2_000, OutOfView())
    iterate(splats, optimizers, phases, 0, 400, seen=1)
    looks = sum(map(_is_looked_at, range(1, 401)))
    assert share_of(optimizers) == pytest.approx(0.01 + 0.01 * 0.96**looks, rel=1e-6)


def test_a_gradient_that_is_zero_everywhere_is_of_no_view() -> None:
    """Frozen positions whose gradient is kept: their share says nothing of the views."""
    splats, phases, optimizers = large(2_000, OutOfView())
    set_share(optimizers, 0.5)
    iterate(splats, optimizers, phases, 0, 400, seen=0)
    assert share_of(optimizers) == 0.5


@pytest.mark.parametrize("seen", [0, 1, 3, POINTS])
@pytest.mark.parametrize("view", [1, 2])
def test_a_gpu_takes_a_view_into_the_mean_as_the_host_does(seen: int, view: int) -> None:
    """And is not waited for."""
    grad = torch.zeros(POINTS, 3)
    grad[:seen] = 1.0
    kept = torch.tensor(0.5)
    found = _mean_share(grad, kept, view)
    assert (found == 0.5) == (view == 1 or seen == 0)
    with SimulatedDevice() as gpu:
        there, own = on_device(torch.tensor(0.5)), on_device(grad)
        gpu.forget()
        said = _mean_share(own, there, view)
        assert gpu.synchronisations == []
        assert float(on_host(there)) == float(on_host(said)) == pytest.approx(float(kept))


def test_the_share_of_a_single_point_is_known() -> None:
    phases = only(2_000, OutOfView())
    splats = make_splats(1)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    set_share(optimizers, 0.5)
    iterate(splats, optimizers, phases, 0, FIRST_LOOKED_AT[0], seen=1)
    assert share_of(optimizers) == pytest.approx(0.5 + 0.5 / 25)


@pytest.mark.parametrize(("share", "acts"), [(0.32, True), (0.35, False)])
def test_it_acts_below_a_third(share: float, acts: bool) -> None:
    splats, phases, optimizers = large(2_000, OutOfView())
    set_share(optimizers, share)
    iterate(splats, optimizers, phases, 0, 1, seen=SEEN)  # the share falls by a hundredth
    least = state_of(optimizers, splats["opacities"])["exp_avg_sq"][-1].item()
    plain = (1 - 0.999) * PULL**2
    assert (least > 2 * plain) is acts


@pytest.mark.parametrize("fused", [False, True])
def test_an_overflow_in_the_positions_puts_no_point_out_of_view(fused: bool) -> None:
    """A GradScaler drops their step; that of the scales counts, with an optimizer of its own."""

    def second_moments(*, overflow: bool) -> torch.Tensor:
        splats = {name: torch.nn.Parameter(torch.zeros(POINTS, 3)) for name in ("means", "scales")}
        phases = only(10_000, OutOfView())
        adams = {name: torch.optim.Adam([p], fused=fused) for name, p in splats.items()}
        phases.upgrade(adams)
        set_share(adams, SEEN / POINTS)
        scaler: Any = torch.amp.GradScaler("cpu", init_scale=4.0)  # pyright: ignore
        seen = (torch.arange(POINTS) < SEEN)[:, None].float()
        loss = sum(((param + 1) * seen).sum() for param in splats.values())
        scaler.scale(loss).backward()
        if overflow:
            assert splats["means"].grad is not None
            splats["means"].grad[0, 0] = float("inf")
        phases.observe(0.1)
        for adam in adams.values():
            scaler.step(adam)
        return state_of(adams, splats["scales"])["exp_avg_sq"]

    assert torch.equal(second_moments(overflow=True), second_moments(overflow=False))


@pytest.mark.parametrize("share", [-0.01, 1.01, float("nan")])
def test_a_share_that_none_can_be_is_damage(share: float) -> None:
    saved = []
    for _ in range(2):
        phases = only(2_000, OutOfView())
        param = torch.nn.Parameter(torch.zeros(4, 3))
        adam: Any = phases.upgrade(torch.optim.Adam([{"params": [param], "name": "means"}]))
        if saved:
            with pytest.raises(ValueError, match=r"seen_share=.* in \[0, 1\]"):
                adam.load_state_dict(saved[0])
            continue
        param.grad = torch.ones(4, 3)
        phases.observe(0.1)
        adam.step()
        saved.append(adam.state_dict())
        (record,) = saved[0]["param_groups"][0]["opt3dgs"]["optimizer"]["records"][0]
        record["numbers"]["OutOfView.seen_share"] = share
