"""The nine-mode landscape: which arm finds how many wells, how soon, and in the right shares."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim import AWSGLD
from opt3dgs_optim.noise import IsotropicNoise
from study.landscape_chains import ChainAWSGLD, ChainHistograms, ConstantFactor, run_chains
from study.landscape_energies import (
    BOUNDARY,
    cell_of,
    kl,
    nine_masses,
    nine_minima,
    nine_modes,
)

START = 2.0  # both coordinates
ENERGY_RANGE = (-7.667, 17.333)  # one beyond the least and the highest energy of the domain
PARTITIONS = 100
TEMPERATURE = 1.0
STREAM_NOISE = 0.32  # deviation of the noise on energies and gradients
REACHED = 0.3  # a well is found within this distance of its minimum
EVERY = 10  # steps between two samples
PATH_POINTS = 1000


@dataclass(frozen=True)
class Arm:
    """One way to move on the landscape.

    Attributes:
        label: what the table calls it.
        lr, steps: learning rate and number of steps.
        drift: AWSGLD's preconditioner.
        cycles: cosine cycles of the learning rate, from five times `lr` to 0; 0 for none.
        nu: "off", "constant" or "histogram".
        constant: the multiplier where it is constant.
        clamp: bounds of the histogram's nu.
    """

    label: str
    steps: int = 200_000
    lr: float = 1e-3
    drift: str = "none"
    cycles: int = 0
    nu: str = "off"
    constant: float = 1.0
    clamp: tuple[float, float] | None = None


def adam(label: str, steps: int, **options: Any) -> Arm:
    """An arm with Adam's drift; its noise stays that of lr = 1e-3 at temperature 1 (0.0447)."""
    return Arm(label, steps, lr=0.02, drift="adam", **options)


ARMS = {
    "sgld": Arm("SGLD"),
    "cyclic": Arm("cyclical SGLD, 10 cycles", cycles=10),
    "constant-0.5": Arm("SGLD, constant multiplier 0.5 (control)", nu="constant", constant=0.5),
    "constant-0.3": Arm("SGLD, constant multiplier 0.3 (control)", nu="constant", constant=0.3),
    "awsgld": Arm("AWSGLD, plain drift, nu unbounded", nu="histogram"),
    "awsgld-clamped": Arm("AWSGLD, plain drift, nu in [-5, 5]", nu="histogram", clamp=(-5.0, 5.0)),
    "adam": adam("Adam drift, no nu", 30_000),
    "adam-clamped": adam(
        "AWSGLD, Adam drift, nu in [-5, 5]", 30_000, nu="histogram", clamp=(-5.0, 5.0)
    ),
    "adam-positive": adam(
        "AWSGLD, Adam drift, nu in [0, 5]", 30_000, nu="histogram", clamp=(0.0, 5.0)
    ),
    "adam-constant-long": adam(
        "Adam drift, constant multiplier 0.2 (control)", 200_000, nu="constant", constant=0.2
    ),
    "adam-clamped-long": adam(
        "AWSGLD, Adam drift, nu in [-5, 5]", 200_000, nu="histogram", clamp=(-5.0, 5.0)
    ),
}


def make_optimizer(arm: Arm, chains: int, generator: torch.Generator) -> AWSGLD:
    """The package's optimizer with its noise, over `chains` rows at the start."""
    x = torch.nn.Parameter(torch.full((chains, 2), START, dtype=torch.float64))
    histogram: Any = None
    if arm.nu == "constant":
        histogram = ConstantFactor(chains, arm.constant)
    elif arm.nu == "histogram":
        histogram = ChainHistograms(
            chains,
            PARTITIONS,
            ENERGY_RANGE,
            temperature=TEMPERATURE,
            warmup=0,
            clamp=arm.clamp,
        )
    if arm.drift == "adam":
        noise = IsotropicNoise(std=math.sqrt(2e-3 * TEMPERATURE), generator=generator)
    else:
        noise = IsotropicNoise(temperature=TEMPERATURE, generator=generator)
    drift: Any = arm.drift
    return ChainAWSGLD(
        [x],
        lr=arm.lr,
        histogram=histogram,
        noise=noise,
        preconditioner=drift,
        skip_nonfinite=False,  # the driver refuses non-finite energies
    )


class Census:
    """What is counted of the chains: first visits, time in each cell, weights, one path."""

    def __init__(self, arm: Arm, optimizer: AWSGLD, steps: int, chains: int) -> None:
        self._arm, self._histogram, self._steps = arm, optimizer.histogram, steps
        self._warm = steps // 40
        self._minima = nine_minima()
        self.first = torch.full((chains, 9), math.inf, dtype=torch.float64)
        self.raw = torch.zeros(chains, 9, dtype=torch.float64)
        self.weighted = torch.zeros(chains, 9, dtype=torch.float64)
        self.path: list[list[float]] = []
        self._path_every = max(steps // PATH_POINTS // EVERY, 1) * EVERY
        self._rows = torch.arange(chains)

    def __call__(self, step: int, x: Tensor, energy: Tensor) -> None:
        """Take the positions and energies before step `step`."""
        cell = cell_of(x)
        close = ((x - self._minima[cell]) ** 2).sum(1) < REACHED**2
        known = self.first[self._rows, cell]
        now = torch.where(close, float(step), math.inf)
        self.first[self._rows, cell] = torch.minimum(known, now)
        if step % self._path_every == 0:
            self.path.append([round(v, 3) for v in x[0].tolist()])
        if step < self._warm:
            return
        self.raw[self._rows, cell] += 1
        self.weighted[self._rows, cell] += self._weight(energy)

    def _weight(self, energy: Tensor) -> Tensor:
        if isinstance(self._histogram, ChainHistograms):
            return self._histogram.importance(energy)
        if self._arm.nu == "constant" and self._arm.drift == "none":
            # The chain's law is exp(-c U / T): the rest of the exponent is its weight.
            return (-(1 - self._arm.constant) * energy / TEMPERATURE).exp()
        return torch.ones_like(energy)


def seed_result(census: Census, rows: slice, truth: Tensor) -> dict[str, Any]:
    """The figures of the chains of one seed."""
    first, raw, weighted = census.first[rows], census.raw[rows], census.weighted[rows]
    found = torch.isfinite(first)
    all_nine = first.max(1).values.tolist()
    median = statistics.median(all_nine)
    return {
        "modes": float(found.sum(1).double().mean()),
        "share_all": float(found.all(1).double().mean()),
        "median_iterations": median if math.isfinite(median) else None,
        "kl_raw": kl(raw.sum(0), truth),
        "kl": kl(weighted.sum(0), truth),
        "kl_per_chain": statistics.fmean(kl(row, truth) for row in weighted),
    }


def run_arm(
    name: str, *, steps: int, chains: int, seeds: int, progress: Callable[[int], Any]
) -> dict[str, Any]:
    """All chains of all seeds of one arm at once; a seed is a batch of `chains` rows."""
    arm, rows = ARMS[name], chains * seeds
    generator = torch.Generator().manual_seed(0)
    optimizer = make_optimizer(arm, rows, generator)
    census = Census(arm, optimizer, steps, rows)
    cycle = steps / max(arm.cycles, 1)

    def cosine(k: int) -> float:
        return 2.5 * arm.lr * (math.cos(math.pi * (k % cycle) / cycle) + 1)

    run_chains(
        optimizer,
        nine_modes,
        steps,
        census,
        every=EVERY,
        boundary=BOUNDARY,
        noise=STREAM_NOISE,
        generator=generator,
        schedule=cosine if arm.cycles else None,
        progress=progress,
    )
    truth = nine_masses()
    marks = [round(steps * i / 50) for i in range(51)]
    found = [float((census.first <= mark).sum(1).double().mean()) for mark in marks]
    histogram = optimizer.histogram
    nu = (
        float(histogram.mean_multiplier.mean())
        if isinstance(histogram, ChainHistograms)
        else (arm.constant if arm.nu == "constant" else 1.0)
    )
    return {
        "arm": asdict(arm),
        "seeds": [
            seed_result(census, slice(i * chains, (i + 1) * chains), truth) for i in range(seeds)
        ],
        "mean_nu": nu,
        "curve": {"iterations": marks, "modes": found},
        "path": census.path,
    }
