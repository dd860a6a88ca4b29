"""OutOfView: where views see little of a scene, regularisers make no full steps elsewhere."""

from __future__ import annotations

import copy
import itertools
import json
from typing import Any

import pytest
import torch
from gaussians import adams_of, parameters, same_tensors
from torch.nn import Parameter

from opt3dgs_optim import OutOfView, PhaseScheduler

TOTAL = 30_000
NAMES = ("means", "scales", "opacities")


def scene(rows: int) -> tuple[dict[str, Parameter], dict[str, Any], PhaseScheduler]:
    """Positions and scales at zero, and Adams that forget fast."""
    params = {name: Parameter(torch.zeros(rows, 3).double()) for name in NAMES[:2]}
    phases = PhaseScheduler(TOTAL, parts=[OutOfView()])
    return params, phases.upgrade(adams_of(params, betas=(0.0, 0.5))), phases


def step(params: dict[str, Parameter], optimizers: dict[str, Any], in_view: slice) -> None:
    """One iteration that sees these points; all scales are pulled at."""
    params["means"].grad = torch.zeros_like(params["means"])
    params["means"].grad[in_view] = 1.0
    params["scales"].grad = torch.full_like(params["scales"], 0.1)
    for optimizer in optimizers.values():
        optimizer.step()


@pytest.mark.parametrize(("in_view", "points"), [(3, 5), (1, 400), (1, 1)])
@pytest.mark.parametrize("counted", [0, 2**63 - 1])
def test_the_share_is_the_mean_of_about_a_hundred_views(
    in_view: int, points: int, counted: int
) -> None:
    """A look counts as a 25th, one view in four is looked at; the device's count may overflow."""
    params, optimizers, phases = scene(points)
    assert phases.numbers() == {"visible_share": 1.0}
    step(params, optimizers, slice(None))
    found = []
    for iteration in range(1, 400):
        step(params, optimizers, slice(in_view))
        found.append(float(phases.numbers()["visible_share"]))
        if (
            counted and iteration == 4
        ):  # nothing is on its way; as after some 10,000 looks at 300,000 points
            seen = phases.unsaved[OutOfView, ""]
            seen.counter.fill_(counted)
            seen.counted = counted
    share = max(in_view / points, 0.01)
    means = list(dict.fromkeys(found))
    assert means == pytest.approx([share + (1 - share) * 0.96**k for k in range(len(means))])
    assert len(means) == pytest.approx(100, abs=2) or share == 1.0


def test_looks_keep_step_with_no_order_of_views() -> None:
    """Whether the cameras of a rig are two or nineteen, no one is left out or looked at alone."""
    params, optimizers, phases = scene(2)
    shares, looks = [1.0], []
    for iteration in range(1_000):
        step(params, optimizers, slice(iteration % 2, iteration % 2 + 1))
        shares.append(float(phases.numbers()["visible_share"]))
        if shares[-1] != shares[-2]:  # it comes an iteration later
            looks.append(iteration - 1)
    assert max(b - a for a, b in itertools.pairwise(looks)) <= 5
    for cameras in range(2, 20):
        for camera in range(cameras):
            views = len(range(camera, 1_000, cameras))
            assert 0.1 < sum(i % cameras == camera for i in looks) / views < 0.4


def test_what_is_of_no_view_does_not_count() -> None:
    """Gradients that are zero everywhere, as of a loss of the regularisers alone."""
    params, optimizers, phases = scene(4)
    for in_view in [slice(None)] + 40 * [slice(0)]:
        step(params, optimizers, in_view)
    assert phases.numbers() == {"visible_share": 1.0}


def test_a_load_of_a_start_begins_with_a_share_of_one() -> None:
    """What was on its way then belongs to another training."""
    params, optimizers, phases = scene(4)
    start = copy.deepcopy(optimizers["means"].state_dict())
    for _ in range(6):
        step(params, optimizers, slice(1))
    optimizers["means"].load_state_dict(start)
    found = []
    for _ in range(5):
        step(params, optimizers, slice(None))
        found.append(float(phases.numbers()["visible_share"]))
    assert found == [1.0] * 5


def test_frozen_positions_are_not_out_of_view() -> None:
    """A mask on the positions' gradient; every view sees all points."""
    params, optimizers, phases = scene(200)
    for _ in range(300):
        step(params, optimizers, slice(20))
    assert phases.numbers() == {"visible_share": 1.0}


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


@pytest.mark.parametrize("way", ["a save", "a copy"])
def test_a_save_and_a_copy_lose_no_look(way: str) -> None:
    """A share that counts two iterations later is saved as one that does not count yet."""
    params, optimizers, phases = scene(4)
    for seen in (slice(None), slice(1)):
        step(params, optimizers, seen)
    optimizers["means"].state_dict()  # which changes nothing
    assert phases.numbers() == {"visible_share": 1.0}
    if way == "a save":
        saved = optimizers["means"].state_dict()["param_groups"][0]["opt3dgs"]
        notes = json.loads(saved)["notes"]["OutOfView"]
    else:
        copied = copy.deepcopy(phases)
        notes = copied.notes_of(copied.parts[0])
    assert notes == {"share": 1.0, "due of share": 2, "view's share": 1.0}


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
