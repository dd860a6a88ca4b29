"""Stiff and multi-modal test problems with known answers, as batches of independent rows.

Moré, Garbow and Hillstrom (1981), "Testing unconstrained optimization software"; the others are
named at the function. Every function maps [N, D] to [N]; nothing of the package is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Problem:
    """A function of D coordinates with its customary start and its global minimum."""

    name: str
    value: Callable[[Tensor], Tensor]  # [N, D] -> [N]
    start: tuple[float, ...]
    start_value: float
    minimum: tuple[float, ...]

    @property
    def dim(self) -> int:
        return len(self.start)

    def starts(self, rows: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """[rows, D] copies of the start."""
        return torch.tensor(self.start, dtype=dtype).repeat(rows, 1)

    def minima(self, rows: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """[rows, D] copies of the minimum."""
        return torch.tensor(self.minimum, dtype=dtype).repeat(rows, 1)


def gradient(value: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Gradient of each row's value in that row."""
    leaf = x.detach().clone().requires_grad_()
    with torch.enable_grad():
        (found,) = torch.autograd.grad(value(leaf).sum(), leaf)
    return found


def rosenbrock(x: Tensor) -> Tensor:
    a, b = x.unbind(1)
    return 100 * (b - a**2) ** 2 + (1 - a) ** 2


def beale(x: Tensor) -> Tensor:
    a, b = x.unbind(1)
    terms = [(c - a * (1 - b**k)) ** 2 for k, c in ((1, 1.5), (2, 2.25), (3, 2.625))]
    return terms[0] + terms[1] + terms[2]


def brown_badly_scaled(x: Tensor) -> Tensor:
    a, b = x.unbind(1)
    return (a - 1e6) ** 2 + (b - 2e-6) ** 2 + (a * b - 2) ** 2


def powell_badly_scaled(x: Tensor) -> Tensor:
    a, b = x.unbind(1)
    return (1e4 * a * b - 1) ** 2 + ((-a).exp() + (-b).exp() - 1.0001) ** 2


def helical_valley(x: Tensor) -> Tensor:
    a, b, c = x.unbind(1)
    theta = (b / a).atan() / (2 * math.pi) + torch.where(a < 0, 0.5, 0.0)
    return 100 * ((c - 10 * theta) ** 2 + ((a**2 + b**2).sqrt() - 1) ** 2) + c**2


def powell_singular(x: Tensor) -> Tensor:
    a, b, c, d = x.unbind(1)
    return (a + 10 * b) ** 2 + 5 * (c - d) ** 2 + (b - 2 * c) ** 4 + 10 * (a - d) ** 4


def wood(x: Tensor) -> Tensor:
    a, b, c, d = x.unbind(1)
    valleys = 100 * (b - a**2) ** 2 + (1 - a) ** 2 + 90 * (d - c**2) ** 2 + (1 - c) ** 2
    return valleys + 10 * (b + d - 2) ** 2 + 0.1 * (b - d) ** 2


def double_well(x: Tensor, barrier: float = 1.0) -> Tensor:
    return barrier * (x[:, 0] ** 2 - 1) ** 2


def kramers_rate(barrier: float, temperature: float) -> float:
    """Kramers (1940): escapes per unit of time from a well of `double_well`, overdamped."""
    return math.sqrt(8 * 4) * barrier / (2 * math.pi) * math.exp(-barrier / temperature)


def nine_modes(x: Tensor) -> Tensor:
    """The landscape of CSGLD (Deng, Lin and Liang 2020), on [-2.5, 2.5]^2."""
    square = (x**2).sum(1)
    waves = (1.2 * math.pi * x).cos().sum(1)
    return (square / 10 - waves) / 0.3 + (square - 7).clamp(min=0)


SMOOTH = (  # one valley each: a quasi-Newton method with a line search gets to the minimum
    Problem("Rosenbrock", rosenbrock, (-1.2, 1.0), 24.2, (1.0, 1.0)),
    Problem("Beale", beale, (1.0, 1.0), 14.203125, (3.0, 0.5)),
    Problem("Brown badly scaled", brown_badly_scaled, (1.0, 1.0), 999998000003.0, (1e6, 2e-6)),
    Problem(
        "Powell badly scaled",
        powell_badly_scaled,
        (0.0, 1.0),
        1.135261717,
        (1.0981593296997e-5, 9.106146739866),
    ),
    Problem("Helical valley", helical_valley, (-1.0, 0.0, 0.0), 2500.0, (1.0, 0.0, 0.0)),
    Problem("Powell singular", powell_singular, (3.0, -1.0, 0.0, 1.0), 215.0, (0.0,) * 4),
    Problem("Wood", wood, (-3.0, -1.0, -3.0, -1.0), 19192.0, (1.0,) * 4),
)


def rotations(rows: int, dim: int, seed: int = 0) -> Tensor:
    """[rows, dim, dim] random orthogonal matrices, float64."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(rows, dim, dim, generator=generator, dtype=torch.float64)
    return torch.linalg.qr(normal).Q


def log_uniform(rows: int, low: float, high: float, seed: int = 0) -> Tensor:
    """[rows] float64 between `low` and `high`, uniform in the exponent."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(rows, generator=generator, dtype=torch.float64)
    return low * (high / low) ** share


def placed(problem: Problem, scale: Tensor, rotation: Tensor) -> Callable[[Tensor], Tensor]:
    """The problem in every row's own units and axes: f(R^T x / scale).

    Args:
        problem: the function f.
        scale: [N].
        rotation: [N, D, D].
    """

    def value(x: Tensor) -> Tensor:
        local = torch.einsum("nij,ni->nj", rotation.to(x.dtype), x / scale[:, None].to(x.dtype))
        return problem.value(local)

    return value


def to_world(x: Tensor, scale: Tensor, rotation: Tensor) -> Tensor:
    """Points of the problem's own units and axes in those of `placed`."""
    return torch.einsum("nij,nj->ni", rotation, x) * scale[:, None]


def hessians(rows: int, condition: float, dim: int = 3, seed: int = 0) -> Tensor:
    """[rows, dim, dim] with eigenvalues 1 .. condition, each row in axes of its own."""
    axes = rotations(rows, dim, seed)
    exponents = torch.linspace(0, 1, dim, dtype=torch.float64)
    return axes @ torch.diag(condition**exponents) @ axes.mT


def quadratic(hessian: Tensor) -> Callable[[Tensor], Tensor]:
    """x.H x / 2 of every row; hessian is [N, D, D]."""
    return lambda x: 0.5 * torch.einsum("ni,nij,nj->n", x, hessian.to(x.dtype), x)
