"""Harmonics: longer steps of the higher spherical harmonics in short trainings."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from gaussians import adams_of, parameters, steps

from opt3dgs_optim import Harmonics, PhaseScheduler


@pytest.mark.parametrize(
    ("total", "factor"), [(300, 4), (7_500, 4), (10_000, 3), (15_000, 2), (30_000, 1), (60_000, 1)]
)
def test_a_step_is_as_much_longer_as_the_training_is_shorter(total: int, factor: float) -> None:
    plain: Any = parameters(5, "means", "sh0", "shN")
    scaled: Any = parameters(5, "means", "sh0", "shN")
    steps(adams_of(plain), plain, 1)
    steps(PhaseScheduler(total, parts=[Harmonics()]).upgrade(adams_of(scaled)), scaled, 1)
    for name, start in parameters(5, "means", "sh0", "shN").items():
        moved = [(params[name] - start).detach() for params in (plain, scaled)]
        torch.testing.assert_close(moved[1], moved[0] * (factor if name == "shN" else 1))


def test_without_a_planned_end_it_falls_with_the_iterations() -> None:
    params: Any = parameters(5, "means", "shN")
    phases = PhaseScheduler(parts=[Harmonics()])
    adams = phases.upgrade(adams_of(params))
    for iteration, factor in ((0, 4), (15_000, 2), (40_000, 1)):
        phases.observe(iteration=iteration)
        stepped = torch.zeros_like(params["shN"])
        adams["shN"].state.clear()
        before = params["shN"].detach().clone()
        params["means"].grad = torch.ones_like(params["means"])
        params["shN"].grad = torch.ones_like(stepped)
        for adam in adams.values():
            adam.step()
        rate = adams["shN"].param_groups[0]["lr"]
        torch.testing.assert_close(before - params["shN"], torch.full_like(before, rate * factor))
