"""Curvature in a training: which parameters, from when on, and what it says of itself."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import Curvature, LQNAdam, PhaseScheduler, Training
from opt3dgs_optim.parts.curvature import HISTORY

SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": ()}
STIFF = torch.tensor([1.0, 5.0, 25.0])


def positions(optimizer: Any = LQNAdam, n: int = 6, **options: Any) -> tuple[Parameter, Any]:
    x = Parameter(torch.randn(n, 3, generator=torch.Generator().manual_seed(0)))
    return x, optimizer([x], lr=0.01, **options)


def quadratic_step(x: Parameter, optimizer: Any, stiff: Tensor = STIFF) -> None:
    x.grad = x.detach() * stiff
    optimizer.step()


@pytest.mark.parametrize("names", [("means",), ("means", "scales"), ("opacities", "quats"), None])
def test_it_acts_on_its_parameters_from_the_switch_on(names: Any) -> None:
    splats = {name: Parameter(torch.ones(5, *shape)) for name, shape in SHAPES.items()}
    adams = {name: torch.optim.Adam([param], lr=0.1) for name, param in splats.items()}
    phases = PhaseScheduler(8, parts=[Curvature(3, names=names)], switch=0.5)
    phases.upgrade(adams)
    for i in range(8):
        for name, param in splats.items():
            param.grad = param.detach() + 0.1
            adams[name].step()
        holders = {name for name, p in splats.items() if HISTORY in adams[name].state[p]}
        acts = set(splats) if names is None else set(names)
        assert holders == (acts if i >= 4 else set())


def test_the_share_is_over_all_parameters_of_a_step() -> None:
    """One whose pairs are refused, one whose are taken."""
    curvature = Curvature(names=("means", "scales"))
    assert curvature.accepted_share is None
    assert curvature.numbers(Training([])) == {}
    x, y = Parameter(torch.zeros(3, 3)), Parameter(torch.zeros(5, 3))
    groups = [{"params": [x], "name": "xyz"}, {"params": [y], "name": "scaling"}]
    phases = PhaseScheduler(10, parts=[curvature], switch=0)
    optimizer = phases.upgrade(torch.optim.Adam(groups, lr=0.1))
    for slope, expected in ((-1.0, 0.0), (-1.0, 3 / 8), (1.0, 1.0), (-9.0, 3 / 8)):
        x.grad = torch.ones(3, 3) + x.detach()  # convex: accepted
        y.grad = torch.ones(5, 3) + slope * y.detach()  # refused where it is concave
        optimizer.step()
        assert float(phases.numbers()["accepted"]) == pytest.approx(expected)


@pytest.mark.parametrize(("shape", "accepted"), [((0, 3), None), ((1, 3), 1.0), ((), 1.0)])
def test_no_row_one_row_and_a_number(shape: tuple[int, ...], accepted: float | None) -> None:
    x = Parameter(torch.ones(shape))
    optimizer = LQNAdam([x], lr=0.1, history_size=1)
    for _ in range(4):
        quadratic_step(x, optimizer, torch.tensor(5.0))
    assert x.shape == shape
    assert bool((x < 1.0).all())
    assert optimizer.accepted_share == accepted


@pytest.mark.parametrize(("saved", "ours"), [(3, 4), (4, 3), (3, 5), (5, 3)])
def test_pairs_of_another_history_are_refused(saved: int, ours: int) -> None:
    """Of three coordinates, three pairs take as much room as four: the shape does not tell."""
    (x, first), (y, second) = positions(history_size=saved), positions(history_size=ours)
    for _ in range(6):
        quadratic_step(x, first)
    for _ in range(2):
        quadratic_step(y, second)
    before = copy.deepcopy(second.state_dict())
    with pytest.raises(ValueError, match=f"history_size={saved}, but pairs of history_size={ours}"):
        second.load_state_dict(first.state_dict())
    assert second.state_dict()["param_groups"] == before["param_groups"]
    for key, value in before["state"][0].items():
        assert torch.equal(second.state[y][key], value), key


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"history_size": 0}, "history_size=0"),
        ({"history_size": 17}, "history_size=17"),
        ({"min_cosine": -0.1}, "min_cosine"),
        ({"min_cosine": 1.0}, "min_cosine"),
        ({"graft": 1}, "graft=1"),
        ({"backend": "opencl"}, "backend='opencl'"),
    ],
)
def test_options(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=f"Curvature: .*{message}"):
        Curvature(**options)
    assert repr(Curvature()) == "Curvature(5 pairs per point of means)"
    assert "of all" in repr(Curvature(names=None))
