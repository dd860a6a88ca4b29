"""What 3DGS-MCMC does beside the optimizers' steps: relocation, growth to a cap, noise, penalties.

Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", NeurIPS 2024.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from splatting.projection import rotation_matrices
from splatting.relocation import MAX_OPACITY, relocated_values

_REFERENCE_RUN = 30_000  # iterations that 500, 25,000 and 100 were made for
Optimizers = Mapping[str, torch.optim.Optimizer]
NOISE_LR = 5e5  # of 3DGS-MCMC, as are the next two
NOISE_SHARPNESS, NOISE_OPACITY = 100.0, 0.005  # only nearly transparent Gaussians move


class MCMCDensityControl:
    """Relocation and growth on a schedule, with gsplat 1.5.3's edits of the optimizer state."""

    def __init__(
        self,
        cap_max: int,  # at most so many Gaussians
        refine_start: int = 500,  # refine after this iteration, before the next number
        refine_stop: int = 25_000,
        refine_every: int = 100,
        min_opacity: float = 0.005,  # at or below it (after the sigmoid) a Gaussian is dead
        growth: float = 1.05,  # of their number at each refinement, rounded down
        generator: torch.Generator | None = None,  # for the sampling; None: torch's global one
    ) -> None:
        self.cap_max, self.min_opacity, self.growth = cap_max, min_opacity, growth
        self.refine_start, self.refine_stop = refine_start, refine_stop
        self.refine_every = refine_every
        self.generator = generator
        self.state: dict[str, Any] = {}  # nothing that a checkpoint must hold

    @classmethod
    def for_run(
        cls,
        iterations: int,
        cap_max: int,
        *,
        num_points: int,
        generator: torch.Generator | None = None,
    ) -> MCMCDensityControl:
        """Fit the stock schedule (500, 25,000, 100 of 30,000 iterations) to a run of any length.

        Start and stop scale with the run. The cadence does too, but stays within 20 to 100
        iterations: Adam's first moment needs some ten updates to settle after a move. That leaves
        a short run fewer refinements than the 244 of a stock one (61 of 1,500 iterations, enough
        for a factor of 19.6 at 5 %). Where 5 % would not reach the cap half-way between start and
        stop, the growth is raised until it does.

        Args:
            iterations: length of the whole run.
            num_points: how many the run starts with.
        """
        scale = iterations / _REFERENCE_RUN
        start, stop = round(500 * scale), round(25_000 * scale)
        every = min(max(round(100 * scale), 20), 100)
        half = max(((start + stop) // 2 - start) // every, 1)
        growth = max(1.05, (cap_max / num_points) ** (1.0 / half))
        return cls(cap_max, start, stop, every, growth=growth, generator=generator)

    @torch.no_grad()
    def step(self, iteration: int, gaussians: dict[str, Parameter], optimizers: Optimizers) -> int:
        """Relocate and grow if this is a refinement iteration; return how many were relocated.

        Edits the way gsplat does: every entry of `gaussians` becomes a new Parameter object,
        relocation keeps its storage and zeroes the state of the *sampled* rows (not of the moved
        ones), growth appends float32 zeros to every state tensor but "step".

        Args:
            iteration: counted from 0.
            gaussians: the dict of `gaussians.py`; its entries are replaced.
            optimizers: one for each key, with one group that holds that one parameter.
        """
        in_window = self.refine_start < iteration < self.refine_stop
        if not in_window or iteration % self.refine_every != 0:
            return 0
        relocated = self._relocate(gaussians, optimizers)
        self._grow(gaussians, optimizers)
        return relocated

    def _relocate(self, gaussians: dict[str, Parameter], optimizers: Optimizers) -> int:
        opacities = torch.sigmoid(gaussians["opacities"].flatten())
        if torch.isnan(opacities).any():
            raise ValueError("MCMCDensityControl.step: NaN among the opacities")
        is_dead = opacities <= self.min_opacity
        dead, alive = is_dead.nonzero()[:, 0], (~is_dead).nonzero()[:, 0]
        if len(dead) == 0 or len(alive) == 0:  # gsplat fails with none alive; nowhere to go
            return 0
        sources = alive[self._sample(opacities[alive], len(dead))]
        self._shrink(gaussians, opacities, sources)
        for name, parameter in list(gaussians.items()):
            parameter[dead] = parameter[sources]
            # Upstream keeps the moved rows' moments and zeroes those of their sources.
            _replace(
                name, parameter.data, gaussians, optimizers, lambda v: v.index_fill_(0, sources, 0)
            )
        return len(dead)

    def _grow(self, gaussians: dict[str, Parameter], optimizers: Optimizers) -> None:
        count = len(gaussians["means"])
        added = max(0, min(self.cap_max, int(self.growth * count)) - count)
        opacities = torch.sigmoid(gaussians["opacities"].flatten())
        if added == 0 or not opacities.sum() > 0:
            return
        sources = self._sample(opacities, added)
        self._shrink(gaussians, opacities, sources)

        def with_zero_rows(value: Tensor) -> Tensor:
            # float32 whatever the state's dtype is, as upstream: optimizers must survive that
            return torch.cat((value, torch.zeros(added, *value.shape[1:], device=value.device)))

        for name, parameter in list(gaussians.items()):
            grown = torch.cat((parameter.data, parameter.data[sources]))
            _replace(name, grown, gaussians, optimizers, with_zero_rows)

    def _sample(self, weights: Tensor, count: int) -> Tensor:
        return torch.multinomial(weights, count, replacement=True, generator=self.generator)

    def _shrink(self, gaussians: dict[str, Parameter], opacities: Tensor, sources: Tensor) -> None:
        """Give the sampled Gaussians, in place, what they share with their copies (eq. 9)."""
        copies = torch.bincount(sources)[sources] + 1
        log_scales, logits = gaussians["scales"], gaussians["opacities"]
        opacity, scale = relocated_values(opacities[sources], log_scales[sources].exp(), copies)
        opacity = opacity.clamp(self.min_opacity, MAX_OPACITY)
        logits[sources] = torch.logit(opacity).reshape(-1, *logits.shape[1:])
        log_scales[sources] = scale.log()


@torch.no_grad()
def add_noise(
    gaussians: dict[str, Parameter], lr: float, generator: torch.Generator | None = None
) -> None:
    """Langevin noise on the positions, shaped by each Gaussian's covariance (eq. 2).

    Args:
        gaussians: changed in place.
        lr: the positions' learning rate of this iteration.
        generator: for the draws; None is torch's global one.
    """
    opacities = torch.sigmoid(gaussians["opacities"].flatten())
    gate = torch.sigmoid(NOISE_SHARPNESS * (NOISE_OPACITY - opacities))
    factors = rotation_matrices(gaussians["quats"]) * gaussians["scales"].exp()[:, None, :]
    draws = torch.randn(len(gate), 3, 1, generator=generator)
    noise = factors @ (factors.mT @ draws)  # Sigma @ eta
    gaussians["means"].add_(noise[..., 0] * (gate * (lr * NOISE_LR))[:, None])


def regularisers(gaussians: dict[str, Parameter]) -> Tensor:
    """0.01 * mean(opacity) + 0.01 * mean(scale), both after activation."""
    opacities, scales = gaussians["opacities"], gaussians["scales"]
    return 0.01 * torch.sigmoid(opacities).mean() + 0.01 * torch.exp(scales).mean()


def _replace(
    name: str,
    data: Tensor,
    gaussians: dict[str, Parameter],
    optimizers: Optimizers,
    edit_state: Callable[[Tensor], Tensor],
) -> None:
    """Swap in a new Parameter and carry the optimizer's state over, edited, all but "step"."""
    old, optimizer = gaussians[name], optimizers[name]
    new = Parameter(data, requires_grad=old.requires_grad)
    state = optimizer.state.pop(old, {})
    for key, value in state.items():
        if key != "step":
            state[key] = edit_state(value)
    optimizer.param_groups[0]["params"] = [new]
    optimizer.state[new] = state
    gaussians[name] = new
