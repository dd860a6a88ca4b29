"""The test problems have the values, minima and gradients that the literature gives."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from problems import (
    MULTIMODAL,
    SMOOTH,
    Problem,
    double_well,
    kramers_rate,
    nine_modes,
)
from torch import Tensor

EVERY = [*SMOOTH, *MULTIMODAL]


@pytest.mark.parametrize("problem", EVERY, ids=lambda p: p.name)
def test_known_answers(problem: Problem) -> None:
    start, minimum = problem.starts(1), problem.minima(1)
    # the starts' values are printed with five or six digits
    assert float(problem.value(start)) == pytest.approx(problem.start_value, rel=1e-5, abs=1e-9)
    # the minima are printed with ten to thirteen; Brown's and Powell's slopes there are 1e6, 1e5
    value = float(problem.value(minimum))
    assert value == pytest.approx(problem.minimum_value, rel=1e-8, abs=1e-11)
    slope = float(problem.gradient(minimum).abs().max())
    assert slope < 1e-4 * max(1.0, float(problem.gradient(start).abs().max()))


def hessian_of(value: Callable[[Tensor], Tensor], point: Tensor) -> Tensor:
    found = torch.autograd.functional.hessian(lambda p: value(p[None])[0], point)
    assert isinstance(found, Tensor)
    return found


def test_double_well_and_its_rate() -> None:
    for barrier in (0.5, 3.0):
        at = torch.tensor([[-1.0], [0.0], [1.0]], dtype=torch.float64)
        assert double_well(at, barrier).tolist() == [0.0, barrier, 0.0]
        curvatures = [
            float(hessian_of(lambda x, h=barrier: double_well(x, h), point)) for point in at
        ]
        assert curvatures == pytest.approx([8 * barrier, -4 * barrier, 8 * barrier])
    expected = math.sqrt(32) * 3 / (2 * math.pi) * math.exp(-3 / 0.5)
    assert kramers_rate(3.0, 0.5) == pytest.approx(expected, rel=1e-12)


def test_nine_modes_has_nine_minima() -> None:
    axis = torch.linspace(-2.5, 2.5, 501, dtype=torch.float64)
    grid = nine_modes(torch.cartesian_prod(axis, axis)).reshape(501, 501)
    inner = grid[1:-1, 1:-1]
    low = torch.ones_like(inner, dtype=torch.bool)
    for i in range(3):
        for j in range(3):
            if (i, j) != (1, 1):
                low &= inner < grid[i : i + 499, j : j + 499]
    assert int(low.sum()) == 9
    assert float(grid.max()) == pytest.approx(16.3333, abs=1e-4)
