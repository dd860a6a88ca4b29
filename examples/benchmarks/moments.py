"""Adam's moments in 32, 16 and 8 bits: what rounding does in long runs.

    python examples/benchmarks/moments.py            (some five minutes)

Prints the table of docs/performance.md. 8 bits is no option of the package; it is simulated here,
in the form that others use, to say why: (m / sqrt v, log sqrt v), rounded by chance.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from splatting.stopping import command
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam
from tqdm import tqdm

from opt3dgs_optim import PhaseScheduler

STEPS = 100_000
NOISE = 1e-3  # of the gradients of the first problem
BETAS = (0.9, 0.999)
DEEPEST = -40.0  # log2 of the smallest sqrt v that eight bits hold; the largest is 1
Gradient = Callable[[Tensor, torch.Generator], Tensor]


class EightBits(Adam):
    """torch's Adam, whose moments are rounded by chance to 8 bits each after a step."""

    def __init__(self, params: Sequence[Parameter], **options: Any) -> None:
        super().__init__(params, **options)
        self._draw = torch.Generator().manual_seed(1)

    def step(self, closure: None = None) -> None:
        """A step of Adam, then the rounding."""
        super().step(closure)
        for state in self.state.values():
            first, second = state["exp_avg"], state["exp_avg_sq"]
            ratio = first / second.sqrt().clamp(min=1e-30)  # at most sqrt(1000 / 10) by Cauchy
            size = second.sqrt().log2().div(DEEPEST).clamp(0, 1)
            root = (self._rounded(size, 255) * DEEPEST).exp2()
            limit = (1 - BETAS[0]) / math.sqrt((1 - BETAS[1]) * (1 - BETAS[0] ** 2 / BETAS[1]))
            ratio = self._rounded((ratio / limit).clamp(-1, 1), 127) * limit
            second.copy_(torch.where(second > 0, root.square(), 0.0))
            first.copy_(torch.where(second > 0, ratio * root, 0.0))

    def _rounded(self, number: Tensor, most: int) -> Tensor:
        return torch.floor(number * most + torch.rand(number.shape, generator=self._draw)) / most


def optimizer_of(param: Parameter, bits: int, lr: float, steps: int) -> Adam:
    """Adam of moments of so many bits."""
    if bits == 8:
        return EightBits([param], lr=lr, betas=BETAS, eps=1e-15)
    adam = Adam([{"params": [param], "name": "quats", "lr": lr}], betas=BETAS, eps=1e-15)
    PhaseScheduler(steps, parts=[], moments=16 if bits == 16 else 32).upgrade(adam)
    return adam


def run(
    start: Tensor, gradient: Gradient, bits: int, lr: float, steps: int, look: Callable[..., None]
) -> None:
    """Steps of Adam; from half of them on `look` sees parameter and optimizer after each."""
    param, draw = Parameter(start.clone()), torch.Generator().manual_seed(0)
    adam = optimizer_of(param, bits, lr, steps)
    for i in tqdm(range(steps), desc=f"{gradient.__name__}, {bits} bits", leave=False):
        param.grad = gradient(param.detach(), draw)
        adam.step()
        if i >= steps // 2:
            look(param.detach(), adam)


def noise(x: Tensor, draw: torch.Generator) -> Tensor:
    """Nothing but noise."""
    return NOISE * torch.randn(x.shape, generator=draw)


def noisy_quadratic(x: Tensor, draw: torch.Generator) -> Tensor:
    """Curvatures of 1 to 10,000, and noise in proportion to their roots."""
    curvature = torch.logspace(0, 4, x.shape[1])
    return curvature * x + curvature.sqrt() * torch.randn(x.shape, generator=draw)


def quadratic(x: Tensor, draw: torch.Generator) -> Tensor:
    """Curvatures of 1 to 100, no noise."""
    return torch.logspace(0, 2, x.shape[1]) * x


def double_well(x: Tensor, draw: torch.Generator) -> Tensor:
    """Of (x^2 - 1)^2, with noise that crosses."""
    return 4 * x * (x * x - 1) + 8 * torch.randn(x.shape, generator=draw)


def measure(bits: int, steps: int) -> list[str]:
    """The rows of a column of the table."""
    seen: dict[str, list[float]] = {}

    def note(**numbers: Tensor) -> None:
        for name, number in numbers.items():
            seen.setdefault(name, []).append(float(number))

    def of_noise(x: Tensor, adam: Adam) -> None:
        state = next(iter(adam.state.values()))
        second = next(iter(adam.state_dict()["state"].values()))["exp_avg_sq"]
        if int(state["step"]) % 100 == 0:
            note(second=second.mean() / NOISE**2, drift=(x - quats).mean())

    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(500, 1)
    run(quats, noise, bits, 1e-3, steps, of_noise)
    rows = torch.ones(100, 8)
    curvature = torch.logspace(0, 4, 8)
    run(rows, noisy_quadratic, bits, 0.01, steps, lambda x, _: note(
        noisy=(curvature * x * x).sum(1).mean() / 2))  # fmt: skip
    run(rows, quadratic, bits, 0.01, steps // 200, lambda x, _: note(
        deep=(torch.logspace(0, 2, 8) * x * x).sum(1).mean() / 2))  # fmt: skip
    run(torch.ones(1000, 1), double_well, bits, 0.05, steps, lambda x, _: note(
        right=(x > 0).float().mean()))  # fmt: skip
    means = {name: sum(each) / len(each) for name, each in seen.items()}
    return [
        f"{means['second']:.5f}", f"{seen['drift'][-1]:+.5f}", f"{means['noisy']:.3f}",
        f"{seen['deep'][-1]:.1e}", f"{means['right']:.3f}",
    ]  # fmt: skip


@command("moments")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line, without options."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args(arguments)
    torch.set_num_threads(1)
    columns = [measure(bits, STEPS) for bits in (32, 16, 8)]
    names = (
        "mean second moment over the true one, noise on quaternions, 100,000 steps",
        "mean drift of the quaternions there, with a rate of 0.001",
        "mean energy, quadratic of condition 10,000 with noise, 100,000 steps",
        "energy, quadratic of condition 100 without noise, 500 steps",
        "double well with noise, share of the time in the right well, 100,000 steps",
    )
    print("|  | 32 bits | 16 bits | 8 bits, simulated |\n|---|---:|---:|---:|")
    for name, *row in zip(names, *columns, strict=True):
        print(f"| {name} | {' | '.join(row)} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
