"""Chains on a landscape, run in blocks by `kernel`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from studies.landscapes.kernel import ADAM, DOUBLE_WELL, NINE_MODES, PLAIN, advance

BLOCK = 1000


@dataclass(frozen=True)
class Dynamics:
    """What one step of a chain is: the options of AWSGLD, EnergyHistogram and IsotropicNoise."""

    landscape: Literal["nine", "well"]
    lr: float
    drift: Literal["none", "adam"] = "none"  # AWSGLD's preconditioner
    std: float | None = None  # of the Langevin noise; None: sqrt(2 lr temperature)
    temperature: float = 1.0  # of noise and histogram
    constant: float = 1.0  # the multiplier without a histogram
    partitions: int = 0  # of the histogram, which has no warm-up; 0: none
    energy_range: tuple[float, float] = (0.0, 1.0)
    zeta: float = 0.75
    clamp: tuple[float, float] | None = None
    betas: tuple[float, float] = (0.9, 0.999)
    boundary: float = math.inf  # a step that leaves [-boundary, boundary] is not taken
    stream_noise: float = 0.0  # deviation, on the energy and on each gradient component


class Samples(NamedTuple):
    """What `watch` gets: the state before some of the steps.

    `weights` undo the flattening up to a factor (`kernel.importance`); without a
    histogram they are 1.
    """

    steps: np.ndarray  # [S]
    positions: np.ndarray  # [S, C, D]
    energies: np.ndarray  # [S, C], without the stream's noise
    weights: np.ndarray  # [S, C]


class Chains:
    """C chains with their moments and weights; `run` may be called again and goes on."""

    def __init__(
        self,
        dynamics: Dynamics,
        start: np.ndarray,  # [C, D]
        seed: int,
        heights: np.ndarray | None = None,  # [C] barriers of the double well
    ) -> None:
        chains = len(start)
        self.dynamics = dynamics
        self.x = np.array(start, dtype=np.float64)
        self.exp_avg, self.exp_avg_sq = np.zeros_like(self.x), np.zeros_like(self.x)
        m = dynamics.partitions
        self.theta = np.full((chains, m), 1 / m if m else 0.0)
        self.nu_sum = np.zeros(chains)
        self.step = 0
        self._heights = np.ones(chains) if heights is None else np.array(heights, dtype=float)
        self._random = np.random.default_rng(seed)

    def draws(self, steps: int) -> np.ndarray:
        """[steps, C, 2 D + 1] standard normals: for the energy, the gradient, the motion."""
        chains, dim = self.x.shape
        return self._random.standard_normal((steps, chains, 2 * dim + 1))

    def run(
        self,
        steps: int,
        watch: Callable[[Samples], Any] | None = None,
        *,
        every: int = 1,
        schedule: Callable[[int], float] | None = None,
        progress: Callable[[int], Any] | None = None,
    ) -> None:
        """Take `steps` steps.

        Args:
            steps: how many.
            watch: called with every `every`-th state, a block at a time.
            every: a divisor of 1,000, the block.
            schedule: the learning rate of step k, instead of `lr`.
            progress: called with the number of steps since its last call.

        Raises:
            ValueError: `every` does not divide the block.
            FloatingPointError: a position is not finite.
        """
        if every < 1 or BLOCK % every:
            raise ValueError(f"Chains.run: every={every}, but a divisor of {BLOCK} is needed")
        last = self.step + steps
        while self.step < last:
            count = min(BLOCK, last - self.step)
            at = range(self.step, self.step + count)
            rates = np.array([self.dynamics.lr if schedule is None else schedule(k) for k in at])
            samples = self._block(rates, every)
            if watch is not None:
                watch(samples)
            if not np.isfinite(self.x).all():
                raise FloatingPointError(f"Chains.run: a position of step {at[-1]} is not finite")
            if progress is not None:
                progress(count)

    def _block(self, rates: np.ndarray, every: int) -> Samples:
        how, count = self.dynamics, len(rates)
        chains, dim = self.x.shape
        low, high = how.energy_range
        deviations = np.sqrt(2 * rates * how.temperature)
        if how.std is not None:
            deviations = np.full(count, how.std)
        taken = -(-count // every)
        positions = np.empty((taken, chains, dim))
        energies, weights = np.empty((taken, chains)), np.empty((taken, chains))
        advance(
            NINE_MODES if how.landscape == "nine" else DOUBLE_WELL,
            ADAM if how.drift == "adam" else PLAIN,
            self.x,
            self.exp_avg,
            self.exp_avg_sq,
            self.theta,
            self.nu_sum,
            self._heights,
            self.step,
            rates,
            deviations,
            how.constant,
            how.zeta,
            how.temperature,
            low,
            (high - low) / max(how.partitions, 1),
            (-math.inf, math.inf) if how.clamp is None else how.clamp,
            how.betas,
            how.boundary,
            how.stream_noise,
            self.draws(count),
            every,
            positions,
            energies,
            weights,
        )
        steps = self.step + every * np.arange(taken)
        self.step += count
        return Samples(steps, positions, energies, weights)

    @property
    def mean_nu(self) -> np.ndarray:
        """[C]: the multiplier's mean over all steps so far."""
        return self.nu_sum / max(self.step, 1)
