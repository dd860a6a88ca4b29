"""Harmonics: longer steps of the higher spherical harmonics in short trainings."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from gaussians import adams_of, parameters, same_tensors, steps

from opt3dgs_optim import Harmonics, PhaseScheduler

NAMES = ("means", "sh0", "shN")


def moved(phases: PhaseScheduler | None) -> dict[str, Any]:
    """What the first step adds to each parameter; of torch's Adam, without a scheduler."""
    params = parameters(5, *NAMES)
    adams = adams_of(params) if phases is None else phases.upgrade(adams_of(params))
    steps(adams, params, 1)
    return {name: (params[name] - at).detach() for name, at in parameters(5, *NAMES).items()}


@pytest.mark.parametrize(
    ("total", "factor"), [(300, 4), (7_500, 4), (10_000, 3), (15_000, 2), (30_000, 1), (60_000, 1)]
)
def test_a_step_is_as_much_longer_as_the_training_is_shorter(total: int, factor: float) -> None:
    found, plain = moved(PhaseScheduler(total, parts=[Harmonics()])), moved(None)
    for name in NAMES:
        torch.testing.assert_close(found[name], plain[name] * (factor if name == "shN" else 1))


def test_a_training_of_no_planned_end_is_unchanged() -> None:
    """Also in the fall to its end."""
    phases = PhaseScheduler(parts=[Harmonics()])
    assert same_tensors(moved(phases), moved(None))
    phases = PhaseScheduler(parts=[Harmonics()])
    phases.finish_in(100)
    assert same_tensors(moved(phases), moved(None))
