"""Ways of using the package wrongly that can be seen: each is said once, with the cure."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from torch.nn import Parameter
from trainers import gsplat_optimizers, make_splats, state_of, step_all, train

from opt3dgs_optim import Annealing, Averaging, Fading, PhaseScheduler
from opt3dgs_optim.names import GAUSSIAN

TOTAL = 1000


def begun(total: int = TOTAL) -> tuple[dict[str, Parameter], PhaseScheduler, Any]:
    splats = make_splats()
    phases = PhaseScheduler(total, parts=[Fading(), Averaging()])
    return splats, phases, phases.upgrade(gsplat_optimizers(splats))


def said(action: Any) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        action()
    return [str(each.message) for each in caught]


def iterate(splats: Any, phases: Any, optimizers: Any, count: int, loss: float = 0.1) -> None:
    for _ in range(count):
        for param in splats.values():
            param.grad = torch.ones_like(param)
        phases.observe(loss)
        step_all(optimizers)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_losses_that_are_not_finite_for_long(bad: float) -> None:
    splats, phases, optimizers = begun()
    iterate(splats, phases, optimizers, 5)
    assert said(lambda: iterate(splats, phases, optimizers, 20, bad)) == []
    (message,) = said(lambda: iterate(splats, phases, optimizers, 30, bad))
    assert "21 losses in a row were not finite" in message
    assert "look for the first NaN" in message


def test_observe_after_the_step() -> None:
    splats, phases, optimizers = begun()

    def late() -> None:
        for _ in range(5):
            for param in splats.values():
                param.grad = torch.ones_like(param)
            step_all(optimizers)
            phases.observe(0.1)

    (message,) = said(late)
    assert "call observe after backward, before the steps" in message


def test_some_optimizers_made_anew() -> None:
    splats, phases, optimizers = begun()
    iterate(splats, phases, optimizers, 3)
    optimizers["scales"] = torch.optim.Adam([splats["scales"]])

    def go_on() -> None:
        iterate(splats, phases, optimizers, 300)

    (message,) = said(go_on)
    assert "1 of 6 upgraded optimizers do not exist any more" in message
    assert "call upgrade(...) again" in message


def test_all_optimizers_made_anew() -> None:
    splats, phases, optimizers = begun()
    iterate(splats, phases, optimizers, 3)
    fresh = gsplat_optimizers(splats)
    (message,) = said(lambda: iterate(splats, phases, fresh, 300))
    assert "no upgraded optimizer has stepped" in message


def test_gaussians_frozen_before_the_end_are_told_what_to_give() -> None:
    splats, phases, optimizers = begun()
    iterate(splats, phases, optimizers, 3)
    (message,) = said(lambda: iterate(splats, phases, {}, 300))
    assert "where it freezes the Gaussians before the end, give total_steps" in message


def test_a_name_that_is_not_known_beside_others_of_as_many_rows() -> None:
    """fVDB's `log_scales`, before it was known: fading without `OutOfView`'s scales."""
    splats = make_splats()
    groups = [{"params": [p], "name": n} for n, p in splats.items()]
    groups[1]["name"] = "sizes"
    groups.append({"params": [Parameter(torch.zeros(3, 4))], "name": "poses"})
    phases = PhaseScheduler(TOTAL)
    (message,) = said(lambda: phases.upgrade(torch.optim.Adam(groups)))
    assert "sizes stay as they are" in message
    assert "poses" not in message


def test_a_second_scheduler_is_refused() -> None:
    _, _, optimizers = begun()
    with pytest.raises(TypeError, match="with parts of its own"):
        PhaseScheduler(TOTAL).upgrade(optimizers)


@pytest.mark.parametrize("how", ["method", "list"])
def test_groups_that_come_after_the_upgrade_have_the_parts(how: str) -> None:
    splats = make_splats()
    groups = [{"params": [p], "name": n} for n, p in splats.items() if n != "sh0"]
    phases = PhaseScheduler(60, parts=[Annealing(4.0, 4.0, 4.0, names=GAUSSIAN)])
    adam: Any = phases.upgrade(torch.optim.Adam(groups, lr=0.01))
    group: dict[str, Any] = {"params": [splats["sh0"]], "name": "sh0"}
    if how == "method":
        adam.add_param_group(group)
    else:
        adam.param_groups.append({**adam.defaults, **group})
    splats["sh0"].grad = torch.ones_like(splats["sh0"])
    before = splats["sh0"].detach().clone()
    phases.observe(0.1)
    adam.step()
    torch.testing.assert_close(before - splats["sh0"].detach(), torch.full_like(before, 0.04))


def test_a_group_that_was_exchanged_without_a_name_holds_what_it_held() -> None:
    splats, phases, optimizers = begun(60)
    train(splats, optimizers, phases, 0, 3)
    adam = optimizers["means"]
    adam.param_groups[0] = {k: v for k, v in adam.param_groups[0].items() if k != "name"}
    train(splats, optimizers, phases, 3, 60)
    assert "Averaging.mean" in state_of(optimizers, splats["means"])


def test_parts_cannot_be_changed_behind_the_plans_back() -> None:
    _, phases, _ = begun()
    with pytest.raises(AttributeError):
        phases.parts = ()  # type: ignore[misc]
    with pytest.raises(AttributeError):
        phases.parts.append(Averaging())  # type: ignore[attr-defined]


def test_one_part_twice_is_refused() -> None:
    part = Fading()
    with pytest.raises(ValueError, match="twice"):
        PhaseScheduler(TOTAL, parts=[part, part])
