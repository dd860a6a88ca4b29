"""What changes at the switch: the loss and the moments."""

from __future__ import annotations

import pytest
import torch
from devices import on_a_device
from trainers import (
    edit_rows,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    train,
    upgraded,
)

from opt3dgs_optim import FreshMoments, SquaredLoss

TOTAL, SWITCH = 60, 40


def test_the_loss_is_squared_while_exploiting() -> None:
    phases = only(18, SquaredLoss(), switch=12)
    render, target = torch.full((2, 2, 3), 0.5), torch.zeros(2, 2, 3)
    for iteration in range(18):
        expected = 0.25 if iteration >= 12 else 0.5
        assert float(phases.pixel_loss(render, target)) == expected
        phases.observe(0.1)


@pytest.mark.parametrize("settling", [0, TOTAL - SWITCH, TOTAL - SWITCH + 1])
@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_moments_start_anew_at_the_switch_where_there_is_time(make, settling: int) -> None:
    splats, phases, optimizers = upgraded(TOTAL, FreshMoments(settling), switch=SWITCH, make=make)
    train(splats, optimizers, phases, 0, SWITCH + 1)
    fresh = settling <= TOTAL - SWITCH
    for param in splats.values():
        state = state_of(optimizers, param)
        assert float(state["step"]) == (1.0 if fresh else SWITCH + 1.0)
    train(splats, optimizers, phases, SWITCH + 1, TOTAL)
    steps = TOTAL - SWITCH if fresh else TOTAL
    assert {float(state_of(optimizers, p)["step"]) for p in splats.values()} == {steps}


def test_the_first_step_after_the_switch_is_that_of_a_new_adam() -> None:
    ours, theirs = make_splats(), make_splats()
    phases = only(TOTAL, FreshMoments(), switch=SWITCH)
    optimizers = phases.upgrade(gsplat_optimizers(ours, amsgrad=True))
    train(ours, optimizers, phases, 0, SWITCH)
    for name, param in ours.items():
        theirs[name].data.copy_(param.data)
    train(ours, optimizers, phases, SWITCH, TOTAL)
    train(theirs, gsplat_optimizers(theirs, amsgrad=True), None, SWITCH, TOTAL)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_points_that_come_after_the_switch_do_not_start_the_others_anew() -> None:
    splats, phases, optimizers = upgraded(TOTAL, FreshMoments(), switch=SWITCH)
    train(splats, optimizers, phases, 0, SWITCH + 5)
    edit_rows(splats, optimizers, torch.arange(12), 3)
    train(splats, optimizers, phases, SWITCH + 5, SWITCH + 6)
    assert float(state_of(optimizers, splats["means"])["step"]) == 6.0


def test_a_step_that_is_dropped_at_the_switch_does_not_lose_the_fresh_start() -> None:
    splats, phases, optimizers = upgraded(TOTAL, FreshMoments(), switch=SWITCH)
    train(splats, optimizers, phases, 0, SWITCH)
    phases.observe(float("nan"))
    for optimizer in optimizers.values():
        optimizer.step()
    train(splats, optimizers, phases, SWITCH + 1, SWITCH + 2)
    assert {float(state_of(optimizers, p)["step"]) for p in splats.values()} == {1.0}


@pytest.mark.parametrize("options", [{"foreach": False}, {"foreach": True}, {"fused": True}])
@pytest.mark.parametrize("masked", [False, True])
def test_nor_does_one_of_which_only_the_device_knows(
    options: dict[str, bool], masked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Off the fused path such a step is made and put back: Adam's part of it alone."""
    on_a_device(monkeypatch)
    splats, phases, optimizers = upgraded(TOTAL, FreshMoments(), switch=SWITCH, **options)
    train(splats, optimizers, phases, 0, SWITCH)
    before = {name: param.detach().clone() for name, param in splats.items()}
    phases.observe(float("nan"))
    for name, optimizer in optimizers.items():
        splats[name].grad = torch.ones_like(splats[name])
        optimizer.step(visible=torch.arange(len(splats[name])) >= 0 if masked else None)
    for name, param in splats.items():
        assert torch.equal(param, before[name])
        state = state_of(optimizers, param)
        assert [float(state[key].abs().max()) for key in ("step", "exp_avg", "exp_avg_sq")] == [
            0
        ] * 3
    train(splats, optimizers, phases, SWITCH + 1, SWITCH + 2)
    assert {float(state_of(optimizers, p)["step"]) for p in splats.values()} == {1.0}
