"""Stationary laws and escape rates with exact answers: a Gaussian and the double well."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim import AWSGLD, IsotropicNoise
from studies.landscapes.chains import Chains, Dynamics, Samples
from studies.landscapes.energies import (
    GRID,
    exact_rate,
    flattened_potential,
    kl,
    well_potential,
)

Progress = Callable[[int], Any]
Options = dict[str, Any]
CURVATURE, GAUSSIAN_TEMPERATURE = 4.0, 0.5
# The range starts at the minimum: empty partitions below it would pull the chain down. 25: at the
# bottom a narrower partition would be no wider than one step of the noise.
PARTITIONS, WELL_RANGE, CLAMP = 25, (0.0, 12.5), (-5.0, 5.0)
WELL_BINS, WELL_EDGE = 60, 1.8


def gaussian_law(
    arm: str,
    *,
    chains: int,
    seeds: int,
    rates: list[float],
    betas: list[float],
    progress: Progress,
) -> Options:
    """Variance of k x^2 / 2 at temperature T, for each learning rate and seed.

    arm "sgld": the plain drift, with T / (k (1 - lr k / 2)) exactly. arm "adam": Adam's drift and
    the same noise. Adam divides by the gradient's deviation k sigma, so that sigma^2 = T^2,
    whatever k, as long as the first moment is quick and the second slow beside the motion.
    """
    found = []
    for lr in rates:
        relaxation = 1 / (lr * CURVATURE) if arm == "sgld" else GAUSSIAN_TEMPERATURE / lr
        burn = round(10 * relaxation)
        if arm == "adam":  # until the second moment has forgotten the start
            burn += min(round(8 / (1 - betas[1])), 10_000)
        every = max(round(2 * relaxation), 1)
        per_seed = []
        for seed in range(seeds):
            per_seed.append(_variance(arm, lr, betas, chains, seed, burn, every))
            progress(1)
        theory = GAUSSIAN_TEMPERATURE / (CURVATURE * (1 - lr * CURVATURE / 2))
        expected = theory if arm == "sgld" else GAUSSIAN_TEMPERATURE**2
        found.append({"lr": lr, "variance": per_seed, "expected": expected})
    target = GAUSSIAN_TEMPERATURE / CURVATURE
    return {"arm": arm, "target": target, "rows": found}


def _variance(
    arm: str, lr: float, betas: list[float], chains: int, seed: int, burn: int, every: int
) -> float:
    """Mean of x^2 over `chains` rows and 20 times, `every` steps apart, after `burn` steps."""
    x = torch.nn.Parameter(torch.zeros(chains, 1, dtype=torch.float64))
    generator = torch.Generator().manual_seed(seed)
    optimizer = AWSGLD(  # one for all rows: without a histogram they do not meet
        [x],
        lr=lr,
        betas=(betas[0], betas[1]),
        noise=IsotropicNoise(temperature=GAUSSIAN_TEMPERATURE, generator=generator),
        preconditioner="none" if arm == "sgld" else "adam",
    )
    squares = []
    for step in range(burn + 20 * every):
        x.grad = CURVATURE * x.detach()
        optimizer.step()
        if step >= burn and (step - burn) % every == 0:
            squares.append(float(x.detach().square().mean()))
    return sum(squares) / len(squares)


def well_truth(height: float) -> Tensor:
    """[WELL_BINS]: the mass of exp(-U) in each bin of [-1.8, 1.8]; the outer bins are open."""
    density = (-well_potential(height)).exp()
    return _binned(GRID[:, None], density)


def _binned(x: Tensor, weight: Tensor) -> Tensor:
    at = ((x[:, 0] + WELL_EDGE) / (2 * WELL_EDGE) * WELL_BINS).long().clamp(0, WELL_BINS - 1)
    mass = torch.zeros(WELL_BINS, dtype=torch.float64).index_add_(0, at, weight)
    return mass


def well_dynamics(arm: str, lr: float) -> Dynamics:
    """Temperature 1; "awsgld" with the package's default clamp."""
    partitions = PARTITIONS if arm == "awsgld" else 0
    return Dynamics("well", lr, partitions=partitions, energy_range=WELL_RANGE, clamp=CLAMP)


def well_law(
    arm: str,
    *,
    height: float,
    chains: int,
    seeds: int,
    steps: int,
    lr: float,
    progress: Progress,
) -> Options:
    """The law of the double well at temperature 1; every chain starts in the left well.

    A tenth of the steps is dropped. The flat histogram's samples are re-weighted.
    """
    rows = chains * seeds
    raw = torch.zeros(seeds, WELL_BINS, dtype=torch.float64)
    weighted = torch.zeros_like(raw)

    def watch(samples: Samples) -> None:
        counted = samples.steps >= steps // 10
        for seed in range(seeds):
            part = slice(seed * chains, (seed + 1) * chains)
            x = torch.from_numpy(samples.positions[counted, part]).reshape(-1, 1)
            weight = torch.from_numpy(samples.weights[counted, part]).reshape(-1)
            raw[seed] += _binned(x, torch.ones_like(weight))
            weighted[seed] += _binned(x, weight)

    run = Chains(well_dynamics(arm, lr), np.full((rows, 1), -1.0), 0, np.full(rows, height))
    run.run(steps, watch, every=20, progress=progress)
    truth = well_truth(height)
    truth /= truth.sum()
    middle = WELL_BINS // 2
    return {
        "arm": arm,
        "height": height,
        "kl_raw": [kl(row, truth) for row in raw],
        "kl": [kl(row, truth) for row in weighted],
        "left": [float(row[:middle].sum() / row.sum()) for row in weighted],
    }


class Crossings:
    """Passages between the wells: from one minimum all the way to the other one."""

    def __init__(self, chains: int) -> None:
        self._side = -np.ones(chains)
        self.count = np.zeros(chains)

    def __call__(self, samples: Samples) -> None:
        """Take a block of states."""
        for x in samples.positions[:, :, 0]:
            arrived = x * self._side <= -1
            self.count += arrived
            self._side[arrived] *= -1


def escape_rates(
    arm: str,
    *,
    heights: list[float],
    chains: int,
    seeds: int,
    steps: int,
    lr: float,
    progress: Progress,
) -> Options:
    """Passages per unit of time (lr times steps) for each barrier, temperature 1.

    All barriers and seeds are rows of one batch. A tenth of the steps is dropped; half of them
    with a histogram, which has to learn first.
    """
    per_height = chains * seeds
    rows = per_height * len(heights)
    dynamics = well_dynamics(arm, lr)
    run = Chains(dynamics, np.full((rows, 1), -1.0), 7, np.repeat(heights, per_height))
    crossings = Crossings(rows)
    flat = dynamics.partitions > 0
    dropped = steps // 2 if flat else steps // 10
    run.run(dropped, crossings, progress=progress)
    crossings.count[:] = 0
    nu_before = run.nu_sum.copy()
    run.run(steps - dropped, crossings, progress=progress)
    time = chains * (steps - dropped) * lr
    counts = crossings.count.reshape(len(heights), seeds, chains).sum(2)
    nus = (run.nu_sum - nu_before).reshape(len(heights), -1).mean(1) / (steps - dropped)
    found = []
    for i, h in enumerate(heights):
        row: Options = {"height": h, "rate": (counts[i] / time).tolist()}
        row["crossings"] = int(counts[i].sum())
        row["exact"] = exact_rate(well_potential(h))
        if flat:
            potential, _ = flattened_potential(h, PARTITIONS, *WELL_RANGE, dynamics.zeta, CLAMP)
            nu = float(nus[i])
            row |= {"mean_nu": nu, "flattened": exact_rate(potential)}
            row["constant"] = exact_rate(nu * well_potential(h))
        found.append(row)
    return {"arm": arm, "rows": found}
