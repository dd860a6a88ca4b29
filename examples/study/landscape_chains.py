"""Many chains in one AWSGLD, every chain with an energy histogram of its own.

`AWSGLD` takes one energy per step. Here one optimizer steps [C, D] parameters, a row per chain:
`ChainHistograms` is `EnergyHistogram` with a row of weights per chain (its `observe`, warm-up,
lambda and running means are inherited; index, nu and the update of the weights are batched), and
`ChainAWSGLD` is `AWSGLD` with a column of multipliers. `tests/test_landscapes.py` compares both
with the real classes, chain by chain.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim import AWSGLD, EnergyHistogram


class ChainHistograms(EnergyHistogram):
    """`EnergyHistogram` for C independent energies per step; all state has a first axis C.

    Args:
        chains: C.
        options: those of `EnergyHistogram`; only the backward slope and the raw energy.

    Raises:
        ValueError: `slope` or `energy` is another one, or a step's energies are not [C].
    """

    def __init__(self, chains: int, *args: Any, **options: Any) -> None:
        self.chains = chains
        super().__init__(*args, **options)
        if (self.slope, self.energy) != ("backward", "raw"):
            raise ValueError(
                f"ChainHistograms: slope={self.slope!r}, energy={self.energy!r}, but only "
                "'backward' and 'raw' are batched"
            )

    def _allocate(self, device: torch.device) -> None:
        super()._allocate(device)
        for name in ("_low", "_width", "_tau", "_count", "_nu", "_last_finite", "_weights"):
            setattr(self, name, self._per_chain(getattr(self, name)))
        for moments in (self._recent, self._nu_moments, self._smooth):
            for name in ("weight", "mean", "_square", "low"):
                setattr(moments, name, self._per_chain(getattr(moments, name)))

    def _per_chain(self, value: Tensor) -> Tensor:
        return value.expand(self.chains, *value.shape).clone()

    def _on_device(self, energy: Tensor | float) -> Tensor:
        if not isinstance(energy, Tensor) or energy.shape != (self.chains,):
            shape = tuple(energy.shape) if isinstance(energy, Tensor) else "a number"
            raise ValueError(
                f"ChainHistograms.observe: energy is {shape}, but ({self.chains},) is needed"
            )
        return energy.detach().to(self._weights.dtype)

    def _partition(self, value: Tensor) -> Tensor:
        index = torch.ceil((value - self._low) / self._width) - 1
        return index.clamp(0, self.num_partitions - 1).long()

    def _weight_at(self, index: Tensor) -> Tensor:
        return self._weights.gather(1, index[:, None])[:, 0]

    def _multiplier(self, index: Tensor) -> Tensor:
        below = self._weight_at((index - 1).clamp(min=0)).log()
        nu = 1 + self.zeta * self._tau * (self._weight_at(index).log() - below) / self._width
        if self.clamp is not None:
            nu = nu.clamp(*self.clamp)
        return torch.where((index > 0) & (index < self.num_partitions - 1), nu, 1.0)

    def _update_weights(self, index: Tensor, valid: Tensor) -> None:
        counting = valid & (self._count >= self._calibration)
        rate = (self._lambda() * self._weight_at(index) ** self.zeta * counting)[:, None]
        theta = self._weights - rate * self._weights
        theta = theta.scatter_add_(1, index[:, None], rate).clamp_(min=self.floor)
        theta = theta.div_(theta.sum(1, keepdim=True))
        self._weights.copy_(torch.where(counting[:, None], theta, self._weights))

    def importance(self, energy: Tensor) -> Tensor:
        """theta_J^zeta of each chain's energy [C]: undoes the flattening, up to a factor."""
        return self._weight_at(self._partition(energy)) ** self.zeta


class ChainAWSGLD(AWSGLD):
    """`AWSGLD` of one [C, D] parameter whose histogram gives C multipliers, one per row."""

    def _bad_step(self) -> Tensor | None:
        return None  # `run_chains` raises where an energy is not finite

    def _scaled_lr(self, group: dict[str, Any], device: torch.device) -> float | Tensor:
        factor = self._factor(group)
        # Adam's functional takes one learning rate: the rows' factors follow in `_update`.
        if factor is None or self.preconditioner == "adam":
            return group["lr"]
        return group["lr"] * factor[:, None]  # pyright: ignore[reportIndexIssue]

    def _update(self, group: dict[str, Any], params: list[Tensor], *args: Any) -> None:
        factor = self._factor(group)
        if factor is None or self.preconditioner == "none":
            super()._update(group, params, *args)
            return
        (param,) = params
        before = param.detach().clone()
        super()._update(group, params, *args)
        # Adam's step is linear in the learning rate, so the factor may come after it.
        param.copy_(before + factor[:, None] * (param - before))  # pyright: ignore


class ConstantFactor:
    """The control of the flat histogram: the same multiplier for every chain in every step."""

    def __init__(self, chains: int, value: float) -> None:
        self.multiplier = torch.full((chains,), value, dtype=torch.float64)
        self.last_finite = torch.ones((), dtype=torch.bool)
        self.num_observed = 0

    def observe(self, energy: Tensor) -> Tensor:
        """Count the energies [C]; their values do not matter."""
        self.num_observed += 1
        return self.multiplier


Landscape = Callable[[Tensor], tuple[Tensor, Tensor]]  # [C, D] -> energy [C], gradient [C, D]
Watcher = Callable[[int, Tensor, Tensor], None]  # step, positions [C, D], their energies [C]


def run_chains(
    optimizer: AWSGLD,
    landscape: Landscape,
    steps: int,
    watch: Watcher | None = None,
    *,
    every: int = 1,
    boundary: float | None = None,
    noise: float = 0.0,
    generator: torch.Generator | None = None,
    schedule: Callable[[int], float] | None = None,
    progress: Callable[[int], Any] | None = None,
) -> None:
    """Step all chains of a `ChainAWSGLD`, or of any AWSGLD without a histogram.

    Args:
        optimizer: over one [C, D] parameter.
        landscape: energies and gradients.
        steps: how many.
        watch: called before every `every`-th step.
        boundary: a step that leaves [-boundary, boundary]^D is not taken by that chain.
        noise: deviation of the noise on the energy and on each component of the gradient that
            the optimizer sees (`watch` gets the energies without it).
        generator: of that noise.
        schedule: the learning rate of step k.
        progress: called with the number of steps since its last call.

    Raises:
        FloatingPointError: an energy is not finite.
    """
    x = optimizer.param_groups[0]["params"][0]
    for k in range(steps):
        energy, gradient = landscape(x.detach())
        if watch is not None and k % every == 0:
            watch(k, x.detach(), energy)
        if noise:
            draws = torch.randn(len(x), x.shape[1] + 1, dtype=x.dtype, generator=generator) * noise
            energy, gradient = energy + draws[:, 0], gradient + draws[:, 1:]
        if optimizer.histogram is not None:
            optimizer.histogram.observe(energy)
        x.grad = gradient
        if schedule is not None:
            optimizer.param_groups[0]["lr"] = schedule(k)
        before = x.detach().clone() if boundary is not None else None
        optimizer.step()
        if before is not None:
            inside = (x.detach().abs() <= boundary).all(1, keepdim=True)
            x.data = torch.where(inside, x.detach(), before)
        if (k + 1) % 1000 == 0 or k + 1 == steps:
            if not bool(torch.isfinite(energy).all()):
                raise FloatingPointError(f"run_chains: an energy of step {k} is not finite")
            if progress is not None:
                progress(k % 1000 + 1)
