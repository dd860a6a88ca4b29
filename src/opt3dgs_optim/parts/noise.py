"""Langevin noise: covariance-shaped for Gaussians, isotropic for anything else."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_number, set_options
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Frame, Step, axes_of, into_frame, out_of_frame
from opt3dgs_optim.training import Training

GATE_SHARPNESS = 100.0  # k of eq. 2's gate
GATE_OPACITY = 0.005  # t of eq. 2's gate: the opacity under which a Gaussian counts as dead


@dataclass(repr=False, eq=False)
class PositionNoise(Part):
    """3DGS-MCMC's position noise: `scale * lr * covariance_noise(...)` after each step (eq. 2).

    For trainers that do not inject it themselves. gsplat's MCMCStrategy and 3dgs-mcmc do: leave
    this part out there (or set their noise_lr to 0). lr is the trainer's own present learning
    rate of the positions, without any factor. Scales, rotations and opacities are those that the
    same optimizers, or others that were upgraded with them, hold.

    Args:
        scale: noise_lr of 3DGS-MCMC.
        generator: random generator of the parameters' device, or None for torch's own.

    Raises:
        ValueError: scale is below 0; in a step, the optimizers lack a tensor of these Gaussians.
    """

    scale: float = 5e5
    generator: torch.Generator | None = None

    names = ("means",)

    def __post_init__(self) -> None:
        set_options(self, scale=check_number("PositionNoise", "scale", self.scale, 0.0))

    def plan(self, step: Step, training: Training) -> None:
        """Refuse, before the step, what `after` could not do."""
        self._shapes(step, training)

    def after(self, step: Step, training: Training) -> None:
        """Add the noise to the positions [N, 3] in place."""
        means = step.param
        eta = torch.randn(
            means.shape, dtype=means.dtype, device=means.device, generator=self.generator
        )
        scales, quats, opacities = self._shapes(step, training)
        noise = covariance_noise(scales, quats, opacities, eta)
        means.data.add_(noise, alpha=step.group["lr"] * self.scale)

    def _shapes(self, step: Step, training: Training) -> list[Tensor]:
        """Scales, rotations and opacities of the positions' Gaussians."""
        means, others = step.param, []
        for name, numbers in (("scales", 3), ("quats", 4), ("opacities", 1)):
            tensor = training.param_of(step.set, name)
            if tensor is None or tensor.numel() != numbers * len(means):
                has = "missing" if tensor is None else list(tensor.shape)
                raise ValueError(
                    f"PositionNoise: {name} is {has}, but [{len(means)}, {numbers}] is needed for "
                    f"{len(means)} means, in an optimizer that is upgraded with theirs"
                )
            others.append(tensor)
        return others


@dataclass(repr=False, eq=False)
class IsotropicNoise(Part):
    """Langevin noise of a landscape: `sqrt(2 lr temperature)` times eta.

    Args:
        temperature: in units of the energy. Plain SGLD drift
            (`AWSGLD(preconditioner="none")`) then samples exp(-energy / temperature).
        generator: random generator of the parameters' device, or None for torch's own.

    Raises:
        ValueError: the temperature is below 0.
    """

    temperature: float
    generator: torch.Generator | None = None

    names = None

    def __post_init__(self) -> None:
        set_options(
            self, temperature=check_number("IsotropicNoise", "temperature", self.temperature, 0.0)
        )

    def after(self, step: Step, training: Training) -> None:
        """Add the noise to the parameter (any shape) in place."""
        param = step.param
        eta = torch.randn(
            param.shape, dtype=param.dtype, device=param.device, generator=self.generator
        )
        param.data.add_(eta, alpha=(2 * step.group["lr"] * self.temperature) ** 0.5)


def covariance_noise(scales: Tensor, quats: Tensor, opacities: Tensor, eta: Tensor) -> Tensor:
    """Noise [N, 3], squared world units, of each Gaussian's covariance and opacity (eq. 2).

        sigmoid(-k (o - t)) * Sigma @ eta,   Sigma = R diag(s)^2 R^T,   k = 100, t = 0.005

    Args:
        scales: [N, 3] log of the standard deviations, world units.
        quats: [N, 4] rotations, wxyz, need not be normalised.
        opacities: [N] or [N, 1] logits.
        eta: [N, 3] standard normal.
    """
    axes = axes_of(Frame(1.0, 0.0, quats, scales))  # Sigma = B B^T
    opacity = torch.sigmoid(opacities.detach().reshape(-1, 1))
    gate = torch.sigmoid(-GATE_SHARPNESS * (opacity - GATE_OPACITY))
    return out_of_frame(axes, into_frame(axes, eta)).mul_(gate)
