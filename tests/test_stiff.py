"""Stiff problems: all scales, axes and conditions at once, damaged rows, the range of float32.

Every batch has rows that differ by orders of magnitude, as Gaussians of one scene do. The curvature
goes through pure torch and through the CUDA kernel's source, which g++ compiles for the host.
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
from problems import (
    SMOOTH,
    Problem,
    gradient,
    hessians,
    log_uniform,
    placed,
    quadratic,
    rotations,
    to_world,
)
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam
from opt3dgs_optim.lbfgs import lqn_direction, new_history

# -- AWSGLD and LQNAdam ----------------------------------------------------------------------------

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


# -- the two-loop recursion ------------------------------------------------------------------------

SIZE = 5
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
    rows = 10_000
    length = log_uniform(rows, 1e-8, 1e8, seed=1).log2().round().exp2()[:, None]
    loss = (log_uniform(rows, 1e-12, 1e12, seed=2).log2() / 2).round().mul(2).exp2()[:, None]
    hessian, x, slope = hessians(rows, condition), walk(rows), loss / length
    plain, _, accepted, _ = fed(lqn, hessian, x, graft=graft)
    there = fed(lqn, hessian / length[:, :, None], x * length, slope, graft=graft)
    assert torch.equal(there[2], accepted)
    assert bool(accepted.any())
    assert torch.equal(there[0], plain * (slope if graft else length))


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
    assert bool((history[:, 3, 3] == (g != 0).any(1) * len(x)).all()) or size < 1e-40  # steps
    # Per unit of gradient: |s| / |y|, whose root is in what is stored. Outside of 1e-30 .. 1e30
    # float32 has no room for it.
    if slope >= 1e-36 and 1e-30 <= step / slope <= 1e30:
        assert bool(accepted.all())
        gamma = history[:, 0, 4:7].square().sum(1).reciprocal()  # of the newest pair
        assert bool(((gamma > 0) & torch.isfinite(gamma)).all())
        expected = fed(lqn, hessian, x, graft=True)[0]
        expected = expected / expected.norm(dim=1, keepdim=True)
        unit = found.double() / found.double().norm(dim=1, keepdim=True)
        # rounding of positions and gradients, over pairs with cosines of 0.3 and more
        assert float((unit - expected).norm(dim=1).max()) < 1e-4


# -- with a line search ----------------------------------------------------------------------------

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
    "rows", [50, pytest.param(10_000, marks=pytest.mark.thorough, id="ten thousand")]
)
def test_two_loop_with_a_line_search_reaches_the_minimum(problem: Problem, rows: int) -> None:
    """Every row, in units of 1e-8 to 1e8 and in axes of its own."""
    scale, turn = log_uniform(rows, 1e-8, 1e8), rotations(rows, problem.dim)
    value = placed(problem, scale, turn)
    start = to_world(problem.starts(rows), scale, turn)
    end = minimise(value, start, 150)
    bound = REACHED.get(problem.name, 1e-25)
    assert float(value(end).max()) < bound * problem.start_value
    if problem.name in ("Rosenbrock", "Beale", "Helical valley", "Wood"):
        minimum = to_world(problem.minima(rows), scale, turn)
        error = (end - minimum).norm(dim=1) / minimum.norm(dim=1)
        # f is flat to its rounding: half of the digits, less those of the condition (2,500)
        assert float(error.max()) < 1e-7
