"""Harmonics: longer steps of the higher spherical harmonics in short trainings."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from gaussians import RATES, adams_of, make_gaussians, parameters, same_tensors, steps
from reference_step import default_step

from opt3dgs_optim import Harmonics, PhaseScheduler

NAMES = ("means", "sh0", "shN")


@pytest.mark.parametrize(
    ("total", "factor"),
    [(300, 1), (3_000, 1), (6_000, 2), (10_000, 3), (15_000, 2), (30_000, 1), (60_000, 1)],
)
def test_how_much_longer_a_step_is_in_a_training_of_that_length(total: int, factor: float) -> None:
    start, plain, scaled = (parameters(5, *NAMES) for _ in range(3))
    steps(adams_of(plain), plain, 1)
    steps(PhaseScheduler(total, parts=[Harmonics()]).upgrade(adams_of(scaled)), scaled, 1)
    for name, at in start.items():
        moved = [(params[name] - at).detach() for params in (plain, scaled)]
        torch.testing.assert_close(moved[1], moved[0] * (factor if name == "shN" else 1))
    theirs: Any = {name: make_gaussians(5)[name] for name in NAMES}
    grads: Any = {name: param.grad for name, param in scaled.items()}
    default_step(theirs, grads, {}, RATES, 0, total, {"harmonics": ("shN",)})
    assert same_tensors(scaled, theirs)


def test_without_a_planned_end_it_goes_by_the_iterations_so_far() -> None:
    params = parameters(5, "means", "shN")
    phases = PhaseScheduler(parts=[Harmonics()])
    adams = phases.upgrade(adams_of(params))
    for iteration, factor in ((0, 1), (6_000, 2), (15_000, 2), (40_000, 1)):
        phases.observe(iteration=iteration)
        adams["shN"].state.clear()  # so that each is Adam's first step, which is as long as the rate
        before = params["shN"].detach().clone()
        for param in params.values():
            param.grad = torch.ones_like(param)
        for adam in adams.values():
            adam.step()
        expected = torch.full_like(before, RATES["shN"] * factor)
        torch.testing.assert_close(before - params["shN"], expected, atol=1e-6, rtol=1e-4)
