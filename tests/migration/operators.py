"""Operators that torch dispatches per iteration: `observe` and the steps of six optimizers.

    python tests/migration/operators.py

Six plain fused Adams are 24. An iteration with a fading event costs more: the median over the
iterations is what a run pays, the largest is that of an event.
"""

from __future__ import annotations

import statistics
from typing import Any

import torch
from adapter import Arm, gaussians, make
from torch.utils._python_dispatch import TorchDispatchMode

TOTAL_STEPS, SWITCH = 30_000, 29_000
EXPLORING, EXPLOITING = 5_000, 29_500  # where counting begins; fading is on in the first
FLAVOURS = ("default", "fused")
WARMUP, COUNTED = 10, 60
SUBJECTS = {  # what is shown: (case, first iteration)
    "six Adams": ("torch", EXPLORING),
    "nothing on": ("nothing", EXPLORING),
    "defaults": ("defaults", EXPLORING),
    "histogram": ("histogram", EXPLORING),
    "paper, exploring": ("paper", EXPLORING),
    "paper, exploiting": ("paper", EXPLOITING),
}


class Counter(TorchDispatchMode):
    """Counts every operator."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        self.names.append(str(func))
        return func(*args, **(kwargs or {}))


def iterations(arm: Arm, params: dict[str, Any], first: int, count: int) -> list[list[str]]:
    """Operators of every iteration."""
    generator = torch.Generator().manual_seed(1)
    found = []
    for iteration in range(first, first + count):
        for param in params.values():
            param.grad = 1e-4 * torch.randn(param.shape, generator=generator)
        loss = torch.rand((), generator=generator) * 0.2
        with Counter() as counter:
            arm.observe(loss, iteration=iteration)
            for optimizer in arm.optimizers.values():
                optimizer.step()
        found.append(counter.names)
    return found


def count(case: str, flavour: str, first: int) -> tuple[int, int]:
    """Median and largest number of operators per iteration."""
    params = gaussians(100)
    arm = make(case, params, flavour, TOTAL_STEPS, SWITCH)
    if case == "paper":  # past the warm-up too
        iterations(arm, params, EXPLORING - WARMUP, WARMUP)
    iterations(arm, params, first - WARMUP, WARMUP)
    counts = [len(names) for names in iterations(arm, params, first, COUNTED)]
    return int(statistics.median(counts)), max(counts)


def main() -> None:
    print(f"| {'':<18} | " + " | ".join(f"{f:<11}" for f in FLAVOURS) + " |")
    print(f"|{'-' * 20}|" + f"{'-' * 13}|" * len(FLAVOURS))
    for shown, (case, first) in SUBJECTS.items():
        cells = []
        for flavour in FLAVOURS:
            middle, largest = count(case, flavour, first)
            cells.append(f"{middle} ({largest})")
        print(f"| {shown:<18} | " + " | ".join(f"{cell:<11}" for cell in cells) + " |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
