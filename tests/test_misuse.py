"""Ways of using the package wrongly that can be seen: each is said once, with the cure."""

from __future__ import annotations

import copy
import gc
import warnings
from typing import Any

import pytest
import torch
from placed_training import some_of
from torch.nn import Parameter
from trainers import gsplat_optimizers, make_splats, state_of, step_all, train

from opt3dgs_optim import (
    Annealing,
    Averaging,
    EnergyHistogram,
    Fading,
    LQNAdam,
    PhaseScheduler,
)
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


def test_some_optimizers_made_anew_while_a_rates_schedule_holds_the_old() -> None:
    splats, phases, optimizers = begun(1_000)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizers["scales"], 0.99)
    iterate(splats, phases, optimizers, 3)
    optimizers["scales"] = torch.optim.Adam([splats["scales"]])
    (message,) = said(lambda: iterate(splats, phases, optimizers, 700))
    assert schedule is not None
    assert "1 of 6 upgraded optimizers have made no step for more than 200" in message
    assert "call upgrade(...) again" in message


@pytest.mark.parametrize("every", [16, 64])
def test_an_optimizer_that_steps_rarely_is_no_mistake(every: int) -> None:
    """taming-3dgs's and FastGS's."""
    splats, phases, optimizers = begun(1_000)

    def train() -> None:
        for i in range(700):
            for param in splats.values():
                param.grad = torch.ones_like(param)
            phases.observe(0.1)
            step_all({k: o for k, o in optimizers.items() if k != "shN" or i % every == every - 1})

    assert said(train) == []


@pytest.mark.parametrize("made", ["before the old ones are gone", "after"])
def test_all_optimizers_made_anew_and_upgraded_again_is_no_mistake(made: str) -> None:
    """mini-splatting's training_setup in the middle of a training, with our advice followed."""
    splats, phases, optimizers = begun(1_000)
    iterate(splats, phases, optimizers, 3)
    if made == "after":
        optimizers = None
        gc.collect()
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    assert said(lambda: iterate(splats, phases, optimizers, 700)) == []
    del optimizers["scales"]
    gc.collect()
    (message,) = said(lambda: iterate(splats, phases, optimizers, 250))
    assert "1 of 6 upgraded optimizers do not exist any more" in message


@pytest.mark.parametrize("closure", [False, True])
def test_observe_after_the_step_where_one_optimizer_steps_rarely(closure: bool) -> None:
    splats, phases, optimizers = begun()

    def train() -> None:
        for i in range(20):
            for param in splats.values():
                param.grad = torch.ones_like(param)
            stepped = [o for k, o in optimizers.items() if k != "shN" or i % 16 == 15]
            if closure:
                stepped[0].step(lambda: torch.tensor(0.1))
            for optimizer in stepped[closure:]:
                optimizer.step()
            if not closure:
                phases.observe(0.1)

    messages = said(train)
    assert len(messages) == (0 if closure else 1)
    assert all("call observe after backward, before the steps" in each for each in messages)


@pytest.mark.parametrize("count", [lambda i: 7, lambda i: i % 100])
def test_a_count_that_does_not_advance(count: Any) -> None:
    splats, phases, optimizers = begun(1_000)

    def train() -> None:
        for i in range(900):
            for param in splats.values():
                param.grad = torch.ones_like(param)
            phases.observe(0.1, iteration=count(i))
            step_all(optimizers)

    (message,) = said(train)
    assert "the schedule does not advance; give the iteration of the whole training" in message


def test_moments_that_came_past_our_load_state_dict() -> None:
    """As ZeRO's wrapper puts them into an optimizer that was upgraded before."""
    splats, phases, optimizers = begun()
    for name, param in splats.items():
        moments = {"exp_avg": torch.zeros_like(param), "exp_avg_sq": torch.ones_like(param)}
        optimizers[name].state[param] = {"step": torch.tensor(250.0), **moments}
    (message,) = said(lambda: iterate(splats, phases, optimizers, 5))
    assert "moments have made 250 steps, but this is iteration 1 of" in message
    assert "needs observe(loss, iteration=...)" in message


def test_a_few_rewinds_are_no_mistake() -> None:
    splats, phases, optimizers = begun(1_000)

    def train() -> None:
        for i in range(300):
            for param in splats.values():
                param.grad = torch.ones_like(param)
            phases.observe(0.1, iteration=i if i < 150 else i - 100)
            step_all(optimizers)

    assert said(train) == []


def test_all_optimizers_made_anew() -> None:
    splats, phases, optimizers = begun()
    iterate(splats, phases, optimizers, 3)
    fresh = gsplat_optimizers(splats)
    (message,) = said(lambda: iterate(splats, phases, fresh, 300))
    assert "no upgraded optimizer has moved Gaussians" in message


@pytest.mark.parametrize("period", some_of([2, 5, 7, 10], lambda period: period < 7))
@pytest.mark.parametrize("how", ["requires_grad", "rate"])
def test_gaussians_that_are_frozen_now_and_then_are_no_mistake(how: str, period: int) -> None:
    """Whichever iterations are looked at: trackers and mappers take turns, for example."""
    for first in range(period):
        splats, phases, optimizers = begun()
        rates = {name: each.param_groups[0]["lr"] for name, each in optimizers.items()}

        def train(first: int = first, given: Any = (splats, phases, optimizers, rates)) -> None:
            splats, phases, optimizers, rates = given
            for iteration in range(first, 450):
                frozen = iteration % period != 0 if period < 10 else iteration % period == 0
                for name, param in splats.items():
                    param.requires_grad_(not frozen or how != "requires_grad")
                    rate = 0.0 if frozen and how == "rate" else rates[name]
                    optimizers[name].param_groups[0]["lr"] = rate
                iterate(splats, phases, optimizers, 1)

        assert said(train) == []


def test_an_optimizer_made_anew_after_a_checkpoint_was_loaded() -> None:
    """Whatever the checkpoint does to the count of losses."""
    splats, phases, optimizers = begun(10_000)
    iterate(splats, phases, optimizers, 100)
    early = copy.deepcopy({name: each.state_dict() for name, each in optimizers.items()})
    iterate(splats, phases, optimizers, 900)
    for name, each in optimizers.items():
        each.load_state_dict(early[name])
    optimizers["scales"] = gsplat_optimizers(splats)["scales"]
    gc.collect()
    assert said(lambda: iterate(splats, phases, optimizers, 190)) == []
    (message,) = said(lambda: iterate(splats, phases, optimizers, 60))
    assert "1 of 6 upgraded optimizers do not exist any more" in message


def test_an_optimizer_made_anew_soon_after_a_resume_may_be_upgraded_again() -> None:
    splats, phases, optimizers = begun(10_000)
    iterate(splats, phases, optimizers, 500)
    saved = {name: each.state_dict() for name, each in optimizers.items()}
    splats, phases, optimizers = begun(10_000)
    for name, each in optimizers.items():
        each.load_state_dict(saved[name])

    def go_on() -> None:
        optimizers["scales"] = gsplat_optimizers(splats)["scales"]
        gc.collect()
        iterate(splats, phases, optimizers, 50)
        phases.upgrade(optimizers)
        iterate(splats, phases, optimizers, 300)

    assert not any("do not exist any more" in message for message in said(go_on))


def test_a_second_run_of_the_same_objects_with_an_optimizer_that_steps_rarely() -> None:
    splats, phases, optimizers = begun(2_000)

    def run() -> None:
        for iteration in range(990):
            for param in splats.values():
                param.grad = torch.ones_like(param)
            phases.observe(0.1, iteration=iteration)
            for name, each in optimizers.items():
                if name != "shN" or iteration % 16 == 0:
                    each.step()

    run()
    assert said(run) == []


# How trainers freeze Gaussians: gsplat main's `ppisp` does the first, and goes on stepping.
FREEZING = ("requires_grad", "requires_grad, gradients kept", "no gradient", "rate", "no step")


def freeze_and_go_on(how: str, splats: Any, phases: Any, optimizers: Any, count: int) -> None:
    """Iterations in which something else is trained, so that losses are still observed."""
    for name, optimizer in optimizers.items():
        for group in optimizer.param_groups:
            group["lr"] = 0.0 if how == "rate" else group["lr"]
        splats[name].requires_grad_(not how.startswith("requires_grad"))
    for _ in range(count):
        for param in splats.values():
            kept = how in ("rate", "requires_grad, gradients kept")
            param.grad = torch.zeros_like(param) if kept else None
        phases.observe(0.1)
        if how != "no step":
            step_all(optimizers)


@pytest.mark.parametrize("how", FREEZING)
def test_gaussians_frozen_before_the_end_are_told_what_to_give(how: str) -> None:
    splats, phases, optimizers = begun()
    iterate(splats, phases, optimizers, 3)
    assert said(lambda: freeze_and_go_on(how, splats, phases, optimizers, 200)) == []
    (message,) = said(lambda: freeze_and_go_on(how, splats, phases, optimizers, 100))
    assert "no upgraded optimizer has moved Gaussians" in message
    assert "where it freezes the Gaussians before the end, give total_steps" in message


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("how", FREEZING)
def test_gaussians_frozen_where_the_schedule_ends_are_no_overrun(how: str, first: int) -> None:
    """Whoever follows that advice gets no other warning when the training goes on."""
    total = 30
    splats, phases, optimizers = begun(total)
    for iteration in range(first, total + first):
        for param in splats.values():
            param.grad = torch.ones_like(param)
        phases.observe(0.1, iteration=iteration)
        step_all(optimizers)
    assert said(lambda: freeze_and_go_on(how, splats, phases, optimizers, 300)) == []


@pytest.mark.parametrize("how", FREEZING)
def test_gaussians_thawed_after_the_end_are_an_overrun(how: str) -> None:
    splats, phases, optimizers = begun(30)
    iterate(splats, phases, optimizers, 30)
    freeze_and_go_on(how, splats, phases, optimizers, 20)
    for name, optimizer in optimizers.items():
        optimizer.param_groups[0]["lr"] = 0.1
        splats[name].requires_grad_(True)
    (message,) = said(lambda: iterate(splats, phases, optimizers, 3))
    assert "the schedule came too early for this run" in message


def test_gaussians_that_wait_at_the_beginning_are_no_mistake() -> None:
    """Poses are trained first, say: nothing has been missed yet."""
    splats, phases, optimizers = begun()
    assert said(lambda: freeze_and_go_on("no gradient", splats, phases, optimizers, 300)) == []


def test_one_frozen_parameter_is_no_mistake() -> None:
    splats, phases, optimizers = begun(400)
    splats["sh0"].requires_grad_(False)

    def go_on() -> None:
        for _ in range(300):
            for name, param in splats.items():
                param.grad = None if name == "sh0" else torch.ones_like(param)
            phases.observe(0.1)
            step_all(optimizers)

    assert said(go_on) == []


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


def test_two_models_that_are_upgraded_by_two_calls() -> None:
    """Parts would take the Gaussians of the one for those of the other."""
    one, two = make_splats(seed=0), make_splats(seed=1)
    phases = PhaseScheduler(TOTAL, parts=[Fading()])
    adams = [phases.upgrade(gsplat_optimizers(splats)) for splats in (one, two)]

    def together() -> None:
        for _ in range(5):
            iterate_once(phases, [one, two], adams)

    (message,) = said(together)
    assert "two optimizers that were upgraded by different calls hold" in message
    assert "as a dict whose keys say which set they belong to" in message


def test_an_optimizer_that_is_made_anew_while_the_old_one_lives_on() -> None:
    splats = make_splats()
    phases = PhaseScheduler(TOTAL, parts=[Fading()])
    old = phases.upgrade(gsplat_optimizers(splats))

    def anew() -> None:
        iterate_once(phases, [splats], [old])
        made = phases.upgrade(gsplat_optimizers(splats))
        for _ in range(5):
            iterate_once(phases, [splats], [made])

    assert said(anew) == []


def iterate_once(phases: Any, models: list[Any], optimizers: list[Any]) -> None:
    for splats in models:
        for param in splats.values():
            param.grad = torch.ones_like(param)
    phases.observe(0.1)
    for each in optimizers:
        step_all(each)


def test_a_closure_that_every_optimizer_is_given_is_one_iteration() -> None:
    splats, phases, optimizers = begun()

    def closure() -> torch.Tensor:
        loss = torch.stack([param.square().sum() for param in splats.values()]).sum()
        for param in splats.values():
            param.grad = None
        loss.backward()
        return loss

    for _ in range(7):
        for adam in optimizers.values():
            adam.step(closure)
    assert phases.iteration == 7
    for param in splats.values():  # and the loss that is observed by hand is not counted twice
        param.grad = torch.ones_like(param)
    phases.observe(0.1)
    for adam in list(optimizers.values())[1:]:
        adam.step(closure)
    assert phases.iteration == 8


@pytest.mark.parametrize("how", ["state_dict", "a copy", "made anew"])
def test_after_a_resume_a_closure_is_an_iteration_at_once(how: str) -> None:
    def closure() -> torch.Tensor:
        for param in splats.values():
            param.grad = torch.ones_like(param)
        return torch.tensor(0.1)

    splats, phases, optimizers = begun()
    for _ in range(5):
        for adam in optimizers.values():
            adam.step(closure)
    if how == "a copy":
        splats, phases, optimizers = copy.deepcopy((splats, phases, optimizers))
    elif how == "state_dict":
        states = {name: adam.state_dict() for name, adam in optimizers.items()}
        splats, phases, optimizers = begun()
        for name, adam in optimizers.items():
            adam.load_state_dict(states[name])
    else:
        optimizers = phases.upgrade(gsplat_optimizers(splats))
    assert phases.iteration == 5
    for _ in range(2):
        for adam in optimizers.values():
            adam.step(closure)
    assert phases.iteration == 7


@pytest.mark.parametrize(
    "loss", [torch.ones(4), None, torch.tensor(1j), "0.1", torch.ones(0)], ids=str
)
def test_a_loss_that_is_no_number_changes_nothing(loss: Any) -> None:
    _, phases, _ = begun()
    phases.observe(0.1)
    with pytest.raises(ValueError, match=r"PhaseScheduler.observe: loss=.*one real number"):
        phases.observe(loss)
    assert phases.iteration == 1


def test_a_loss_is_a_number_of_32_bits_whatever_torchs_default_is() -> None:
    def multiplier() -> float:
        histogram = EnergyHistogram(warmup=5)
        phases = PhaseScheduler(TOTAL, parts=[histogram])
        for i in range(18):  # before it is said that nothing was upgraded
            phases.observe(0.5 + 1e-3 * (i % 7))
        return float(histogram.multiplier)

    expected = multiplier()
    torch.set_default_dtype(torch.bfloat16)
    try:
        assert multiplier() == expected != 1.0
    finally:
        torch.set_default_dtype(torch.float32)


def test_parts_that_an_adaptive_run_did_not_need_are_on_in_one_that_is_not() -> None:
    _, phases, _ = begun()
    phases.switched_off = {"Fading": "no use"}
    state = phases.state_dict()
    for adaptive, off in ((True, ["Fading"]), (False, [])):
        other = PhaseScheduler(TOTAL, parts=[Fading(), Averaging()], adaptive=adaptive)
        other.load_state_dict(state)
        assert [*other.switched_off] == off


@pytest.mark.parametrize(
    "loss", [torch.ones(4), torch.tensor(1j), 1j, "0.1", torch.ones(0)], ids=str
)
def test_every_taker_of_a_loss_refuses_what_is_no_number(loss: Any) -> None:
    histogram = EnergyHistogram()
    with pytest.raises(ValueError, match=r"EnergyHistogram.observe: energy=.*one real number"):
        histogram.observe(loss)
    assert histogram.num_observed == 0
    x = Parameter(torch.ones(1, 2))
    x.grad = torch.ones(1, 2)
    optimizer = LQNAdam([x])
    with pytest.raises(ValueError, match=r"LQNAdam.step: the closure's value=.*one real number"):
        optimizer.step(lambda: loss)
    assert torch.equal(x, torch.ones(1, 2))
    assert optimizer.course.steps == 0


def test_one_optimizer_under_two_keys_is_refused() -> None:
    means = gsplat_optimizers(splats := make_splats())["means"]
    with pytest.raises(ValueError, match=r"optimizers\['scales'\] is optimizers\['means'\]"):
        PhaseScheduler(TOTAL).upgrade({"means": means, "scales": means})
    assert type(means) is torch.optim.Adam
    assert splats["means"].requires_grad
