"""Annealing: longer steps early, shorter ones late, and nothing written into the rates."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch
from torch.nn import Parameter

from opt3dgs_optim import Annealing, PhaseScheduler

TOTAL = 20


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
    assert Annealing().names == ("scales", "quats", "opacities", "sh0", "shN")
    assert Annealing(8.0, 0.5).at("xyz", 0.0) == 1.0
    assert [Annealing().at("scales", t) for t in (0.0, 1.0)] == [4.0, 0.4]  # as measured


def test_the_factor_is_none_of_decoupled_decays_business() -> None:
    x, y = Parameter(torch.ones(4, 3)), Parameter(torch.ones(4, 3))
    adam = torch.optim.AdamW([x], lr=0.01, weight_decay=0.1)
    phases = PhaseScheduler(TOTAL, parts=[Annealing(5.0, 5.0, names=("means",))])
    ours, plain = phases.upgrade({"means": adam})["means"], torch.optim.Adam([y], lr=0.01)
    for step in range(4):
        x.grad, y.grad = torch.full((4, 3), 1.0 + step), torch.full((4, 3), 1.0 + step)
        before = y.detach().clone()
        ours.step()
        plain.step()
        with torch.no_grad():  # the decay of AdamW, the step of Adam times the factor
            y.copy_(before * (1 - 0.01 * 0.1) + 5.0 * (y - before))
    torch.testing.assert_close(x, y, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["peak", "final", "opacity_peak"])
def test_options(name: str) -> None:
    wrong: Any
    for wrong in (0.0, -1.0, float("inf"), "4"):
        with pytest.raises(ValueError, match=re.escape(f"Annealing: {name}={wrong!r}")):
            Annealing(**{name: wrong})
    with pytest.raises(ValueError, match="names="):
        Annealing(names=("colour",))
    below_one: Any = {name: 0.5}
    assert getattr(Annealing(**below_one), name) == 0.5
    assert repr(Annealing()) == "Annealing(peak=4.0, final=0.4, opacity_peak=1.0)"
