"""Langevin noise: covariance-shaped for Gaussians, isotropic for anything else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim._checks import check_number

GATE_SHARPNESS = 100.0  # k of eq. 2's gate
GATE_OPACITY = 0.005  # t of eq. 2's gate: the opacity under which a Gaussian counts as dead

GaussianTensors = Mapping[str, Tensor]


def covariance_noise(
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    eta: Tensor,
    *,
    sharpness: float = GATE_SHARPNESS,
    threshold: float = GATE_OPACITY,
) -> Tensor:
    """Noise shaped by each Gaussian's covariance and gated by its opacity (eq. 2).

        sigmoid(-k (o - t)) * Sigma @ eta,   Sigma = R diag(s)^2 R^T

    Nearly transparent Gaussians wander along their own shape, opaque ones stand still.

    Args:
        scales: [N, 3] log of the standard deviations, world units.
        quats: [N, 4] rotations, wxyz, need not be normalised.
        opacities: [N] or [N, 1] logits.
        eta: [N, 3] standard normal.
        sharpness: k, per unit of opacity.
        threshold: t, opacity in 0..1.

    Returns:
        [N, 3] in squared world units; the caller multiplies by noise scale and learning rate.
    """
    # Component-wise on [N]: several times faster than batched 3x3 matrices on any device.
    gate = torch.sigmoid(-sharpness * (torch.sigmoid(opacities.reshape(-1)) - threshold))
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    variance = torch.exp(2 * scales)
    # R^T eta: rotation by the conjugate quaternion; then the variances; then R.
    local = _rotate(w, -x, -y, -z, *eta.unbind(-1))
    shaped = [axis * component for axis, component in zip(variance.unbind(-1), local, strict=True)]
    return torch.stack(_rotate(w, x, y, z, *shaped), dim=-1) * gate.unsqueeze(-1)


def _rotate(
    w: Tensor, x: Tensor, y: Tensor, z: Tensor, a: Tensor, b: Tensor, c: Tensor
) -> list[Tensor]:
    """Rotate (a, b, c) by the unit quaternion (w, x, y, z): v + w t + q x t with t = 2 q x v."""
    tx, ty, tz = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return [
        a + w * tx + (y * tz - z * ty),
        b + w * ty + (z * tx - x * tz),
        c + w * tz + (x * ty - y * tx),
    ]


@dataclass(frozen=True)
class CovarianceNoise:
    """3DGS-MCMC's position noise: `scale * lr * covariance_noise(...)` (eq. 2).

    Args:
        gaussians: the trainer's dict with `scales`, `quats`, `opacities`, or a function that
            returns it. It is read anew in every step, because density control replaces the
            tensors in it.
        scale: noise_lr of 3DGS-MCMC.
        generator: random generator of the parameters' device, or None for torch's own.
    """

    gaussians: GaussianTensors | Callable[[], GaussianTensors]
    scale: float = 5e5
    generator: torch.Generator | None = None

    def __post_init__(self) -> None:
        check_number("CovarianceNoise", "scale", self.scale, 0.0)

    def add_to(self, means: Tensor, lr: float | Tensor) -> None:
        """Add the noise to `means` [N, 3] in place; lr is their present learning rate."""
        source = self.gaussians() if callable(self.gaussians) else self.gaussians
        missing = [name for name in ("scales", "quats", "opacities") if name not in source]
        if missing:
            raise ValueError(
                f"CovarianceNoise: {missing} are not among the Gaussians' tensors {sorted(source)}"
            )
        scales, quats, opacities = source["scales"], source["quats"], source["opacities"]
        if scales.shape[0] != means.shape[0]:
            raise ValueError(
                f"CovarianceNoise: {scales.shape[0]} scales for {means.shape[0]} means; the dict "
                "must hold the tensors that belong to the means being stepped"
            )
        eta = _normal_like(means, self.generator)
        noise = covariance_noise(scales.detach(), quats.detach(), opacities.detach(), eta)
        means.add_(noise * (lr * self.scale))


@dataclass(frozen=True)
class IsotropicNoise:
    """Langevin noise of a landscape: `sqrt(2 lr temperature)`, or a fixed deviation, times eta.

    Args:
        temperature: that of the law exp(-energy / temperature) which plain SGLD drift
            (`preconditioner="none"`) then samples, in units of the energy.
        std: a fixed deviation per step, in units of the parameters, instead of a temperature.
        generator: random generator of the parameters' device, or None for torch's own.
    """

    temperature: float | None = None
    std: float | None = None
    generator: torch.Generator | None = None

    def __post_init__(self) -> None:
        if (self.temperature is None) == (self.std is None):
            raise ValueError(
                f"IsotropicNoise: temperature={self.temperature!r} and std={self.std!r}, but "
                "exactly one of the two is needed"
            )
        name = "std" if self.temperature is None else "temperature"
        check_number("IsotropicNoise", name, getattr(self, name), 0.0)

    def add_to(self, param: Tensor, lr: float | Tensor) -> None:
        """Add the noise to `param` (any shape) in place; lr is its present learning rate."""
        deviation: Any = self.std
        if self.temperature is not None:
            deviation = (2 * lr * self.temperature) ** 0.5
        param.add_(_normal_like(param, self.generator) * deviation)


def _normal_like(tensor: Tensor, generator: torch.Generator | None) -> Tensor:
    # randn_like takes no generator.
    return torch.randn(tensor.shape, dtype=tensor.dtype, device=tensor.device, generator=generator)
