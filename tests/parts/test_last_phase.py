"""What changes at the switch: the loss and the moments."""

from __future__ import annotations

import pytest
import torch
from devices import on_a_device
from trainers import (
    assert_same,
    edit_rows,
    gsplat_optimizers,
    inria_optimizer,
    state_of,
    train,
    upgraded,
    values_of,
)

from opt3dgs_optim import FreshMoments

TOTAL, SWITCH = 60, 40


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
    ours, phases, optimizers = upgraded(TOTAL, FreshMoments(), switch=SWITCH, amsgrad=True)
    train(ours, optimizers, phases, 0, SWITCH)
    theirs = {name: torch.nn.Parameter(value) for name, value in values_of(ours).items()}
    train(ours, optimizers, phases, SWITCH, TOTAL)
    train(theirs, gsplat_optimizers(theirs, amsgrad=True), None, SWITCH, TOTAL)
    assert_same(ours, theirs)


def test_points_that_come_after_the_switch_do_not_start_the_others_anew() -> None:
    splats, phases, optimizers = upgraded(TOTAL, FreshMoments(), switch=SWITCH)
    train(splats, optimizers, phases, 0, SWITCH + 5)
    edit_rows(splats, optimizers, torch.arange(12), 3)
    train(splats, optimizers, phases, SWITCH + 5, SWITCH + 6)
    assert float(state_of(optimizers, splats["means"])["step"]) == 6.0


@pytest.mark.parametrize("options", [{"foreach": False}, {"foreach": True}, {"fused": True}])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("device", [False, True])
def test_a_step_that_is_dropped_at_the_switch_does_not_lose_the_fresh_start(
    options: dict[str, bool], masked: bool, device: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where only the device knows, off the fused path, it is made and put back: Adam's part."""
    if device:
        on_a_device(monkeypatch)
    splats, phases, optimizers = upgraded(TOTAL, FreshMoments(), switch=SWITCH, **options)
    train(splats, optimizers, phases, 0, SWITCH)
    before = values_of(splats)
    phases.observe(float("nan"))
    for name, optimizer in optimizers.items():
        splats[name].grad = torch.ones_like(splats[name])
        optimizer.step(visible=torch.arange(len(splats[name])) >= 0 if masked else None)
    assert_same(splats, before)
    # A host has not begun; nor has a path that cannot drop a step, for which the host is asked.
    for param in splats.values() if device and "fused" in options else ():
        state = state_of(optimizers, param)
        assert not any(bool(state[key].any()) for key in ("step", "exp_avg", "exp_avg_sq"))
    train(splats, optimizers, phases, SWITCH + 1, SWITCH + 2)
    assert {float(state_of(optimizers, p)["step"]) for p in splats.values()} == {1.0}
