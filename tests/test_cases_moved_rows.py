"""Rows that a trainer moves in place: one public call begins them anew.

ubc-vision/3dgs-mcmc #21 and forks write `_xyz.data[dead] = new` and zero the moments, in the last
iterations, too. `StepAdam.reset_rows(param, rows)` zeroes moments and all that parts keep of rows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from placed_training import ADAMS
from torch import Tensor
from torch.nn import Parameter
from trainers import AveragedThroughout

from opt3dgs_optim import Averaging, Curvature, Fading, OutOfView, PhaseScheduler

PARTS: dict[str, Any] = {
    "Averaging": lambda: [Averaging()],
    "averaging throughout": lambda: [AveragedThroughout()],
    "Curvature": lambda: [Curvature()],
    "all": lambda: [Fading(start=0.0), OutOfView(), Curvature(), AveragedThroughout()],
}
ROWS: dict[str, Any] = {
    "indices": torch.tensor([0, 3]),
    "a mask": torch.tensor([True, False, False, True, False, False]),
    "one": torch.tensor([3]),
    "none": torch.tensor([], dtype=torch.long),
    "a list": [0, 3],
    "an empty list": [],
    "an empty tuple": (),
    "an empty range": range(0),
    "a range": range(2),
    "a list of bools": [True, False, False, True, False, False],
    "numpy's indices": np.array([0, 3]),
    "numpy's indices of 32 bits": np.array([0, 3], dtype=np.int32),
    "numpy's unsigned indices": np.array([0, 3], dtype=np.uint16),
    "numpy's mask": np.array([True, False, False, True, False, False]),
    "numpy's mask from behind": np.array([True, False, False, True, False, False])[::-1],
    "none of numpy's": np.array([]),
    "where numpy finds some": np.nonzero(np.array([1, 0, 1, 0, 0, 0]))[0],
    "from behind": [-1],
}


def trained(parts: str, until: int) -> tuple[Parameter, Any, PhaseScheduler]:
    p = Parameter(torch.arange(18.0).reshape(6, 3) / 18)
    phases = PhaseScheduler(300, 200, PARTS[parts]())
    adam: Any = phases.upgrade(torch.optim.Adam([{"params": [p], "name": "means"}], lr=0.01))
    run(p, adam, phases, until, torch.zeros(6, 3))
    return p, adam, phases


def run(p: Parameter, adam: Any, phases: PhaseScheduler, until: int, goal: Tensor) -> None:
    scale = torch.tensor([1.0, 3.0, 9.0])
    while phases.iteration < until:
        p.grad = (p.detach() - goal) * scale
        phases.observe(0.1)
        adam.step()


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("rows", ROWS)
def test_the_rows_begin_anew_and_the_others_do_not(parts: str, rows: str) -> None:
    p, adam, _ = trained(parts, 296)
    before = {key: each.clone() for key, each in adam.state[p].items()}
    adam.reset_rows(p, ROWS[rows])
    chosen = torch.zeros(6, dtype=torch.bool)
    given = ROWS[rows] if isinstance(ROWS[rows], Tensor) else np.array(ROWS[rows])
    if len(given):
        chosen[torch.as_tensor(given if isinstance(given, Tensor) else given.tolist())] = True
    for key, each in adam.state[p].items():
        if key == "step":
            assert torch.equal(each, before[key])
        elif each.dim() and len(each) == 6:
            assert not each[chosen].any(), key
            assert torch.equal(each[~chosen], before[key][~chosen]), key


@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("at", [100, 250, 295])
def test_a_point_that_was_moved_ends_where_it_was_put(parts: str, at: int) -> None:
    p, adam, phases = trained(parts, at)
    goal = torch.zeros(6, 3)
    with torch.no_grad():
        p[0] = goal[0] = 10.0
    adam.reset_rows(p, torch.tensor([0]))
    run(p, adam, phases, 300, goal)
    assert bool((p[0] - 10.0).abs().max() < 0.1)


@pytest.mark.parametrize(
    "rows",
    [
        torch.tensor([6]),
        torch.tensor([-7]),
        torch.ones(5, dtype=torch.bool),
        torch.ones(1),
        torch.ones(6, dtype=torch.uint8),  # a mask for torch, indices for numpy
        np.ones(6, dtype=np.uint8),
        np.ones(5, dtype=bool),
        np.array([0.5]),
        np.array(["0"]),
        np.array([None]),
        [0.0],
        ["0"],
        [None],
        [[0], [1, 2]],
        [6],
        {0},
        "0",
        3,
        None,
    ],
)
def test_rows_that_are_not_there_are_refused_and_nothing_is_changed(rows: Any) -> None:
    p, adam, _ = trained("all", 250)
    before = {key: each.clone() for key, each in adam.state[p].items()}
    assert hasattr(adam, "reset_rows")
    with pytest.raises((ValueError, TypeError), match="reset_rows"):
        adam.reset_rows(p, rows)
    assert all(torch.equal(each, before[key]) for key, each in adam.state[p].items())


def test_a_parameter_that_is_not_its_own_is_refused() -> None:
    _, adam, _ = trained("Averaging", 250)
    assert hasattr(adam, "reset_rows")
    with pytest.raises(ValueError, match="reset_rows"):
        adam.reset_rows(Parameter(torch.ones(6, 3)), torch.tensor([0]))


def test_before_the_first_step_there_is_nothing_to_reset() -> None:
    p, adam, _ = trained("Averaging", 0)
    adam.reset_rows(p, torch.tensor([0]))
    assert not {key for key in adam.state[p] if key not in ADAMS}


@pytest.mark.parametrize("rows", [[1, 7], [True] * 8], ids=["indices", "a mask"])
def test_after_an_edit_of_rows_that_left_what_parts_keep_behind(rows: Any) -> None:
    """INRIA's edits know the two moments only; what is of the old rows is dropped, not written."""
    p, adam, _ = trained("averaging throughout", 8)
    state = adam.state.pop(p)
    grown = Parameter(torch.cat([p.detach(), torch.ones(2, 3)]))
    for key in ("exp_avg", "exp_avg_sq"):
        state[key] = torch.cat([state[key], torch.ones(2, 3)])
    adam.param_groups[0]["params"][0] = grown
    adam.state[grown] = state
    adam.reset_rows(grown, rows)
    assert not state["exp_avg"][rows].any()
    assert [key for key in state if "." in key] == []
