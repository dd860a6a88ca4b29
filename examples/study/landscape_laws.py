"""Stationary laws and escape rates with exact answers: a Gaussian and the double well."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.noise import IsotropicNoise
from study.landscape_chains import ChainAWSGLD, ChainHistograms, Landscape, run_chains
from study.landscape_energies import (
    GRID,
    double_well,
    exact_rate,
    flattened_potential,
    gaussian,
    kl,
    kramers_rate,
    well_potential,
)

Progress = Callable[[int], Any]
Options = dict[str, Any]
CURVATURE, GAUSSIAN_TEMPERATURE = 4.0, 0.5
PARTITIONS, WELL_RANGE, CLAMP = 100, (-0.5, 12.0), (-5.0, 5.0)
WELL_BINS, WELL_EDGE = 60, 1.8


def chains_at(
    start: Tensor, landscape: Landscape, steps: int, watch: Any, options: Options
) -> ChainAWSGLD:
    """Run AWSGLD from `start` [C, D]; `options` go to it, those named here to the driver."""
    driver = {name: options.pop(name) for name in ("every", "progress") if name in options}
    x = torch.nn.Parameter(start.clone())
    optimizer = ChainAWSGLD([x], skip_nonfinite=False, **options)
    run_chains(optimizer, landscape, steps, watch, **driver)
    return optimizer


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
            burn += min(round(8 / (1 - betas[1])), 20_000)
        every = max(round(2 * relaxation), 1)
        per_seed = []
        for seed in range(seeds):
            sums: list[float] = []

            def watch(step: int, x: Tensor, energy: Tensor, burn: int = burn, sums: Any = sums):
                if step >= burn:
                    sums.append(float(x.square().mean()))

            generator = torch.Generator().manual_seed(seed)
            options: Options = {
                "lr": lr,
                "betas": tuple(betas),
                "noise": IsotropicNoise(temperature=GAUSSIAN_TEMPERATURE, generator=generator),
                "preconditioner": "none" if arm == "sgld" else "adam",
                "every": every,
            }
            start = torch.zeros(chains, 1, dtype=torch.float64)
            chains_at(start, gaussian(CURVATURE), burn + 20 * every, watch, options)
            per_seed.append(sum(sums) / len(sums))
            progress(1)
        theory = GAUSSIAN_TEMPERATURE / (CURVATURE * (1 - lr * CURVATURE / 2))
        expected = theory if arm == "sgld" else GAUSSIAN_TEMPERATURE**2
        found.append({"lr": lr, "variance": per_seed, "expected": expected})
    target = GAUSSIAN_TEMPERATURE / CURVATURE
    return {"arm": arm, "target": target, "rows": found}


def well_truth(height: float) -> Tensor:
    """[WELL_BINS]: the mass of exp(-U) in each bin of [-1.8, 1.8]; the outer bins are open."""
    density = (-well_potential(height)).exp()
    return _binned(GRID[:, None], density)


def _binned(x: Tensor, weight: Tensor) -> Tensor:
    at = ((x[:, 0] + WELL_EDGE) / (2 * WELL_EDGE) * WELL_BINS).long().clamp(0, WELL_BINS - 1)
    mass = torch.zeros(WELL_BINS, dtype=torch.float64).index_add_(0, at, weight)
    return mass


def histograms(chains: int) -> ChainHistograms:
    """The flat histogram of the double wells: temperature 1, the package's default clamp."""
    return ChainHistograms(chains, PARTITIONS, WELL_RANGE, temperature=1.0, warmup=0, clamp=CLAMP)


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

    A tenth of the steps is dropped. The flat histogram's samples are weighed by theta_J^zeta.
    """
    generator = torch.Generator().manual_seed(round(height))
    rows = chains * seeds
    flat = histograms(rows) if arm == "awsgld" else None
    raw = torch.zeros(seeds, WELL_BINS, dtype=torch.float64)
    weighted = torch.zeros_like(raw)

    def watch(step: int, x: Tensor, energy: Tensor) -> None:
        if step < steps // 10:
            return
        weight = flat.importance(energy) if flat is not None else torch.ones_like(energy)
        for seed in range(seeds):
            part = slice(seed * chains, (seed + 1) * chains)
            raw[seed] += _binned(x[part], torch.ones_like(weight[part]))
            weighted[seed] += _binned(x[part], weight[part])

    options: Options = {
        "lr": lr,
        "noise": IsotropicNoise(temperature=1.0, generator=generator),
        "preconditioner": "none",
        "histogram": flat,
        "every": 20,
        "progress": progress,
    }
    start = torch.full((rows, 1), -1.0, dtype=torch.float64)
    chains_at(start, double_well(height), steps, watch, options)
    truth = well_truth(height)
    truth /= truth.sum()
    middle = WELL_BINS // 2
    return {
        "arm": arm,
        "height": height,
        "truth": truth.tolist(),
        "raw": (raw.sum(0) / raw.sum()).tolist(),
        "weighted": (weighted.sum(0) / weighted.sum()).tolist(),
        "kl_raw": [kl(row, truth) for row in raw],
        "kl": [kl(row, truth) for row in weighted],
        "left": [float(row[:middle].sum() / row.sum()) for row in weighted],
    }


class Crossings:
    """Passages between the wells: from one minimum all the way to the other one."""

    def __init__(self, chains: int, after: int) -> None:
        self._side = -torch.ones(chains, dtype=torch.float64)
        self._after = after
        self.count = torch.zeros(chains, dtype=torch.float64)

    def __call__(self, step: int, x: Tensor, energy: Tensor) -> None:
        """Take the positions before step `step`."""
        arrived = x[:, 0] * self._side <= -1
        if step >= self._after:
            self.count += arrived
        self._side = torch.where(arrived, -self._side, self._side)


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
    generator = torch.Generator().manual_seed(7)
    per_height = chains * seeds
    rows = per_height * len(heights)
    height = torch.tensor(heights, dtype=torch.float64).repeat_interleave(per_height)
    flat = histograms(rows) if arm == "awsgld" else None
    after = steps // 2 if flat is not None else steps // 10
    crossings = Crossings(rows, after)
    nu_sum = torch.zeros(rows, dtype=torch.float64)

    def watch(step: int, x: Tensor, energy: Tensor) -> None:
        crossings(step, x, energy)
        if flat is not None and step > after:
            nu_sum.add_(flat.multiplier)

    options: Options = {
        "lr": lr,
        "noise": IsotropicNoise(temperature=1.0, generator=generator),
        "preconditioner": "none",
        "histogram": flat,
        "progress": progress,
    }
    start = torch.full((rows, 1), -1.0, dtype=torch.float64)
    chains_at(start, double_well(height), steps, watch, options)
    time = chains * (steps - after) * lr
    counts = crossings.count.reshape(len(heights), seeds, chains).sum(2)
    nus = nu_sum.reshape(len(heights), -1).mean(1) / max(steps - after - 1, 1)
    found = []
    for i, h in enumerate(heights):
        row: Options = {"height": h, "rate": (counts[i] / time).tolist()}
        row |= {"crossings": int(counts[i].sum()), "kramers": kramers_rate(h)}
        row["exact"] = exact_rate(well_potential(h))
        if flat is not None:
            potential, _ = flattened_potential(h, PARTITIONS, *WELL_RANGE, flat.zeta, CLAMP)
            nu = float(nus[i])
            row |= {"mean_nu": nu, "flattened": exact_rate(potential)}
            row["constant"] = exact_rate(nu * well_potential(h))
        found.append(row)
    return {"arm": arm, "rows": found}
