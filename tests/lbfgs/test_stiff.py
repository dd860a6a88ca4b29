"""Stiff problems: all scales, axes and conditions at once, and the whole range of float32.

Through one step of the curvature, by pure torch and by the CUDA kernel's source, which g++ compiles
for the host.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from kernel_host import compiler, host_kernels
from line_search import minimise
from oracles import dense_bfgs
from points_first import header, newest_gamma
from problems import (
    MUELLER_BROWN_OTHERS,
    MULTIMODAL,
    SMOOTH,
    Problem,
    hessians,
    log_uniform,
    placed,
    quadratic,
    rotations,
    to_world,
)
from torch import Tensor

from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history

ROWS, SIZE = 10_000, 5
CONDITIONS = (1.0, 1e3, 1e6, 1e12)
OPTIONS = {"min_cosine": 1e-14}
Step = Callable[..., tuple[Tensor, Tensor, Tensor]]  # as `lqn_direction`
COMPILED = [
    pytest.mark.compiles,
    pytest.mark.skipif(compiler() is None, reason="g++ is not installed"),
]


def on_the_host(x: Tensor, g: Tensor, history: Tensor, size: int, **options: Any) -> Any:
    """`lqn_direction` by the compiled source, for a history in either layout."""
    cells = history.contiguous()
    found = host_kernels(size, g.dtype).lqn(x, g, cells, **options)
    history.copy_(cells)
    return found


@pytest.fixture(params=["torch", pytest.param("kernel", marks=COMPILED, id="kernel on the host")])
def lqn(request: pytest.FixtureRequest) -> Step:
    """`lqn_direction` by either backend."""
    return lqn_direction if request.param == "torch" else on_the_host


def walk(rows: int, steps: int = 6) -> Tensor:
    """[steps, rows, 3] random positions: differences that span the space."""
    generator = torch.Generator().manual_seed(0)
    return torch.randn(steps, rows, 3, generator=generator, dtype=torch.float64)


def fed(
    lqn: Step, hessian: Tensor, positions: Tensor, slope: Any = 1.0, **options: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Walk over a quadratic: the last direction, its gradient, the acceptances, the history."""
    dtype = options.pop("dtype", torch.float64)
    history = new_history(positions[0].to(dtype), SIZE)
    found = g = accepted = torch.zeros(0)
    for x in positions:
        g = (torch.einsum("nij,nj->ni", hessian, x) * slope).to(dtype)
        found, accepted, _ = lqn(x.to(dtype), g, history, SIZE, **OPTIONS, **options)
    return found, g, accepted, history


@pytest.mark.parametrize("graft", [True, False])
@pytest.mark.parametrize("condition", CONDITIONS)
def test_units_change_nothing_but_the_units(lqn: Step, condition: float, graft: bool) -> None:
    """Positions in units 1e-8 .. 1e8 and losses times 1e-12 .. 1e12, each row its own.

    The units are powers of two, so that the inputs are the same digits: so must the outputs be.
    Those of the loss are powers of four: pairs are divided by a root of theirs.
    """
    length = log_uniform(ROWS, 1e-8, 1e8, seed=1).log2().round().exp2()[:, None]
    loss = (log_uniform(ROWS, 1e-12, 1e12, seed=2).log2() / 2).round().mul(2).exp2()[:, None]
    hessian, x, slope = hessians(ROWS, condition), walk(ROWS), loss / length
    plain, _, accepted, _ = fed(lqn, hessian, x, graft=graft)
    there = fed(lqn, hessian / length[:, :, None], x * length, slope, graft=graft)
    assert torch.equal(there[2], accepted)
    assert bool(accepted.any())
    assert torch.equal(there[0], plain * (slope if graft else length))


@pytest.mark.parametrize("condition", CONDITIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_axes_change_nothing_but_the_axes(lqn: Step, condition: float, dtype: torch.dtype) -> None:
    """Rotate pairs and gradient: the pseudo-gradient turns along, to the rounding of the pairs."""
    hessian, x, turn = hessians(ROWS, condition), walk(ROWS), rotations(ROWS, 3, seed=3)
    s = x.diff(dim=0)
    y = torch.einsum("nij,knj->kni", hessian, s)
    g = torch.einsum("nij,nj->ni", hessian, x[-1])

    def pseudo(axes: Tensor) -> Tensor:
        turned = [torch.einsum("nij,...nj->...ni", axes, v).to(dtype) for v in (s, y, g)]
        history = history_from_pairs(turned[0], turned[1])
        head, at = header(history, SIZE), torch.zeros_like(turned[2])
        head.position.copy_(at)  # where it is: no pair is added
        head.gradient.copy_(turned[2])
        return lqn(at, turned[2], history, SIZE, **OPTIONS, graft=False)[0].double()

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
def test_equals_the_dense_recursion(lqn: Step, condition: float) -> None:
    rows = 40
    hessian, x = hessians(rows, condition), walk(rows)
    found, g, _, _ = fed(lqn, hessian, x, graft=False)
    s = x.diff(dim=0).numpy()
    y = torch.einsum("nij,knj->kni", hessian, x).diff(dim=0).numpy()
    for row in range(rows):
        matrix = torch.from_numpy(dense_bfgs(s[:, row], y[:, row]))
        # Both are 2 K updates in float64, each of which can amplify rounding by |V|^2 ~ |y|^2/s.y
        worst = min(
            float(abs(a @ b) / math.sqrt((a @ a) * (b @ b)))
            for a, b in zip(s[:, row], y[:, row], strict=True)
        )
        slack = 1e-13 / worst**2 * float(matrix.abs().max() * g[row].abs().max())
        assert float((found[row] - matrix @ g[row]).abs().max()) <= slack


# -- the whole range of float32 ------------------------------------------------------------------

GRADIENTS = [1e-44, 1e-40, 1e-38, 1e-30, 1e-20, 1e-10, 1.0, 1e10, 1e20, 1e30, 3e37]
STEPS = [1e-30, 1e-20, 1e-12, 1e-6, 1.0, 1e6, 1e20]


@pytest.mark.parametrize(("size", "step"), list(itertools.product(GRADIENTS, STEPS)))
def test_no_intermediate_leaves_float32(lqn: Step, size: float, step: float) -> None:
    """Gradients from 1e-44 (denormal) to 3e37, whose squares are nowhere near float32.

    Where gradient and step can be told from zero, and the two units' ratio is a float32, the
    result is the float64 recursion's; where not, the gradient comes back. It is never non-finite,
    never zero.
    """
    rows, slope = 500, size / 100  # |H x| is up to 100
    hessian, x = hessians(rows, 30.0), walk(rows)
    single = (hessian, x * step, slope / step)
    found, g, accepted, history = fed(lqn, *single, graft=True, dtype=torch.float32)
    raw = fed(lqn, *single, graft=False, dtype=torch.float32)[0]
    assert bool(torch.isfinite(found).all())
    assert bool(torch.isfinite(raw).all())
    assert bool((found != 0).any(1)[(g != 0).any(1)].all())
    assert bool(torch.isfinite(header(history, SIZE).steps).all())
    # Per unit of gradient: |s| / |y|, whose root is in what is stored. Outside of 1e-30 .. 1e30
    # float32 has no room for it.
    if slope >= 1e-36 and 1e-30 <= step / slope <= 1e30:
        assert bool(accepted.all())
        gamma = newest_gamma(history, SIZE)
        assert bool(((gamma > 0) & torch.isfinite(gamma)).all())
        expected = fed(lqn, hessian, x, graft=True)[0]
        expected = expected / expected.norm(dim=1, keepdim=True)
        unit = found.double() / found.double().norm(dim=1, keepdim=True)
        # rounding of positions and gradients, over pairs with cosines of 0.3 and more
        assert float((unit - expected).norm(dim=1).max()) < 1e-4


# -- convergence ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("condition", "left"), [(1.0, 1e-12), (1e3, 1e-10), (1e6, 1e-6), (1e12, 1.0)]
)
def test_line_search_on_quadratics(lqn: Step, condition: float, left: float) -> None:
    hessian = hessians(200, condition)
    start = torch.ones(200, 3, dtype=torch.float64)
    end = minimise(quadratic(hessian), start, 60, step=lqn)[-1]
    assert float(end.norm(dim=1).median()) < left
    # rounding of H x (1e-16 times the condition) is the gradient that is left along the flat axis
    assert float(quadratic(hessian)(end).max()) < 1e-11 * condition


@pytest.mark.thorough
def test_line_search_in_the_helical_valley(lqn: Step) -> None:
    """The problem of three coordinates, every row in units of 1e-8 to 1e8 and axes of its own."""
    (problem,) = (p for p in SMOOTH if p.dim == 3)
    scale, turn = log_uniform(50, 1e-8, 1e8), rotations(50, 3)
    value = placed(problem, scale, turn)
    end = minimise(value, to_world(problem.starts(50), scale, turn), 150, step=lqn)[-1]
    assert float(value(end).max()) < 1e-25 * problem.start_value


BRIEF = ("Rosenbrock", "Powell singular")
REACHED = {  # relative to the start's value: what is left after the line searches below
    "Brown badly scaled": 1e-18,  # f = 1e12 at the start: 1e-18 of it is 1e-6
    "Powell badly scaled": 1e-8,  # the valley's floor is flat to 1e-9
    "Powell singular": 1e-15,  # singular Hessian: linear convergence
}


@pytest.mark.parametrize(
    "problem",
    [p if p.name in BRIEF else pytest.param(p, marks=pytest.mark.thorough) for p in SMOOTH],
    ids=lambda p: p.name,
)
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


@pytest.mark.thorough
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
