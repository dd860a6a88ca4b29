"""Stiff, extreme and damaged rows: finite, no row knows another, descent where it is due.

Every batch has rows that differ by orders of magnitude, as Gaussians of one scene do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from problems import gradient, hessians, log_uniform, quadratic
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import AWSGLD, EnergyHistogram, IsotropicNoise, LQNAdam

ROWS = 200
Make = Callable[[Parameter], torch.optim.Optimizer]


def awsgld(x: Parameter) -> AWSGLD:
    """With a histogram in its warm-up, so that the package's own step is made."""
    return AWSGLD([x], lr=0.01, eps=1e-30, histogram=EnergyHistogram(warmup=10**6))


def lqnadam(x: Parameter) -> LQNAdam:
    return LQNAdam([x], lr=0.01, eps=1e-30)


def plain_lqn(x: Parameter) -> LQNAdam:
    return LQNAdam([x], lr=0.01, eps=1e-30, graft=False)


MAKES = pytest.mark.parametrize("make", [awsgld, lqnadam, plain_lqn])


def steps(x: Parameter, make: Make, slope: Callable[[Tensor, int], Tensor], count: int) -> Tensor:
    optimizer = make(x)
    histogram = getattr(optimizer, "histogram", None)
    for k in range(count):
        x.grad = slope(x.detach(), k)
        if histogram is not None:
            histogram.observe(0.1)
        optimizer.step()
    return x.detach()


@MAKES
@pytest.mark.parametrize("rotated", [False, True])
@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6, 1e12])
def test_any_condition_in_units_of_1e_8_to_1e8(make: Make, rotated: bool, condition: float) -> None:
    """Finite, and never far from where it was: Adam's steps are about 0.01 a coordinate."""
    unit = log_uniform(ROWS, 1e-8, 1e8).float()[:, None]
    diagonal = torch.diag(condition ** torch.linspace(0, 1, 3, dtype=torch.float64))
    hessian = (hessians(ROWS, condition) if rotated else diagonal.expand(ROWS, 3, 3)).float()

    def slope(x: Tensor, k: int) -> Tensor:
        return torch.einsum("nij,nj->ni", hessian, x) * unit

    x = steps(Parameter(torch.ones(ROWS, 3)), make, slope, 40)
    assert bool(torch.isfinite(x).all())
    assert float((x - 1).abs().max()) < 0.6
    if make is not plain_lqn:
        loss = torch.einsum("ni,nij,nj->n", x, hessian, x)
        assert float((loss < hessian.sum((1, 2))).double().mean()) > 0.9


@pytest.mark.parametrize("make", [awsgld, lqnadam])
@pytest.mark.parametrize("scale", [2.0**-40, 2.0**40])
def test_the_unit_of_the_loss_changes_nothing(make: Make, scale: float) -> None:
    """By 1e-12 and 1e12. Adam's steps do not depend on it, up to eps; neither do ours.

    Without grafting they do: the first gradient has the loss's unit, and H g has none.
    """
    hessian, ends = hessians(50, 1e3), []
    for unit in (1.0, scale):
        x = Parameter(torch.ones(50, 3, dtype=torch.float64))
        ends.append(steps(x, make, lambda x, k, u=unit: gradient(quadratic(hessian), x) * u, 40))
    # A power of two is exact, but for eps
    torch.testing.assert_close(*ends, rtol=1e-9, atol=1e-9)


@MAKES
@pytest.mark.parametrize("share", [0.3, 0.9, 0.99])
def test_unseen_rows_do_not_move_and_no_row_knows_another(make: Make, share: float) -> None:
    """Half of the rows alone go the same way bit for bit."""
    hessian = hessians(ROWS, 1e3).float()
    generator = torch.Generator().manual_seed(0)
    unseen = torch.rand(40, ROWS, generator=generator) < share
    unseen[:, :20] = True
    seen = ~unseen[..., None]

    def slope(rows: slice) -> Callable[[Tensor, int], Tensor]:
        return lambda x, k: torch.einsum("nij,nj->ni", hessian[rows], x) * seen[k, rows]

    whole = steps(Parameter(torch.ones(ROWS, 3)), make, slope(slice(None)), 40)
    half = steps(Parameter(torch.ones(ROWS // 2, 3)), make, slope(slice(ROWS // 2)), 40)
    assert torch.equal(whole[: ROWS // 2], half)
    assert bool((whole[:20] == 1).all())
    assert bool(torch.isfinite(whole).all())


@MAKES
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_rows_that_are_not_finite_hurt_no_other(make: Make, bad: float) -> None:
    hessian = hessians(ROWS, 10.0).float()

    def slope(x: Tensor, k: int) -> Tensor:
        grad = torch.einsum("nij,nj->ni", hessian, x)
        if k % 5 == 2:
            grad[::7] = bad
        return grad

    x = steps(Parameter(torch.ones(ROWS, 3)), make, slope, 20)
    sound = torch.arange(ROWS) % 7 != 0
    clean = steps(
        Parameter(torch.ones(ROWS, 3)),
        make,
        lambda x, k: torch.einsum("nij,nj->ni", hessian, x),
        20,
    )
    assert torch.equal(x[sound], clean[sound])
    assert bool(torch.isfinite(x).all())
    assert float((x - 1).abs().max()) < 0.4


@MAKES
def test_alternating_signs_do_not_grow(make: Make) -> None:
    """Gradients that turn round with every step, as across a valley floor."""
    x = steps(
        Parameter(torch.ones(ROWS, 3)), make, lambda x, k: torch.full_like(x, (-1.0) ** k), 41
    )
    assert float((x - 1).abs().max()) < 0.1


@MAKES
def test_identical_gradients_are_adams_steps(make: Make) -> None:
    """y = 0 is no pair; full steps."""
    x = steps(Parameter(torch.ones(ROWS, 3)), make, lambda x, k: torch.ones_like(x), 20)
    torch.testing.assert_close(x, torch.full_like(x, 1 - 20 * 0.01), rtol=1e-5, atol=0)


@MAKES
def test_steps_below_the_last_place_do_not_move(make: Make) -> None:
    """|x| = 1e6 with a rate of 1e-6: s = 0 is no pair, and no division by it."""
    x = Parameter(torch.full((ROWS, 3), 1e6))
    optimizer = make(x)
    optimizer.param_groups[0]["lr"] = 1e-6
    histogram = getattr(optimizer, "histogram", None)
    for _ in range(10):
        x.grad = x.detach() * torch.tensor([1.0, 10.0, 100.0])
        if histogram is not None:
            histogram.observe(0.1)
        optimizer.step()
    assert bool((x.detach() == 1e6).all())


@pytest.mark.parametrize("size", [1e-45, 1e-42, 1e-39])
def test_denormal_gradients_step_as_far_as_torch_does(size: float) -> None:
    """No digits are left in y: the step is then plain Adam's or smaller, never a wild one."""
    ends = []
    for make in (LQNAdam, torch.optim.Adam):
        x = Parameter(torch.ones(ROWS, 3))

        def slope(x: Tensor, k: int) -> Tensor:
            return torch.full_like(x, size) * (1 + k % 3)

        ends.append(steps(x, lambda p, m=make: m([p], lr=0.01), slope, 12))
    assert torch.equal(*ends)  # 1e-39 / (1e-39 + eps) is nothing


@MAKES
@pytest.mark.parametrize("rows", [0, 1])
def test_no_row_and_one(make: Make, rows: int) -> None:
    x = steps(Parameter(torch.ones(rows, 3)), make, lambda x, k: x * 2, 10)
    assert x.shape == (rows, 3)
    assert bool((x < 1).all())


@pytest.mark.parametrize("large", [1e16, 1e27, 3e38])
def test_the_plain_drift_forgets_a_large_gradient(large: float) -> None:
    x = Parameter(torch.zeros(2))
    walk = AWSGLD([x], lr=1e-40, preconditioner="none")
    x.grad = torch.tensor([large, 1.0])
    walk.step()
    walk.param_groups[0]["lr"] = 1e-3
    before = x.detach().clone()
    x.grad = torch.ones(2)
    walk.step()
    torch.testing.assert_close(before - x.detach(), torch.full((2,), 1e-3), rtol=1e-3, atol=0)


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_noise_does_not_wake_a_row_that_is_not_finite(temperature: float) -> None:
    """Nor does such a row spoil others."""
    x = Parameter(torch.zeros(4, 3))
    x.data[1] = math.nan
    options: Any = {"preconditioner": "none", "noise": IsotropicNoise(temperature)}
    walk = AWSGLD([x], lr=0.1, **options)
    x.grad = x.detach().clone()
    walk.step()
    assert torch.isfinite(x).all(1).tolist() == [True, False, True, True]
