"""The clock: optimizers count their own steps, whatever the trainer does between them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from gaussians import adam_of, adams_of, parameters, same_tensors, steps
from torch.nn import Parameter

from opt3dgs_optim import DEFAULTS, Averaging, Part, Phase, PhaseScheduler
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training

TOTAL = 120


class Clocked(Part):
    """Notes the iterations of the steps of each parameter."""

    names = None

    def __init__(self) -> None:
        self.seen: dict[Any, list[int]] = {}

    def plan(self, step: Step, training: Training) -> None:
        self.seen.setdefault(step.name, []).append(step.iteration)


def clocked(total: int = TOTAL) -> tuple[PhaseScheduler, Clocked]:
    part = Clocked()
    return PhaseScheduler(total, parts=[part]), part


def test_an_optimizer_that_steps_now_and_then() -> None:
    """taming-3dgs has f_rest in an optimizer of its own, which steps in every sixteenth."""
    phases, part = clocked()
    params = parameters(5, "means", "shN")
    main, other = phases.upgrade(
        [adam_of({"means": params["means"]}), adam_of({"shN": params["shN"]})]
    )
    for iteration in range(50):
        steps({"means": main}, params, 1)
        if iteration % 16 == 15:
            steps({"shN": other}, params, 1)
    assert part.seen == {"means": list(range(50)), "shN": [15, 31, 47]}
    again, part = clocked()
    resumed = again.upgrade([adam_of({"means": params["means"]}), adam_of({"shN": params["shN"]})])
    for optimizer, saved in zip(resumed, (main, other), strict=True):
        optimizer.load_state_dict(saved.state_dict())
    assert again.iteration == 49
    steps({"shN": resumed[1]}, params, 1)
    steps({"means": resumed[0]}, params, 1)
    assert part.seen == {"shN": [50], "means": [50]}


def test_a_second_upgrade_changes_nothing() -> None:
    """A notebook's cell that is run twice."""
    ends = []
    for again in (False, True):
        params = parameters(8)
        phases = PhaseScheduler(TOTAL)
        optimizers = phases.upgrade(adams_of(params))
        steps(optimizers, params, 60)
        optimizers["means"].state_dict()
        if again:
            phases.upgrade(optimizers)
        steps(optimizers, params, 60, seed=1)
        assert phases.iteration == TOTAL - 1
        ends.append({name: param.detach() for name, param in params.items()})
    assert same_tensors(*ends)


def test_another_scheduler_goes_on_where_the_first_was() -> None:
    params = parameters(8)
    optimizers = PhaseScheduler(TOTAL).upgrade(adams_of(params))
    steps(optimizers, params, 60)
    moments = optimizers["means"].state[params["means"]]["exp_avg"].clone()
    later = PhaseScheduler(2 * TOTAL)
    later.upgrade(optimizers)
    assert later.iteration == 59
    for param in params.values():
        param.grad = torch.full_like(param, 1e-20)  # in view
    optimizers["means"].step()  # they are the own frame's still, and not begun anew
    assert torch.allclose(optimizers["means"].state[params["means"]]["exp_avg"], 0.9 * moments)


def test_phase_progress_and_what_is_shown() -> None:
    phases = PhaseScheduler(100, switch=0.9)
    phases.upgrade(adam_of(parameters(5, "means")))
    shown = [(phases.iteration, phases.phase, phases.progress)]
    for iteration in (0, 89, 90, 99):
        phases.observe(iteration=iteration)
        shown.append((phases.iteration, phases.phase, phases.progress))
    explore, exploit = Phase.EXPLORATION, Phase.EXPLOITATION
    first = [(-1, explore, 0.0), (0, explore, 0.0), (89, explore, 0.89)]
    assert shown == [*first, (90, exploit, 0.9), (99, exploit, 0.99)]
    assert "iteration 99 of 100\n" in repr(phases)  # no part acts in one phase alone
    assert "iteration -1 of 100, exploration\n" in repr(PhaseScheduler.paper(100))
    assert phases.part(Averaging) is DEFAULTS[3]
    assert phases.numbers()["own_frame_rate"] == pytest.approx(0.1 * 0.03**0.99)


def test_nan_is_told_whatever_iterations_the_clock_is_put_to() -> None:
    """Gradients are accumulated over four iterations, and no step falls on a round number."""
    params = parameters(5, "means")
    phases = PhaseScheduler(3000, parts=[Averaging()])
    optimizer = phases.upgrade(adam_of(params))

    def train() -> None:
        for iteration in range(3, 208, 4):
            params["means"].grad = torch.full_like(params["means"], float("nan"))
            phases.observe(iteration=iteration)
            optimizer.step()

    with pytest.warns(UserWarning, match="have not been finite"):
        train()


ORDERS = ("m", "mo", "om", "moo", "oom", "omo", "mabab", "abmab")


@pytest.mark.parametrize("observed", [False, True])
@pytest.mark.parametrize("order", ORDERS)
def test_the_clock_is_that_of_the_positions(order: str, observed: bool) -> None:
    """Whatever other optimizers step before and after them, once or several times."""
    phases, part = clocked()
    params = parameters(5, *(("means", "sh0", "shN") if "a" in order else ("means", "sh0")))
    named = dict(zip("mab" if "a" in order else "mo", params, strict=True))
    adams = phases.upgrade(adams_of(params))
    for iteration in range(20):
        if observed:
            phases.observe(iteration=iteration)
        for letter in order:
            steps({"": adams[named[letter]]}, params, 1)
    assert part.seen["means"] == list(range(20))
    if order == "m":
        return
    others = part.seen["sh0"]
    times = order.count("o") or order.count("a")
    assert len(others) == 20 * times
    # One that steps on both sides of the positions may be an iteration ahead in its second step.
    ahead = 1 if order in ("omo", "abmab") else 0
    for at, found in enumerate(others):
        assert found - at // times in (0, ahead)


@pytest.mark.parametrize("means_first", [True, False])
def test_a_stock_checkpoint_of_an_optimizer_that_steps_twice(means_first: bool) -> None:
    params = parameters(5, "means", "sh0")
    stock = adams_of(params)
    steps(stock, params, 10)
    steps({"sh0": stock["sh0"]}, params, 10)
    names = ["means", "sh0"] if means_first else ["sh0", "means"]
    phases, part = clocked()
    phases.upgrade({name: stock[name] for name in names})
    assert phases.iteration == 9
    steps({name: stock[name] for name in names}, params, 1)
    assert part.seen == {"means": [10], "sh0": [10]}


def test_two_sets_of_gaussians_count_once() -> None:
    phases, part = clocked()
    params = {f"{which}#{name}": Parameter(torch.ones(4, 3)) for which in "ab" for name in
              ("means", "scales")}  # fmt: skip
    adams = phases.upgrade(adams_of(params))
    for _ in range(10):
        steps({n: adams[n] for n in ("a#means", "b#means", "a#scales")}, params, 1)
        adams["a#scales"].step()
    assert part.seen["means"] == [i for i in range(10) for _ in "ab"]
    assert part.seen["scales"] == [i for i in range(10) for _ in "ab"]
    assert phases.iteration == 9
