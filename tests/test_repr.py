"""Optimizers and scheduler say where they are, before the first step and after the last."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
from torch.nn import Parameter
from trainers import begun, everything, gsplat_optimizers, make_splats, only, train

from opt3dgs_optim import (
    AWSGLD,
    Annealing,
    Averaging,
    EnergyHistogram,
    Fading,
    IsotropicNoise,
    LQNAdam,
    PhaseScheduler,
    PositionNoise,
)


def points(rows: int = 4) -> Parameter:
    return Parameter(torch.ones(rows, 3))


def line(item: Any, start: str) -> str:
    """The one line that starts so."""
    found = [row.strip() for row in repr(item).splitlines() if row.strip().startswith(start)]
    assert len(found) == 1, repr(item)
    return found[0]


def test_an_optimizer_says_its_parts_and_groups() -> None:
    optimizer = AWSGLD([points()], 0.5, noise=IsotropicNoise(temperature=0.0))
    assert repr(optimizer).splitlines() == [
        "AWSGLD(",
        "  IsotropicNoise(temperature=0.0)",
        "  group 0 [4, 3]: lr 0.5",
        ")",
    ]
    assert repr(AWSGLD([points()], 0.5)).splitlines()[1:-1] == ["  group 0 [4, 3]: lr 0.5"]
    histogram = EnergyHistogram(warmup=7)
    assert line(AWSGLD([points()], histogram=histogram), "EnergyHistogram(") == str(histogram)


def test_noise_does_not_print_the_gaussians() -> None:
    gaussians = {name: torch.zeros(4, 3) for name in ("scales", "quats", "opacities")}
    said = AWSGLD([points()], noise=PositionNoise(gaussians, scale=5e5))
    assert line(said, "PositionNoise") == "PositionNoise(scale=500000)"


def test_lqnadam_shows_the_accepted_share_of_its_last_step() -> None:
    x = points()
    optimizer = LQNAdam([x], 0.1, history_size=3)
    assert line(optimizer, "Curvature(") == "Curvature(3 pairs per point of all)"
    for _ in range(4):
        x.grad = x.detach() * torch.tensor([1.0, 2.0, 3.0])
        optimizer.step()
    share = optimizer.accepted_share
    assert share is not None
    assert line(optimizer, "Curvature(").endswith(f"accepted share {float(share):.3g})")


@pytest.mark.parametrize("rate", [0.25, torch.tensor(0.25)])
def test_learning_rates_of_all_kinds(rate: Any) -> None:
    groups = [{"params": [points(), points(5)], "name": f"p{i}", "lr": rate} for i in range(2)]
    said = LQNAdam(groups)
    assert line(said, "p0") == "p0 2 tensors: lr 0.25"
    assert line(said, "p1") == "p1 2 tensors: lr 0.25"


def test_the_phases_of_a_training() -> None:
    splats, phases = make_splats(), everything(12, 8)
    assert line(phases, "iteration") == "iteration 0 of 12, exploration, switch at 8"
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, 11)
    assert line(phases, "iteration") == "iteration 11 of 12, exploitation, switch at 8"
    for part in phases.parts:
        for said in (phases, optimizers["means"]):
            assert line(said, f"{type(part).__name__}(") == str(part)
    assert line(PhaseScheduler(10, 10), "iteration").endswith("exploration, no switch")


def test_a_part_says_its_options() -> None:
    parts = [Annealing(peak=3.0), Fading(seed=2), Averaging()]
    said = repr(only(100, *parts))
    assert "Annealing(peak=3.0, final=0.4, opacity_peak=1.0)" in said
    assert "seed=2)" in said  # the names of all Gaussian parameters are left out
    assert "\n  Averaging()\n" in said


@pytest.mark.parametrize("steps", [0, 3, 11])
def test_copies_say_the_same(steps: int) -> None:
    splats, optimizers = begun(phases := everything(12, 8))
    train(splats, optimizers, phases, 0, steps)
    for item in (phases, *optimizers.values()):
        assert repr(item).splitlines()[0] == f"{type(item).__name__}("
        assert repr(copy.deepcopy(item)) == repr(item)
        assert repr(pickle.loads(pickle.dumps(item))) == repr(item)


def test_the_repr_changes_nothing() -> None:
    ends = []
    for look in (False, True):
        splats, optimizers = begun(phases := everything(12, 8))
        for iteration in range(11):
            train(splats, optimizers, phases, iteration, iteration + 1)
            if look:
                repr(phases)
                repr(optimizers)
        ends.append(splats["means"].detach())
    assert torch.equal(*ends)
