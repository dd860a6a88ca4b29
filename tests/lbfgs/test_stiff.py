"""Stiff problems: all scales, axes and conditions at once, and the whole range of float32."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from line_search import minimise
from oracles import dense_bfgs
from points_first import direction, newest_gamma, record
from problems import (
    MUELLER_BROWN_OTHERS,
    MULTIMODAL,
    SMOOTH,
    Problem,
    hessians,
    log_uniform,
    placed,
    rotations,
    to_world,
)
from torch import Tensor

from opt3dgs_optim.lbfgs import history_from_pairs, new_history, two_loop
from opt3dgs_optim.lbfgs.history import header

ROWS, SIZE = 10_000, 5
CONDITIONS = (1.0, 1e3, 1e6, 1e12)


def recorded(
    hessian: Tensor,
    positions: Tensor,  # [steps, N, 3]
    gradient_scale: Tensor | float = 1.0,
    dtype: torch.dtype = torch.float64,
) -> tuple[Tensor, Tensor, Tensor]:
    """A history of the quadratic's pairs along `positions`, the last gradient, and acceptances."""
    history = new_history(positions[0].to(dtype), SIZE)
    g = torch.zeros_like(positions[0], dtype=dtype)
    accepted = torch.zeros(len(g), dtype=torch.bool)
    for x in positions:
        g = (torch.einsum("nij,nj->ni", hessian, x) * gradient_scale).to(dtype)
        visible = torch.isfinite(g).all(1) & (g != 0).any(1)
        accepted, _ = record(history, SIZE, x.to(dtype), g, visible, min_cosine=1e-14)
    return history, g, accepted


def walk(rows: int, steps: int = 6, seed: int = 0) -> Tensor:
    """[steps, rows, 3] random positions: differences that span the space."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(steps, rows, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_units_change_nothing_but_the_units(condition: float) -> None:
    """Positions in units 1e-8 .. 1e8 and losses times 1e-12 .. 1e12, each row its own.

    The units are powers of two, so that the inputs are the same digits: so must the outputs be.
    """
    length = log_uniform(ROWS, 1e-8, 1e8, seed=1).log2().round().exp2()[:, None]
    loss = log_uniform(ROWS, 1e-12, 1e12, seed=2).log2().round().exp2()[:, None]
    hessian, x = hessians(ROWS, condition), walk(ROWS)
    history, g, accepted = recorded(hessian, x)
    plain = two_loop(g, history, SIZE)
    slope = loss / length  # gradients are loss per length
    there = recorded(hessian / length[:, :, None] * slope[:, :, None], x * length)
    assert torch.equal(there[2], accepted)
    assert torch.equal(two_loop(there[1], there[0], SIZE), plain * length)
    grafted = direction(g, history, SIZE, graft=True)
    assert torch.equal(direction(there[1], there[0], SIZE, graft=True), grafted * slope)


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_axes_change_nothing_but_the_axes(condition: float, dtype: torch.dtype) -> None:
    """Rotate pairs and gradient: the pseudo-gradient turns along, to the rounding of the pairs."""
    hessian, x, turn = hessians(ROWS, condition), walk(ROWS), rotations(ROWS, 3, seed=3)
    s = x.diff(dim=0)
    y = torch.einsum("nij,knj->kni", hessian, s)
    g = torch.einsum("nij,nj->ni", hessian, x[-1])

    def pseudo(axes: Tensor) -> Tensor:
        turned = [torch.einsum("nij,...nj->...ni", axes, v).to(dtype) for v in (s, y, g)]
        history = history_from_pairs(turned[0], turned[1])
        return two_loop(turned[2], history, SIZE).double()

    plain, turned = pseudo(torch.eye(3, dtype=torch.float64).expand(ROWS, 3, 3)), pseudo(turn)
    expected = torch.einsum("nij,nj->ni", turn, plain)
    error = (turned - expected).norm(dim=1) / expected.norm(dim=1)
    # A pair with an angle of cosine c loses 1/c of the digits in s.y, and there are five of them.
    cosine = (s * y).sum(2) / (s.norm(dim=2) * y.norm(dim=2))
    bound = 1000 * torch.finfo(dtype).eps / cosine.amin(0).clamp(min=1e-30) ** 2
    assert bool((error <= bound).all())
    if condition == 1.0:  # every pair is parallel: nothing to lose
        assert float(error.max()) < 10 * torch.finfo(dtype).eps


@pytest.mark.parametrize("condition", CONDITIONS)
def test_equals_the_dense_recursion(condition: float) -> None:
    rows = 40
    hessian, x = hessians(rows, condition), walk(rows)
    history, g, _ = recorded(hessian, x)
    found = two_loop(g, history, SIZE)
    s = x.diff(dim=0).numpy()
    y = torch.einsum("nij,knj->kni", hessian, x).diff(dim=0).numpy()
    for row in range(rows):
        matrix = torch.from_numpy(dense_bfgs(s[:, row], y[:, row]))
        expected = matrix @ g[row]
        # Both are 2 K updates in float64, each of which can amplify rounding by |V|^2 ~ |y|^2/s.y
        worst = min(
            float(abs(a @ b) / math.sqrt((a @ a) * (b @ b)))
            for a, b in zip(s[:, row], y[:, row], strict=True)
        )
        slack = 1e-13 / worst**2 * float(matrix.abs().max() * g[row].abs().max())
        assert float((found[row] - expected).abs().max()) <= slack


# -- the whole range of float32 ------------------------------------------------------------------

GRADIENTS = [1e-44, 1e-40, 1e-38, 1e-30, 1e-20, 1e-10, 1.0, 1e10, 1e20, 1e30, 3e37]
STEPS = [1e-30, 1e-20, 1e-12, 1e-6, 1.0, 1e6, 1e20]


@pytest.mark.parametrize(("size", "step"), list(itertools.product(GRADIENTS, STEPS)))
def test_no_intermediate_leaves_float32(size: float, step: float) -> None:
    """Gradients from 1e-44 (denormal) to 3e37, whose squares are nowhere near float32.

    Where gradient and step can be told from zero, and the two units' ratio is a float32, the
    result is the float64 recursion's; where not, the gradient comes back. It is never non-finite,
    never zero.
    """
    rows = 500
    hessian, x = hessians(rows, 30.0), walk(rows)
    slope = size / 100  # |H x| is up to 100
    history, g, accepted = recorded(hessian, x * step, slope / step, torch.float32)
    found = direction(g, history, SIZE, graft=True)
    assert bool(torch.isfinite(found).all())
    assert bool((found != 0).any(1)[(g != 0).any(1)].all())
    assert bool(torch.isfinite(header(history, SIZE).counter).all())
    raw = direction(g, history, SIZE, graft=False)
    assert bool(torch.isfinite(raw).all())
    # Per unit of gradient: s / |y|, which is what is stored. Outside of 1e-30 .. 1e30 float32 has
    # no room for it and its square.
    if slope >= 1e-36 and 1e-30 <= step / slope <= 1e30:
        assert bool(accepted.all())
        gamma = newest_gamma(history, SIZE)
        assert bool(((gamma > 0) & torch.isfinite(gamma)).all())
        reference, g64, _ = recorded(hessian, x, 1.0)
        expected = direction(g64, reference, SIZE, graft=True)
        expected = expected / expected.norm(dim=1, keepdim=True)
        unit = found.double() / found.double().norm(dim=1, keepdim=True)
        # rounding of positions and gradients, over pairs with cosines of 0.3 and more
        assert float((unit - expected).norm(dim=1).max()) < 1e-4


# -- convergence ---------------------------------------------------------------------------------

REACHED = {  # relative to the start's value: what is left after the line searches below
    "Brown badly scaled": 1e-18,  # f = 1e12 at the start: 1e-18 of it is 1e-6
    "Powell badly scaled": 1e-8,  # the valley's floor is flat to 1e-9
    "Powell singular": 1e-15,  # singular Hessian: linear convergence
}


@pytest.mark.parametrize("problem", SMOOTH, ids=lambda p: p.name)
@pytest.mark.parametrize(
    "rows", [50, pytest.param(10_000, marks=pytest.mark.slow, id="ten thousand")]
)
def test_two_loop_with_a_line_search_reaches_the_minimum(problem: Problem, rows: int) -> None:
    """Every row, in units of 1e-8 to 1e8 and in axes of its own."""
    scale, turn = log_uniform(rows, 1e-8, 1e8), rotations(rows, problem.dim)
    value = placed(problem, scale, turn)
    start = to_world(problem.starts(rows), scale, turn)
    end = minimise(value, start, 150)[-1]
    bound = REACHED.get(problem.name, 1e-25)
    assert float(value(end).max()) < bound * problem.start_value
    if problem.name in ("Rosenbrock", "Beale", "Helical valley", "Wood"):
        minimum = to_world(problem.minima(rows), scale, turn)
        error = (end - minimum).norm(dim=1) / minimum.norm(dim=1)
        # f is flat to its rounding: half of the digits, less those of the condition (2,500)
        assert float(error.max()) < 1e-7


@pytest.mark.parametrize("problem", MULTIMODAL, ids=lambda p: p.name)
def test_of_several_valleys_it_finds_the_bottom_of_one(problem: Problem) -> None:
    """From around the customary start, in units of 1e-8 to 1e8: which one is the start's affair."""
    rows = 30
    scale, turn = log_uniform(rows, 1e-8, 1e8), rotations(rows, problem.dim)
    value = placed(problem, scale, turn)
    generator = torch.Generator().manual_seed(0)
    start = problem.starts(rows)
    start += 0.3 * torch.randn(start.shape, generator=generator, dtype=torch.float64)
    end = minimise(value, to_world(start, scale, turn), 40)[-1]
    there = torch.einsum("nij,ni->nj", turn, end / scale[:, None])
    found = problem.value(there)
    assert bool((found < problem.value(start)).all())
    assert bool((found >= problem.minimum_value - 1e-8).all())
    # the square root of float64's rounding of f, times curvatures of up to 1e3
    assert float(problem.gradient(there).abs().max()) < 1e-5
    if problem.name == "Mueller-Brown":
        minima = torch.tensor([problem.minimum_value, *(m[2] for m in MUELLER_BROWN_OTHERS[:2])])
        distance = (found[:, None] - minima.double()).abs()
        assert float(distance.amin(1).max()) < 1e-4
        assert float(distance.amin(0).max()) < 1e-4  # each of the three, from somewhere
