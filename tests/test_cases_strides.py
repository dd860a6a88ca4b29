"""Averaging where the trainer's count goes on by more than 1 from step to step, or stands out.

Grendel-GS counts images, a batch of them per step; taming-3dgs steps one tensor in every 16th
iteration only.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import Averaging, PhaseScheduler
from opt3dgs_optim.parts.averaging import _stride

SHARE = Averaging.share


class Run:
    """One parameter, or two of which each has iterations of its own; `seen` after each step."""

    def __init__(self, total: int, *names: str, parts: bool = True, layout: str = "dict") -> None:
        self.total, self.names = total, names or ("means",)
        self.params = {name: Parameter(torch.zeros(4, 3)) for name in self.names}
        groups = {n: {"params": [p], "lr": 0.01, "name": n} for n, p in self.params.items()}
        made: Any = Adam(groups.values())
        if layout == "dict":
            made = {name: Adam([group]) for name, group in groups.items()}
        self.phases = PhaseScheduler(total, parts=[Averaging()] if parts else [])
        self.optimizers: Any = self.phases.upgrade(made)
        self.seen: dict[str, dict[int, Tensor]] = {name: {} for name in self.names}

    def state(self, name: str) -> dict[str, Any]:
        every = self.optimizers
        optimizer = every[name] if isinstance(every, dict) else every
        return optimizer.state[self.params[name]]

    def step(self, iteration: int, *names: str) -> None:
        """A step of some of the parameters, all unless said; the others have no gradient."""
        names = names or self.names
        generator = torch.Generator().manual_seed(iteration)
        for name, param in self.params.items():
            grad = torch.randn(4, 3, generator=generator)
            param.grad = grad if name in names else None
        self.phases.observe(0.1, iteration=iteration)
        every = self.optimizers
        for optimizer in every.values() if isinstance(every, dict) else [every]:
            optimizer.step()
        for name in names:
            self.seen[name][iteration] = self.params[name].detach().clone()

    def run(self, iterations: Iterable[int]) -> Run:
        for iteration in iterations:
            self.step(iteration)
        return self

    def is_at_mean(self, name: str = "means") -> bool:
        return torch.equal(self.params[name], self.state(name)["Averaging.mean"])


# Totals, and the trainer's last count, which is that of Grendel's `range(1, iterations + 1, ..)`.
TOTALS = (601, 1001, 3001, 7001)
BATCHES = (1, 2, 4, 8, 16, 32, 64)


@pytest.mark.parametrize("offset", [0, 1, 3])
@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("total", TOTALS)
def test_it_ends_at_the_mean(total: int, batch: int, offset: int) -> None:
    """Trainers save after their last step, or before it."""
    window = math.floor(SHARE * total)
    first = total - 3 * window - 4 * batch + offset
    first += (1 - first + offset) % batch  # counts as from `1 + offset` on
    iterations = range(first, total, batch)
    run, plain = Run(total), Run(total, parts=False).run(iterations)
    must_begin, stayed = max(2 * batch, window / 10), 0
    for iteration in iterations:
        run.step(iteration)
        if iteration in iterations[-2:] and iteration >= total - window:
            assert run.is_at_mean(), iteration
        if total - iteration > must_begin:
            assert torch.equal(run.params["means"], plain.seen["means"][iteration]), iteration
            stayed += 1
    assert stayed > 0
    averaged = sum(iteration >= total - window for iteration in iterations)
    if averaged:
        assert int(run.state("means")["Averaging.count"][0]) == averaged
    assert (averaged > 1) != torch.equal(run.params["means"], plain.params["means"])


@pytest.mark.parametrize("layout", ["dict", "single"])
@pytest.mark.parametrize("every", [2, 5, 16, 40])
@pytest.mark.parametrize("total", [1000, 3000])
def test_a_parameter_that_is_stepped_rarely(total: int, every: int, layout: str) -> None:
    """Both end at their means, and the one that is stepped always begins as late as ever."""
    run = Run(total, "means", "shN", layout=layout)
    window = math.floor(SHARE * total)
    alone = Run(total, "means")
    for iteration in range(total - 2 * window - every, total):
        rarely = (iteration + 1) % every == 0
        run.step(iteration, *(("means", "shN") if rarely else ("means",)))
        alone.step(iteration)
        assert torch.equal(run.params["means"], alone.params["means"])
        if rarely and iteration + 2 * every >= total and iteration >= total - window:
            assert run.is_at_mean("shN"), iteration
    assert run.is_at_mean("means")


def expected_last(total: int, iterations: list[int]) -> dict[int, Tensor]:
    """What plain Adam has after each step."""
    return Run(total, parts=False).run(iterations).seen["means"]


def first_at_mean(run: Run, total: int, iterations: list[int]) -> int:
    """How many iterations before the end it first differs from plain Adam's run."""
    plain = expected_last(total, iterations)
    return next(total - i for i in iterations if not torch.equal(run.seen["means"][i], plain[i]))


TOTAL = 3000  # of which 100 are averaged, and the last 10 are at the mean
GAPS = {
    "none": [],
    "half of the window": range(2920, 2970),
    "in its begin": range(2901, 2940),
    "in its second step": range(2902, 2940),
    "up to the last tenth": range(2950, 2989),
    "now and then": range(2890, 3000, 7),
    "two by two": [i for i in range(2880, 2990) if i % 10 in (3, 4)],
    "two long ones": [*range(2910, 2930), *range(2931, 2960)],
}


@pytest.mark.parametrize("gap", [name for name in GAPS if name != "in its begin"])
def test_a_gap_is_no_stride(gap: str) -> None:
    """Iterations without a gradient, which a trainer may leave out."""
    left_out = set(GAPS[gap])
    iterations = [i for i in range(2850, TOTAL) if i not in left_out]
    run = Run(TOTAL).run(iterations)
    if gap == "two long ones":  # with a step between them: for that one it looks like a stride
        assert first_at_mean(run, TOTAL, iterations) <= 70
    else:
        assert first_at_mean(run, TOTAL, iterations) <= 10
    assert run.is_at_mean()


def test_of_one_gap_alone_it_is_taken_for_a_stride() -> None:
    """Nothing else is known after one step in the window; the next step knows better."""
    iterations = [i for i in range(2850, TOTAL) if i not in GAPS["in its begin"]]
    run = Run(TOTAL).run(iterations)
    plain = expected_last(TOTAL, iterations)
    assert torch.allclose(run.seen["means"][2940], plain[2940], atol=0.2)
    assert run.is_at_mean()


@pytest.mark.parametrize("back", [2, 5, 30, 90, 400])
@pytest.mark.parametrize("at", [2910, 2950, 2985])
def test_a_clock_that_is_set_back(at: int, back: int) -> None:
    """The mean begins anew with the iterates of the second pass, and nothing happens too early."""
    run = Run(TOTAL).run(range(2850, at))
    for iteration in range(at - back, TOTAL):
        run.step(iteration)
        count = int(run.state("means").get("Averaging.count", torch.zeros(1))[0])
        # Of one iterate the mean is that itself.
        assert count <= 1 or run.is_at_mean() == (TOTAL - iteration <= 10), iteration
    count = int(run.state("means")["Averaging.count"][0])
    assert count == TOTAL - max(2900, at - back)


@pytest.mark.parametrize("batch", [1, 16, 32])
@pytest.mark.parametrize("stop", [2880, 2940, 2975])
def test_a_training_is_resumed(stop: int, batch: int) -> None:
    """In a process of its own; what the stride was is learnt anew."""
    iterations = list(range(2800, TOTAL, batch))
    whole = Run(TOTAL).run(iterations)
    first = Run(TOTAL).run(i for i in iterations if i < stop)
    second = Run(TOTAL)
    second.params["means"].data.copy_(first.params["means"])
    saved = copy.deepcopy(first.optimizers["means"].state_dict())
    second.optimizers["means"].load_state_dict(saved)
    rest = [i for i in iterations if i >= stop]
    second.run(rest)
    if len(rest) > 1:
        assert second.is_at_mean()
    if batch == 1:
        assert torch.equal(second.params["means"], whole.params["means"])


def test_two_parts_and_several_steps_of_one_iteration_make_no_stride() -> None:
    run = Run(TOTAL)
    run.phases = PhaseScheduler(TOTAL, parts=[Averaging(), Averaging()])
    param = run.params["means"]
    adam = run.phases.upgrade({"means": Adam([param], lr=0.01)})["means"]
    for iteration, _ in itertools.product(range(2890, TOTAL), range(2)):
        before = param.detach().clone()
        param.grad = torch.ones(4, 3)
        run.phases.observe(0.1, iteration=iteration)
        adam.step()
        if iteration < TOTAL - 10:
            assert bool((param < before).all()), "at no mean yet"
    assert torch.equal(param, adam.state[param]["Averaging#2.mean"])


@pytest.mark.parametrize(
    ("stepped", "stride"),
    [
        ((5,), 1),
        ((0, 1, 17), 1),
        ((0, 1, 17, 33), 16),  # of the last two times alone
        ((0, 16, 32, 32), 16),  # two steps in one iteration
        ((0, 16, 500), 16),
        ((0, 16, 32, 8), 8),  # the clock was set back
    ],
)
def test_the_stride_is_the_shorter_of_the_last_two(stepped: tuple[int, ...], stride: int) -> None:
    run = Run(1000)
    (group,) = run.optimizers["means"].param_groups
    found = 0
    for now in stepped:
        run.phases.current = now
        found = _stride(group, run.params["means"], run.phases)
    assert found == stride
