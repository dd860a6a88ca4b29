"""LQNAdam on problems of three coordinates, one a row: python examples/lqnadam_quadratics.py

Fifty quadratics in axes of their own, and Rosenbrock's valley from fifty starts. Each optimizer has
the best of six rates. LQNAdam (eq. 17) wins in narrow valleys, given time; on well conditioned
quadratics a tuned Adam is far ahead. Half a minute.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from tqdm import tqdm

from opt3dgs_optim import LQNAdam

RATES = 0.003, 0.01, 0.03, 0.1, 0.3, 1.0
CASES = ((100, 200), (10_000, 200), (10_000, 1_000))  # condition, steps


def quadratic(condition: float) -> Callable[[Tensor], Tensor]:
    """Errors [50] of [50, 3]; the eigenvalues are 1, sqrt(condition), condition."""
    axes, _ = torch.linalg.qr(torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(1)))
    hessians = axes * torch.tensor([1.0, condition**0.5, condition]) @ axes.mT
    return lambda x: torch.einsum("ni,nij,nj->n", x, hessians, x) / 2


def rosenbrock(x: Tensor) -> Tensor:
    """Errors [50] of [50, 2]: a curved valley."""
    return 100 * (x[:, 1] - x[:, 0] ** 2) ** 2 + (1 - x[:, 0]) ** 2


def left(optimizer: torch.optim.Optimizer, x: Tensor, error, steps: int) -> float:
    """The median of what is left of the errors."""
    first = error(x.detach())
    for _ in range(steps):
        optimizer.zero_grad()
        error(x).sum().backward()
        optimizer.step()
    return (error(x.detach()) / first).median().item()


def main() -> int:
    """Print a line for each problem."""
    torch.set_num_threads(1)
    problems = [(f"quadratic, condition {c:,}", quadratic(c), 3, n) for c, n in CASES]
    for name, error, columns, steps in tqdm([*problems, ("Rosenbrock", rosenbrock, 2, 200)]):
        noise = torch.randn(50, columns, generator=torch.Generator().manual_seed(2))
        start, found = torch.tensor([-1.2, 1.0]) + 0.1 * noise if columns == 2 else noise, {}
        for make in (torch.optim.Adam, LQNAdam):
            xs = [(rate, torch.nn.Parameter(start.clone())) for rate in RATES]
            found[make.__name__] = min(left(make([x], lr=r), x, error, steps) for r, x in xs)
        said = ", ".join(f"{key} {value:.1e}" for key, value in found.items())
        tqdm.write(f"{name}, {steps:,} steps: {said}; {min(found, key=found.__getitem__)} wins")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
