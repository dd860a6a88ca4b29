"""The nine-mode landscape: which arm finds how many wells, how soon, and in the right shares."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from studies.landscapes.chains import Chains, Dynamics, Samples
from studies.landscapes.energies import BOUNDARY, cell_of, kl, nine_masses, nine_minima

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
    """One way to move on the landscape."""

    label: str  # in the table
    steps: int = 200_000
    lr: float = 1e-3
    drift: Literal["none", "adam"] = "none"
    cycles: int = 0  # cosine cycles of the learning rate, from five times `lr` to 0
    nu: str = "off"  # or "constant" or "histogram"
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


def dynamics_of(arm: Arm) -> Dynamics:
    """The arm in the words of AWSGLD and EnergyHistogram."""
    flat = arm.nu == "histogram"
    return Dynamics(
        "nine",
        arm.lr,
        drift=arm.drift,
        std=math.sqrt(2e-3 * TEMPERATURE) if arm.drift == "adam" else None,
        temperature=TEMPERATURE,
        constant=arm.constant,
        partitions=PARTITIONS if flat else 0,
        energy_range=ENERGY_RANGE,
        clamp=arm.clamp,
        boundary=BOUNDARY,
        stream_noise=STREAM_NOISE,
    )


class Census:
    """What is counted of the chains: first visits, time in each cell, weights, one path."""

    def __init__(self, arm: Arm, steps: int, chains: int) -> None:
        self._arm, self._warm = arm, steps // 40
        self._minima = nine_minima()
        self.first = torch.full((chains, 9), math.inf, dtype=torch.float64)
        self.raw = torch.zeros(chains, 9, dtype=torch.float64)
        self.weighted = torch.zeros(chains, 9, dtype=torch.float64)
        self.path: list[list[float]] = []
        self._path_every = max(steps // PATH_POINTS // EVERY, 1) * EVERY

    def __call__(self, samples: Samples) -> None:
        """Take a block of states."""
        steps = torch.from_numpy(samples.steps)
        x = torch.from_numpy(samples.positions)
        cell = cell_of(x.reshape(-1, 2)).reshape(x.shape[:2])
        close = ((x - self._minima[cell]) ** 2).sum(2) < REACHED**2
        now = torch.where(close, steps[:, None].double(), math.inf)
        self.first.scatter_reduce_(1, cell.T, now.T, "amin")
        on_path = steps % self._path_every == 0
        self.path += [[round(v, 3) for v in point] for point in x[on_path, 0].tolist()]
        counted = steps >= self._warm
        cell = cell[counted].T
        self.raw.scatter_add_(1, cell, torch.ones(cell.shape, dtype=torch.float64))
        self.weighted.scatter_add_(1, cell, self._weights(samples)[counted].T)

    def _weights(self, samples: Samples) -> Tensor:
        if self._arm.nu == "constant" and self._arm.drift == "none":
            # The chain's law is exp(-c U / T): the rest of the exponent is its weight.
            left = 1 - self._arm.constant
            return (-left * torch.from_numpy(samples.energies) / TEMPERATURE).exp()
        return torch.from_numpy(samples.weights)


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
    }


def run_arm(
    name: str, *, steps: int, chains: int, seeds: int, progress: Callable[[int], Any]
) -> dict[str, Any]:
    """All chains of all seeds of one arm at once; a seed is a batch of `chains` rows."""
    arm, rows = ARMS[name], chains * seeds
    census = Census(arm, steps, rows)
    cycle = steps / max(arm.cycles, 1)

    def cosine(k: int) -> float:
        return 2.5 * arm.lr * (math.cos(math.pi * (k % cycle) / cycle) + 1)

    run = Chains(dynamics_of(arm), np.full((rows, 2), START), seed=0)
    schedule = cosine if arm.cycles else None
    run.run(steps, census, every=EVERY, schedule=schedule, progress=progress)
    truth = nine_masses()
    return {
        "arm": asdict(arm),
        "seeds": [
            seed_result(census, slice(i * chains, (i + 1) * chains), truth) for i in range(seeds)
        ],
        "mean_nu": float(run.mean_nu.mean()),
        "path": census.path,
    }
