"""Annealing: longer steps early, shorter ones late, and nothing written into the rates."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
import torch
from trainers import (
    check_resume,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    train,
    upgraded,
)

from opt3dgs_optim import Annealing, ConstantMultiplier, Fading

TOTAL = 60


@pytest.mark.parametrize(
    ("progress", "factor"),
    [(0.0, 8.0), (1.0, 0.5), (0.5, 2.0), (0.25, 4.0), (-1.0, 8.0), (3.0, 0.5)],
)
def test_factor_falls_geometrically(progress: float, factor: float) -> None:
    assert Annealing(8.0, 0.5).at("scales", progress) == pytest.approx(factor)


def test_names_are_those_of_every_trainer() -> None:
    annealing = Annealing(4.0, 1.0, names=("xyz", "scaling"))
    assert annealing.at("means", 0.0) == annealing.at("xyz", 0.0) == 4.0
    assert annealing.at("scales", 0.5) == pytest.approx(2.0)
    assert annealing.at("quats", 0.0) == annealing.at("opacities", 0.0) == 1.0  # left out
    assert annealing.at("camera_opt", 0.0) == Annealing().at(None, 0.0) == 1.0


def test_opacities_have_a_peak_of_their_own() -> None:
    annealing = Annealing(8.0, 0.5)
    assert annealing.at("opacities", 0.0) == annealing.at("opacity", 0.0) == 1.0
    assert annealing.at("opacities", 1.0) == annealing.at("scales", 1.0) == 0.5
    assert Annealing(8.0, 0.5, opacity_peak=2.0).at("opacities", 0.5) == pytest.approx(1.0)


def test_the_positions_are_left_alone_unless_they_are_named() -> None:
    annealing = Annealing(8.0, 0.5)
    assert annealing.at("means", 0.0) == annealing.at("xyz", 0.0) == 1.0
    assert annealing.names == ("scales", "quats", "opacities", "sh0", "shN")
    every = Annealing(8.0, 0.5, names=(*annealing.names, "xyz"))
    assert every.at("means", 0.0) == 8.0
    assert every.at("scales", 1.0) == 0.5


def test_every_step_is_adams_times_the_factor() -> None:
    """The same gradients with learning rates set by hand give the same bits."""
    annealing = Annealing(8.0, 0.4)
    ours, theirs = make_splats(), make_splats()
    phases = only(TOTAL, annealing)
    optimizers, plain = phases.upgrade(gsplat_optimizers(ours)), gsplat_optimizers(theirs)
    rates = {name: opt.param_groups[0]["lr"] for name, opt in plain.items()}
    for i in range(TOTAL):
        for name, optimizer in plain.items():
            optimizer.param_groups[0]["lr"] = rates[name] * annealing.at(name, i / TOTAL)
        train(theirs, plain, None, i, i + 1)
        train(ours, optimizers, phases, i, i + 1)
    for name in ours:
        assert torch.equal(ours[name], theirs[name]), name
        assert optimizers[name].param_groups[0]["lr"] == rates[name]  # never written


def test_annealing_multiplies_nu_and_goes_on_after_the_switch() -> None:
    """The steps say so: the same gradient with the rates set by hand."""
    nu = ConstantMultiplier(1.5)
    for iteration, factor in ((15, 1.5 * 4.0), (30, 2.0)):
        ours, theirs = make_splats(), make_splats()
        phases = only(TOTAL, nu, Annealing(8.0, 0.5), switch=30)
        scales = phases.upgrade(gsplat_optimizers(ours))["scales"]
        stock = gsplat_optimizers(theirs)["scales"]
        stock.param_groups[0]["lr"] *= factor
        phases.observe(0.1, iteration=iteration)
        ours["scales"].grad, theirs["scales"].grad = (torch.ones(12, 3) for _ in "ab")
        scales.step()
        stock.step()
        torch.testing.assert_close(ours["scales"], theirs["scales"], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_resume_is_bit_exact(make: Any) -> None:
    parts = [Annealing(), Fading(share=0.5, events=20)]
    check_resume(make, lambda: only(TOTAL, *parts), TOTAL, 23)


@pytest.mark.parametrize("decoupled", ["AdamW", "Adam"])
def test_the_factor_is_none_of_decoupled_decays_business(decoupled: str) -> None:
    """nu = -5 must not make weights grow: the step turns around, the decay does not."""
    x, y = [torch.nn.Parameter(torch.ones(4, 3)) for _ in "ab"]
    options: dict[str, Any] = {"lr": 0.01, "weight_decay": 0.1}
    if decoupled == "Adam":
        options["decoupled_weight_decay"] = True
    cls = getattr(torch.optim, decoupled)
    phases = only(TOTAL, ConstantMultiplier(-5.0))
    ours = phases.upgrade({"means": cls([x], **options)})["means"]
    plain = torch.optim.Adam([y], lr=0.01)
    for step in range(6):
        phases.observe(0.1)
        x.grad = torch.full((4, 3), 1.0 + step)
        y.grad = x.grad.clone()
        before = y.detach().clone()
        ours.step()
        plain.step()
        with torch.no_grad():  # the decay of AdamW, the step of Adam times nu
            y.copy_(before * (1 - 0.01 * 0.1) - 5.0 * (y - before))
    torch.testing.assert_close(x, y, rtol=1e-6, atol=1e-7)
    assert ours.param_groups[0]["weight_decay"] == 0.1
    assert ours.param_groups[0]["lr"] == 0.01


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_it_can_be_copied(copied: Any) -> None:
    annealing = Annealing(names=("xyz", "scales"))
    assert copied(annealing) == annealing
    splats, phases, optimizers = upgraded(TOTAL, annealing)
    train(splats, optimizers, phases, 0, 3)
    assert repr(copied(optimizers["means"])) == repr(optimizers["means"])


def test_the_log_gets_the_factor() -> None:
    phases = only(TOTAL, Annealing(4.0, 1.0))
    phases.observe(0.1, iteration=TOTAL // 2)
    assert phases.numbers() == {"annealing": pytest.approx(2.0)}
