"""LQNAdam on problems of three coordinates, one a row: python examples/lqnadam_quadratics.py

Fifty quadratics, each in axes of its own, and fifty starts in Rosenbrock's valley. Each optimizer
has the best of six learning rates. LQNAdam (eq. 17) wins in narrow valleys, given time; on well
conditioned quadratics Adam with a tuned rate is far ahead. A minute.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from tqdm import tqdm

from opt3dgs_optim import LQNAdam

RATES = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
OPTIMIZERS = {"Adam": torch.optim.Adam, "LQNAdam": LQNAdam}


def quadratic(condition: float) -> Callable[[Tensor], Tensor]:
    """Errors [50] of [50, 3]; the eigenvalues are 1, sqrt(condition), condition."""
    draws = torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(1))
    axes, _ = torch.linalg.qr(draws)
    hessians = axes * torch.tensor([1.0, condition**0.5, condition]) @ axes.mT
    return lambda x: torch.einsum("ni,nij,nj->n", x, hessians, x) / 2


def rosenbrock(x: Tensor) -> Tensor:
    """Errors [50] of [50, 2]: a curved valley."""
    return 100 * (x[:, 1] - x[:, 0] ** 2) ** 2 + (1 - x[:, 0]) ** 2


def best(optimizer: Callable[..., torch.optim.Optimizer], error, columns: int, steps: int) -> float:
    """The median of what is left of the error, with the best rate."""
    noise = torch.randn(50, columns, generator=torch.Generator().manual_seed(2))
    start, left = (torch.tensor([-1.2, 1.0]) + 0.1 * noise if columns == 2 else noise), []
    for rate in RATES:
        x = torch.nn.Parameter(start.clone())
        stepped = optimizer([x], lr=rate)
        for _ in range(steps):
            stepped.zero_grad()
            error(x).sum().backward()
            stepped.step()
        left.append((error(x.detach()) / error(start)).median().item())
    return min(left)


def main() -> int:
    """Print a line for each problem."""
    torch.set_num_threads(1)
    problems = [(f"quadratic, condition {c:,}", quadratic(c), 3, n) for c, n in CASES]
    for name, error, columns, steps in tqdm([*problems, ("Rosenbrock", rosenbrock, 2, 200)]):
        found = {key: best(make, error, columns, steps) for key, make in OPTIMIZERS.items()}
        said = ", ".join(f"{key} {value:.1e}" for key, value in found.items())
        tqdm.write(f"{name}, {steps:,} steps: {said}; {min(found, key=found.__getitem__)} wins")
    return 0


CASES = ((100, 200), (10_000, 200), (10_000, 1_000))
if __name__ == "__main__":
    raise SystemExit(main())
