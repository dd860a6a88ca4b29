"""Annealing: longer steps early, shorter ones late, and nothing written into the rates."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from trainers import assert_same, gsplat_optimizers, make_splats, only, train, upgraded

from opt3dgs_optim import Annealing, ConstantMultiplier

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


@pytest.mark.parametrize("nu", [1.0, 1.5])
@pytest.mark.parametrize("annealing", [Annealing(1.0, 1.0), Annealing(8.0, 0.4)])
def test_every_step_is_adams_times_the_factors(annealing: Annealing, nu: float) -> None:
    """The same gradients with rates set by hand give the same bits; nu ends at the switch."""
    ours, phases, optimizers = upgraded(TOTAL, annealing, ConstantMultiplier(nu), switch=40)
    plain = gsplat_optimizers(theirs := make_splats())
    rates = {name: opt.param_groups[0]["lr"] for name, opt in plain.items()}
    for i in range(TOTAL):
        for name, optimizer in plain.items():
            factor = annealing.at(name, i / TOTAL) * (nu if i < 40 else 1.0)
            optimizer.param_groups[0]["lr"] = rates[name] * factor
        train(theirs, plain, None, i, i + 1)
        train(ours, optimizers, phases, i, i + 1)
    assert_same(ours, theirs)
    held = {name: opt.param_groups[0]["lr"] for name, opt in optimizers.items()}
    assert held == rates  # never written


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


def test_the_log_gets_the_factor() -> None:
    for names, factor in ((("scales", "opacities"), 2.0), (("opacities", "scales"), 1.0)):
        phases = only(TOTAL, Annealing(4.0, 1.0, names=names))
        phases.observe(0.1, iteration=TOTAL // 2)
        assert phases.numbers() == {"annealing": pytest.approx(factor)}


def test_the_defaults_are_those_that_were_measured() -> None:
    assert [Annealing().at("scales", t) for t in (0.0, 1.0)] == [4.0, 0.4]
