"""Integers of numpy are integers, wherever one is asked for; what is none is refused as before."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn import Parameter
from torch.utils._pytree import tree_leaves

from opt3dgs_optim import (
    ConstantMultiplier,
    Curvature,
    EnergyHistogram,
    Fading,
    FreshMoments,
    LQNAdam,
    PhaseScheduler,
    paper_parts,
)
from opt3dgs_optim.lbfgs import two_loop


def points() -> Parameter:
    return Parameter(torch.ones(4, 3))


OPTIONS: dict[str, tuple[Callable[[Any], Any], int]] = {
    "total_steps": (lambda n: PhaseScheduler(n).total_steps, 60),
    "switch": (lambda n: PhaseScheduler(60, n).switch_step, 40),
    "total_steps of paper": (lambda n: PhaseScheduler.paper(n).total_steps, 60),
    "switch of paper": (lambda n: PhaseScheduler.paper(60, n).switch_step, 40),
    "paper_parts": (lambda n: len(paper_parts(n)) and n, 60),
    "warmup": (lambda n: EnergyHistogram(warmup=n).warmup, 10),
    "warmup of paper": (lambda n: EnergyHistogram.paper(warmup=n).warmup, 10),
    "num_partitions": (lambda n: EnergyHistogram(n).num_partitions, 48),
    "warmup of a constant": (lambda n: ConstantMultiplier(1.0, n).warmup, 10),
    "history_size": (lambda n: Curvature(n).history_size, 3),
    "history_size of LQNAdam": (
        lambda n: LQNAdam([points()], history_size=n) and n,
        3,
    ),
    "events": (lambda n: Fading(events=n).events, 100),
    "seed": (lambda n: Fading(seed=n).seed, 3),
    "settling": (lambda n: FreshMoments(n).settling, 10),
}
KINDS = (np.int64, np.int32, np.int16, np.uint8, np.uint64)


@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_an_integer_of_numpy_is_one(option: str, kind: Any) -> None:
    make, number = OPTIONS[option]
    found = make(kind(number))
    assert found == number
    assert isinstance(found, (int, np.integer))


@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("value", [True, np.True_, "3", None, [3], np.array([3]), np.nan, 2.5])
def test_what_is_no_integer_is_refused(option: str, value: Any) -> None:
    if value == 2.5 and "switch" in option:
        value = -0.5  # a share of the run
    if value is None and option == "num_partitions":
        return  # as many as usual
    with pytest.raises(ValueError, match="needed"):
        OPTIONS[option][0](value)


@pytest.mark.parametrize("kind", KINDS)
def test_a_trainers_own_iteration_may_be_numpys(kind: Any) -> None:
    ends = []
    for count in (int, kind):
        p = points()
        phases = PhaseScheduler(count(60), count(40), parts=[Fading(start=0.0), Curvature()])
        adam = phases.upgrade(torch.optim.Adam([{"params": [p], "name": "means"}], lr=0.01))
        for i in range(60):
            p.grad = p.detach() * torch.tensor([1.0, 2.0, 3.0])
            phases.observe(0.1, iteration=count(i))
            adam.step()
        ends.append(p.detach().clone())
        # What is saved is plain, so that torch.load(weights_only=True) takes it.
        plain = tree_leaves(adam.state_dict())
        assert not any(isinstance(each, np.generic) for each in plain)
    assert torch.equal(ends[0], ends[1])


@pytest.mark.parametrize("kind", KINDS)
def test_the_recursions_history_size(kind: Any) -> None:
    grad, history = torch.ones(4, 3), torch.zeros(4, 5, 8)
    assert torch.equal(two_loop(grad, history, kind(5)), two_loop(grad, history, 5))


@pytest.mark.parametrize("kind", [np.float32, np.int64])
def test_a_number_of_numpy_is_one(kind: Any) -> None:
    assert PhaseScheduler(60, np.float64(0.5)).switch_step == 30
    assert float(Fading(exp_avg=kind(1)).exp_avg) == 1.0
    assert float(ConstantMultiplier(kind(2)).value) == 2.0
