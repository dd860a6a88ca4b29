"""Stiff problems through one step of the curvature, by pure torch and by the CUDA kernel's source.

The kernel is compiled for the host by g++; without it, its half of these tests is skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from kernel_host import compiler, host_kernels
from line_search import minimise
from oracles import dense_bfgs
from problems import SMOOTH, hessians, log_uniform, placed, quadratic, rotations, to_world
from torch import Tensor

from opt3dgs_optim.lbfgs import lqn_direction, new_history
from opt3dgs_optim.lbfgs.history import header

pytestmark = pytest.mark.compiles

ROWS, SIZE = 2_000, 5
CONDITIONS = (1.0, 1e3, 1e6, 1e12)
GRADIENTS = (1e-44, 1e-38, 1e-30, 1e-10, 1.0, 1e10, 1e30, 3e37)
STEPS = (1e-30, 1e-12, 1e-6, 1.0, 1e6, 1e20)
OPTIONS = {"min_cosine": 1e-14}
Step = Callable[..., tuple[Tensor, Tensor, Tensor]]  # as `lqn_direction`

needs_compiler = pytest.mark.skipif(compiler() is None, reason="g++ is not installed")
BACKENDS = ["torch", pytest.param("kernel", marks=needs_compiler, id="kernel on the host")]


def host_step() -> Step:
    """`lqn_direction` by the compiled source, for a history in either layout."""

    def run(x: Tensor, g: Tensor, history: Tensor, size: int, **options: Any) -> Any:
        assert size == SIZE
        cells = history.contiguous()
        found = host_kernels(SIZE, g.dtype).lqn(x, g, cells, **options)
        history.copy_(cells)
        return found

    return run


@pytest.fixture(params=BACKENDS)
def lqn(request: pytest.FixtureRequest) -> Step:
    """`lqn_direction` by either backend."""
    return lqn_direction if request.param == "torch" else host_step()


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
    """Positions in units 1e-8 .. 1e8, losses times 1e-12 .. 1e12, each row its own.

    Powers of two: the inputs have the same digits, and so must the outputs.
    """
    length = log_uniform(ROWS, 1e-8, 1e8, seed=1).log2().round().exp2()[:, None]
    loss = log_uniform(ROWS, 1e-12, 1e12, seed=2).log2().round().exp2()[:, None]
    hessian, x, slope = hessians(ROWS, condition), walk(ROWS), loss / length
    plain, _, accepted, _ = fed(lqn, hessian, x, graft=graft)
    there = fed(lqn, hessian / length[:, :, None], x * length, slope, graft=graft)
    assert torch.equal(there[2], accepted)
    assert bool(accepted.any())
    assert torch.equal(there[0], plain * (slope if graft else length))


@pytest.mark.parametrize("condition", CONDITIONS)
def test_axes_change_nothing_but_the_axes(lqn: Step, condition: float) -> None:
    hessian, x, turn = hessians(ROWS, condition), walk(ROWS), rotations(ROWS, 3, seed=3)
    plain = fed(lqn, hessian, x, graft=False)
    turned = fed(lqn, turn @ hessian @ turn.mT, torch.einsum("nij,knj->kni", turn, x), graft=False)
    expected = torch.einsum("nij,nj->ni", turn, plain[0])
    error = (turned[0] - expected).norm(dim=1) / expected.norm(dim=1)
    # Rounding of H x is relative to its largest part, condition times its smallest; and a pair with
    # an angle of cosine c loses 1/c of the digits in s.y, of five pairs.
    s = x.diff(dim=0)
    y = torch.einsum("nij,knj->kni", hessian, s)
    cosine = (s * y).sum(2) / (s.norm(dim=2) * y.norm(dim=2))
    bound = 1000 * torch.finfo(torch.float64).eps / cosine.amin(0).clamp(min=1e-30) ** 2
    same = plain[2] == turned[2]  # an acceptance within rounding of the bound may differ
    assert float(same.double().mean()) > 0.99
    assert bool((error <= bound)[same].all())


@pytest.mark.parametrize("condition", CONDITIONS)
def test_equals_the_dense_recursion(lqn: Step, condition: float) -> None:
    rows = 40
    hessian, x = hessians(rows, condition), walk(rows)
    found, g, _, _ = fed(lqn, hessian, x, graft=False)
    s = x.diff(dim=0).numpy()
    y = torch.einsum("nij,knj->kni", hessian, x).diff(dim=0).numpy()
    for row in range(rows):
        matrix = torch.from_numpy(dense_bfgs(s[:, row], y[:, row]))
        worst = min(
            float(abs(a @ b) / math.sqrt((a @ a) * (b @ b)))
            for a, b in zip(s[:, row], y[:, row], strict=True)
        )
        # 2 K updates in float64, each of which can amplify rounding by |V|^2 ~ |y|^2 / s.y
        slack = 1e-13 / worst**2 * float(matrix.abs().max() * g[row].abs().max())
        assert float((found[row] - matrix @ g[row]).abs().max()) <= slack


@pytest.mark.parametrize("size", GRADIENTS)
@pytest.mark.parametrize("length", STEPS)
def test_no_intermediate_leaves_float32(lqn: Step, size: float, length: float) -> None:
    """Gradients from 1e-44 (denormal) to 3e37, steps from 1e-30 to 1e20: finite, never zero."""
    rows, slope = 300, size / 100  # |H x| is up to 100
    hessian, x = hessians(rows, 30.0), walk(rows)
    single = {"dtype": torch.float32}
    found, g, accepted, history = fed(
        lqn, hessian, x * length, slope / length, graft=True, **single
    )
    raw = fed(lqn, hessian, x * length, slope / length, graft=False, **single)[0]
    assert bool(torch.isfinite(found).all())
    assert bool(torch.isfinite(raw).all())
    assert bool((found != 0).any(1)[(g != 0).any(1)].all())
    assert bool(torch.isfinite(header(history, SIZE).counter).all())
    # Per unit of gradient: s / |y|, which is what is stored, and its square.
    if slope >= 1e-36 and 1e-30 <= length / slope <= 1e30:
        assert bool(accepted.all())
        expected = fed(lqn, hessian, x, graft=True)[0]
        unit = found.double() / found.double().norm(dim=1, keepdim=True)
        expected = expected / expected.norm(dim=1, keepdim=True)
        # rounding of positions and gradients, over pairs with cosines of 0.3 and more
        assert float((unit - expected).norm(dim=1).max()) < 1e-4


# -- convergence ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("condition", "left"), [(1.0, 1e-12), (1e3, 1e-10), (1e6, 1e-6), (1e12, 1.0)]
)
def test_line_search_on_quadratics(lqn: Step, condition: float, left: float) -> None:
    hessian = hessians(500, condition)
    start = torch.ones(500, 3, dtype=torch.float64)
    end = minimise(quadratic(hessian), start, 60, step=lqn)[-1]
    assert float(end.norm(dim=1).median()) < left
    # rounding of H x (1e-16 times the condition) is the gradient that is left along the flat axis
    assert float(quadratic(hessian)(end).max()) < 1e-11 * condition


def test_line_search_in_the_helical_valley(lqn: Step) -> None:
    """The problem of three coordinates, every row in units of 1e-8 to 1e8 and axes of its own."""
    (problem,) = (p for p in SMOOTH if p.dim == 3)
    scale, turn = log_uniform(50, 1e-8, 1e8), rotations(50, 3)
    value = placed(problem, scale, turn)
    end = minimise(value, to_world(problem.starts(50), scale, turn), 150, step=lqn)[-1]
    assert float(value(end).max()) < 1e-25 * problem.start_value
