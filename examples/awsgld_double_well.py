"""AWSGLD crosses a barrier that SGLD does not: python examples/awsgld_double_well.py

A walk in the double well 6 (x^2 - 1)^2 at temperature 1, begun at x = 1. Its law gives each well
half of the time, and the exact rate of crossings is one in 13,400 of these steps. The flat
histogram (eqs. 14 to 16) makes the barrier low. So does a constant multiplier of the same mean, if
somebody guesses it; the histogram finds its own. The histogram for trainings, whose range follows
the walk, crosses seldom. Twenty seconds.
"""

from __future__ import annotations

import torch
from tqdm import tqdm

from opt3dgs_optim import AWSGLD, EnergyHistogram, IsotropicNoise

HEIGHT, RATE, STEPS = 6.0, 6e-3, 10_000


def walk(histogram: EnergyHistogram | None, factor: float = 1.0) -> tuple[int, float, float]:
    """How often it reached the other well, the share of the time left of 0, the mean of nu."""
    torch.manual_seed(1)
    x = torch.nn.Parameter(torch.ones(1))
    noise = IsotropicNoise(temperature=1.0)
    sampler = AWSGLD([x], RATE, histogram=histogram, noise=noise, preconditioner="none")
    well, crossings, left, multipliers = 1.0, 0, 0, 0.0
    for _ in tqdm(range(STEPS), leave=False, disable=None):
        sampler.zero_grad()
        energy = HEIGHT * ((x**2 - 1) ** 2).sum()
        (factor * energy).backward()
        multipliers += factor if histogram is None else float(histogram.observe(energy))
        sampler.step()
        left += x.item() < 0
        if x.item() * well < -0.5:
            well, crossings = -well, crossings + 1
    return crossings, left / STEPS, multipliers / STEPS


def main() -> int:
    """Print a line for each sampler."""
    torch.set_num_threads(1)
    histogram = EnergyHistogram(energy_range=(0.0, 8.0), temperature=1.0, warmup=0)
    found = {"SGLD": walk(None), "AWSGLD": walk(histogram)}
    found["AWSGLD, default range"] = walk(EnergyHistogram())
    mean = found["AWSGLD"][2]
    found[f"SGLD, gradient times {mean:.2f}"] = walk(None, mean)
    print(f"{STEPS:,} steps of {RATE}:")
    for name, (crossings, left, nu) in found.items():
        print(f"  {name:24} {crossings:3} crossings, {left:4.0%} left of 0, mean nu {nu:.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
