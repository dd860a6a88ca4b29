"""Optimizers and scheduler say where they are, before the first step and after the last."""

from __future__ import annotations

import copy
import pickle
import re
from typing import Any

import pytest
import torch
from opt3dgs_optim.noise import CovarianceNoise, IsotropicNoise
from torch.optim import Optimizer
from trainers import everything

from opt3dgs_optim import AWSGLD, EnergyHistogram, Fading, LQNAdam, PhaseScheduler


def points(rows: int = 4) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.ones(rows, 3))


def train(scheduler: PhaseScheduler, optimizers: dict[str, Optimizer], steps: int) -> None:
    """Descend a quadratic in all parameters."""
    for _ in range(steps):
        loss = torch.zeros(())
        for optimizer in optimizers.values():
            for group in optimizer.param_groups:
                loss = loss + sum((p**2).sum() for p in group["params"])
        loss.backward()
        scheduler.observe(loss)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()


def upgraded(scheduler: PhaseScheduler) -> dict[str, Optimizer]:
    adams = {
        name: torch.optim.Adam([{"params": [points()], "lr": 0.01, "name": name}])
        for name in ("means", "scales")
    }
    return scheduler.upgrade(adams)


def only(text: str, start: str) -> str:
    """The one line that starts so."""
    found = [line.strip() for line in text.splitlines() if line.strip().startswith(start)]
    assert len(found) == 1, text
    return found[0]


def test_awsgld_from_no_energy_over_the_warm_up_to_nu() -> None:
    histogram = EnergyHistogram(energy_range=(0.0, 20.0), temperature=1.0, warmup=3)
    x = points()
    optimizer = AWSGLD([x], 0.5, histogram=histogram, noise=IsotropicNoise(temperature=0.0))
    assert only(repr(optimizer), "nu:") == "nu: 1, no energy observed yet"
    assert only(repr(optimizer), "noise:") == "noise: IsotropicNoise temperature 0"
    assert only(repr(optimizer), "group 0") == "group 0 [4, 3]: lr 0.5"
    for step in range(6):
        optimizer.zero_grad()
        loss = (x**2).sum()
        loss.backward()
        histogram.observe(loss)
        optimizer.step()
        if step == 1:
            assert only(repr(optimizer), "nu:") == "nu: 1, warm-up: 2 of 3 energies"
    shown = re.match(r"nu: (\S+), mean (\S+) since the warm-up", only(repr(optimizer), "nu:"))
    assert shown is not None
    assert float(shown[1]) == pytest.approx(float(histogram.multiplier), rel=1e-3)
    assert float(shown[2]) == pytest.approx(float(histogram.mean_multiplier), rel=1e-3)


def test_what_is_off_is_said_to_be() -> None:
    said = repr(AWSGLD([points()]))
    assert only(said, "nu:") == "nu: off"
    assert only(said, "noise:") == "noise: off"


def test_noise_does_not_print_the_gaussians() -> None:
    gaussians = {name: torch.zeros(4, 3) for name in ("scales", "quats", "opacities")}
    said = repr(AWSGLD([points()], noise=CovarianceNoise(gaussians, scale=5e5)))
    assert only(said, "noise:") == "noise: CovarianceNoise scale 500000"


def test_lqnadam_shows_the_accepted_share_of_its_last_step() -> None:
    x = points()
    optimizer = LQNAdam([x], 0.1, history_size=3)
    assert only(repr(optimizer), "curvature:") == (
        "curvature: 3 consecutive pairs per point, not in use yet"
    )
    for _ in range(4):
        x.grad = x.detach() * torch.tensor([1.0, 2.0, 3.0])
        optimizer.step()
    share = optimizer.accepted_share
    assert share is not None
    assert only(repr(optimizer), "curvature:").endswith(
        f"accepted share {float(share):.3g} in the last step"
    )


def test_skipped_rows_are_shown_once_there_are_any() -> None:
    x = points()
    optimizer = LQNAdam([x])
    assert "skipped" not in repr(optimizer)
    x.grad = torch.ones(4, 3)
    x.grad[1] = float("nan")
    optimizer.step()
    assert only(repr(optimizer), "skipped") == "skipped rows: 1, for a non-finite gradient"


@pytest.mark.parametrize("rate", [0.25, torch.tensor(0.25)])
def test_learning_rates_of_all_kinds_and_many_groups(rate: Any) -> None:
    groups = [{"params": [points(), points(5)], "name": f"p{i}", "lr": rate} for i in range(10)]
    said = repr(LQNAdam(groups))
    assert only(said, "p0") == "p0 2 tensors, 27 numbers: lr 0.25"
    assert only(said, "and") == "and 2 more groups"
    assert "p8" not in said


def test_the_phases_of_a_training() -> None:
    scheduler = everything(12, 8)
    assert (
        only(repr(scheduler), "phase:")
        == "phase: exploration, iteration 0 of 12, switch at 8 (in 8)"
    )
    optimizers = upgraded(scheduler)
    assert "not in use yet" in only(repr(optimizers["means"]), "curvature:")
    assert "curvature" not in repr(optimizers["scales"])
    train(scheduler, optimizers, 3)
    for said in (repr(scheduler), repr(optimizers["scales"])):
        assert only(said, "phase:") == "phase: exploration, iteration 3 of 12, switch at 8 (in 5)"
        assert only(said, "nu:") == "nu: 1, warm-up: 3 of 4 energies"
    train(scheduler, optimizers, 8)
    for said in (repr(scheduler), repr(optimizers["means"])):
        assert only(said, "phase:") == "phase: exploitation, iteration 11 of 12, since 8"
        assert only(said, "nu:") == "nu: off while exploiting"
        share = scheduler.accepted_share
        assert share is not None
        assert f"accepted share {float(share):.3g} " in only(said, "curvature:")


def test_a_scheduler_with_everything_off_or_everything_on() -> None:
    off = repr(PhaseScheduler(10, 10, curvature=None, multiplier=None))
    assert only(off, "phase:") == "phase: exploration, iteration 0 of 10, no switch"
    assert only(off, "nu:") == "nu: off"
    assert only(off, "curvature") == "curvature=None"
    constant = PhaseScheduler(10, multiplier=1.5)
    constant.observe(1.0)
    assert only(repr(constant), "nu:") == "nu: 1.5, mean 1.5 since the warm-up"


def test_what_an_adaptive_run_has_switched_off() -> None:
    scheduler = PhaseScheduler(
        2000, 2000, multiplier=EnergyHistogram(energy_range=(0.0, 1.0), warmup=4), adaptive=True
    )
    optimizers = upgraded(scheduler)
    for said in (repr(scheduler), repr(optimizers["means"])):
        assert only(said, "adaptive:") == "adaptive: nothing is switched off"
    for _ in range(600):  # one energy again and again: nu is 1 all the time
        scheduler.observe(0.5)
    reason = scheduler.switched_off["multiplier"]
    for said in (repr(scheduler), repr(optimizers["means"])):
        assert "adaptive:" not in said
        shown = only(said, "switched off:").removeprefix("switched off: multiplier: ")
        assert reason.startswith(shown.removesuffix(" ..."))
        assert len(shown) > 40
        assert max(map(len, said.splitlines())) <= 100
        assert only(said, "nu:") == "nu: off"
    assert "switched off" not in repr(PhaseScheduler(2000))
    assert "adaptive" not in repr(PhaseScheduler(2000))


def test_a_part_with_many_options_takes_two_lines() -> None:
    names = ("means", "scales", "quats", "sh0", "shN")
    said = repr(PhaseScheduler(2000, fading=Fading(names=names)))
    assert max(map(len, said.splitlines())) <= 100
    assert f"names={names}" in " ".join(said.split())


def test_a_part_that_is_switched_on_again_is_no_longer_listed() -> None:
    energies = EnergyHistogram(energy="view_centered", warmup=4)
    scheduler = PhaseScheduler(1000, multiplier=energies, adaptive=True)
    for _ in range(200):
        scheduler.observe(0.5, view=0)
    assert only(repr(scheduler), "switched off:").startswith("switched off: view_centering: all of")
    scheduler.observe(0.5, view=1)
    assert only(repr(scheduler), "adaptive:") == "adaptive: nothing is switched off"


@pytest.mark.parametrize("steps", [0, 3, 11])
def test_copies_and_lines_stay_short(steps: int) -> None:
    scheduler = everything(12, 8)
    optimizers = upgraded(scheduler)
    train(scheduler, optimizers, steps)
    all_of_them: list[Any] = [scheduler, *optimizers.values()]
    for item in all_of_them:
        said = repr(item)
        assert max(map(len, said.splitlines())) <= 100
        assert said.splitlines()[0] == f"{type(item).__name__}("
        assert repr(copy.deepcopy(item)).splitlines()[1] == said.splitlines()[1]
    optimizer = AWSGLD([points()], histogram=EnergyHistogram())
    assert repr(pickle.loads(pickle.dumps(optimizer))) == repr(optimizer)


def test_the_repr_changes_nothing() -> None:
    states = []
    for look in (False, True):
        torch.manual_seed(0)
        scheduler = everything(12, 8)
        optimizers = upgraded(scheduler)
        for _ in range(11):
            train(scheduler, optimizers, 1)
            if look:
                repr(scheduler)
                repr(optimizers)
        states.append(optimizers["means"].param_groups[0]["params"][0].detach())
    assert torch.equal(*states)
