"""What an iteration's steps cost on a CPU, in those of six plain Adams.

    python tests/migration/bench.py [--points 1000 10000 100000] [--rounds 41] [--flavour default]

`observe` and six steps, in CPU time of the one thread, which does not count what other processes
take. Every round times each subject once, in turn, so that a busy machine slows all of them alike;
the ratios are medians (and quartiles) over the rounds.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from adapter import FLAVOURS, gaussians, make
from operators import EXPLOITING, EXPLORING, SWITCH, TOTAL_STEPS

SUBJECTS = {  # (case, first iteration); the first is what the others are compared with
    "six Adams": ("torch", EXPLORING),
    "nothing on": ("nothing", EXPLORING),
    "defaults": ("defaults", EXPLORING),
    "paper, exploring": ("paper", EXPLORING),
    "paper, exploiting": ("paper", EXPLOITING),
}
WARMUP = 8  # with exploitation: a history full of pairs


def subject(case: str, first: int, points: int, flavour: str) -> Callable[[], Any]:
    """One iteration's observe and steps, with gradients that change."""
    params = gaussians(points)
    arm = make(case, params, flavour, TOTAL_STEPS, SWITCH)
    gradients = [
        {name: 1e-4 * torch.randn_like(param) for name, param in params.items()} for _ in range(3)
    ]
    loss, iteration = torch.tensor(0.1), first

    def call() -> float:
        nonlocal iteration
        iteration += 1
        for name, param in params.items():
            param.grad = gradients[iteration % 3][name]
        begin = time.thread_time()
        arm.observe(loss, iteration=iteration)
        for optimizer in arm.optimizers.values():
            optimizer.step()
        return time.thread_time() - begin

    return call


def ratios(points: int, rounds: int, flavour: str) -> dict[str, list[float]]:
    """Seconds in those of six Adams, one of every round."""
    calls = {
        shown: subject(case, first, points, flavour) for shown, (case, first) in SUBJECTS.items()
    }
    for call in calls.values():
        for _ in range(WARMUP):
            call()
    seconds = [{shown: call() for shown, call in calls.items()} for _ in range(rounds)]
    base = next(iter(SUBJECTS))
    return {shown: [each[shown] / each[base] for each in seconds] for shown in SUBJECTS}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    parser.add_argument("--rounds", type=int, default=41)
    parser.add_argument("--flavour", choices=tuple(FLAVOURS), default="default")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    results = {n: ratios(n, options.rounds, options.flavour) for n in options.points}
    heads = [f"{n:,} points" for n in options.points]
    print(f"| {options.flavour:<18} | " + " | ".join(f"{head:<20}" for head in heads) + " |")
    print(f"|{'-' * 20}|" + f"{'-' * 22}|" * len(heads))
    for shown in list(SUBJECTS)[1:]:
        cells = []
        for result in results.values():
            low, middle, high = statistics.quantiles(result[shown], n=4, method="inclusive")
            cells.append(f"{middle:.2f} ({low:.2f}..{high:.2f})")
        print(f"| {shown:<18} | " + " | ".join(f"{cell:<20}" for cell in cells) + " |")


if __name__ == "__main__":
    main()
