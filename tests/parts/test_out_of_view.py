"""OutOfView: where views see little of a scene, regularisers make no full steps elsewhere."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from gaussians import adams_of, parameters, same_tensors
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import Parameter

from opt3dgs_optim import OutOfView, PhaseScheduler

TOTAL = 30_000
NAMES = ("means", "scales", "opacities")


def train(
    part: bool,
    seen_share: float,
    iterations: int,
    *,
    rows: int = 200,
    pull: float = 1e-3,
    frozen: int = 0,
    emptied_at: int = -1,
) -> tuple[dict[str, Any], PhaseScheduler]:
    """Each view sees a share of the points; regularisers pull at all scales and opacities."""
    params: dict[str, Any] = parameters(rows, *NAMES)
    phases = PhaseScheduler(TOTAL, parts=[OutOfView()] if part else [])
    optimizers = phases.upgrade(adams_of(params))
    generator = torch.Generator().manual_seed(0)
    for iteration in range(iterations):
        seen = (torch.rand(rows, generator=generator) < seen_share).float()
        for name, param in params.items():
            grad = torch.randn(param.shape, generator=generator)
            grad = grad * seen.reshape(-1, *[1] * (grad.dim() - 1))
            param.grad = grad + (0.0 if name == "means" else pull)
        params["means"].grad[:frozen] = 0.0
        if iteration == emptied_at:  # as relocation and fading do it
            for name in ("scales", "opacities"):
                optimizers[name].state[params[name]]["exp_avg_sq"].zero_()
        for optimizer in optimizers.values():
            optimizer.step()
    return params, phases


@settings(max_examples=4)
@given(share=st.floats(0.45, 1.0))
def test_where_views_see_more_than_a_third_nothing_is_changed(share: float) -> None:
    ours, phases = train(True, share, 200)
    theirs, _ = train(False, share, 200)
    assert same_tensors(ours, theirs)
    assert phases.numbers()["visible_share"] > 1 / 3


@settings(max_examples=5)
@given(share=st.floats(0.03, 0.25))
def test_the_mean_share_is_that_of_the_views(share: float) -> None:
    _, phases = train(True, share, 600)
    assert phases.numbers()["visible_share"] == pytest.approx(share, abs=0.06)


@pytest.mark.parametrize("name", ["scales", "opacities"])
def test_steps_of_a_point_out_of_view_are_about_three_shares_of_a_full_one(name: str) -> None:
    """After relocation has emptied its second moment; plain Adam makes full steps."""
    ends = [train(on, 0.05, 401, emptied_at=399)[0] for on in (True, False)]
    before = [train(on, 0.05, 400)[0] for on in (True, False)]
    moved = [(b[name] - a[name]).detach().abs().median() for a, b in zip(before, ends, strict=True)]
    assert moved[0] < 0.5 * moved[1]


def test_frozen_positions_are_not_out_of_view() -> None:
    """A mask on the positions' gradient; every view sees all points."""
    ours, phases = train(True, 1.0, 300, frozen=180)
    theirs, _ = train(False, 1.0, 300, frozen=180)
    assert phases.numbers()["visible_share"] == 1.0
    assert same_tensors(ours, theirs)


def test_a_view_of_nothing_does_not_count() -> None:
    _, phases = train(True, 0.0, 100)
    assert phases.numbers()["visible_share"] == 1.0


@pytest.mark.parametrize("frozen", ["no gradient", "no means"])
def test_without_a_gradient_of_the_positions_it_does_nothing(frozen: str) -> None:
    params: dict[str, Any] = parameters(5, *(NAMES if frozen == "no gradient" else NAMES[1:]))
    optimizers = PhaseScheduler(TOTAL, parts=[OutOfView()]).upgrade(adams_of(params))
    plain: dict[str, Any] = {n: Parameter(p.detach().clone()) for n, p in params.items()}
    stock = adams_of(plain)
    for iteration in range(30):
        for tensors, made in ((params, optimizers), (plain, stock)):
            for name, param in tensors.items():
                if name != "means":
                    param.grad = torch.full_like(param, 0.1 * iteration)
            for optimizer in made.values():
                optimizer.step()
    assert same_tensors(params, plain)


def test_a_save_and_a_copy_lose_no_look() -> None:
    """A look is on its way for an iteration; what is saved and copied has it already."""
    _, phases = train(True, 0.05, 151)
    for part in phases.parts:
        part.settle(phases)
    settled = phases.numbers()["visible_share"]
    _, phases = train(True, 0.05, 151)
    copied = copy.deepcopy(phases)
    assert copied.numbers()["visible_share"] == settled


def test_each_set_of_gaussians_has_a_share_of_its_own() -> None:
    """Vehicles that are always in view do not hide that a view sees little of the background."""
    rows = {"Background#xyz": 200, "RigidNodes#xyz": 20}
    params = {name: Parameter(torch.zeros(count, 3)) for name, count in rows.items()}
    optimizer = torch.optim.Adam([{"params": [p], "name": name} for name, p in params.items()])
    phases = PhaseScheduler(3000, parts=[OutOfView()])
    phases.upgrade(optimizer)
    draw = torch.Generator().manual_seed(0)
    for _ in range(600):
        seen = torch.rand(200, 1, generator=draw) < 0.05
        params["Background#xyz"].grad = seen * torch.ones(200, 3)
        params["RigidNodes#xyz"].grad = torch.ones(20, 3)
        optimizer.step()
    assert 0.03 < float(phases.numbers()["visible_share"]) < 0.15
