"""3DGS-MCMC's covariance-shaped noise in pure torch (eq. 2)."""

from __future__ import annotations

import torch
from torch import Tensor

from opt3dgs_optim._columns import columns, row_chunks

GATE_SHARPNESS = 100.0  # k of eq. 2's gate
GATE_OPACITY = 0.005  # t of eq. 2's gate: the opacity under which a Gaussian counts as dead


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
    noise = torch.empty_like(eta)
    for rows in row_chunks(eta):
        part = (scales[rows], quats[rows], opacities[rows], eta[rows])
        noise[rows] = _noise(*part, sharpness, threshold).T
    return noise


def covariance_noise_(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    eta: Tensor,
    factor: Tensor,
    sharpness: float,
    threshold: float,
) -> None:
    """Add `factor * covariance_noise(...)` to `means` [N, 3] in place; factor is 0-d."""
    for rows in row_chunks(means):
        part = (scales[rows], quats[rows], opacities[rows], eta[rows])
        means[rows] += (_noise(*part, sharpness, threshold) * factor).T


def _noise(
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    eta: Tensor,
    sharpness: float,
    threshold: float,
) -> Tensor:
    """`covariance_noise` as [3, N]."""
    gate = torch.sigmoid(-sharpness * (torch.sigmoid(opacities.reshape(-1)) - threshold))
    q = columns(quats, quats.dtype)
    # clamp: as torch.nn.functional.normalize
    w, *axis = (q / (q * q).sum(0).sqrt().clamp(min=1e-12)).unbind()
    # R^T eta: rotation by the conjugate quaternion; then the variances; then R.
    local = _rotate(w, [-a for a in axis], list(columns(eta, eta.dtype).unbind()))
    variance = (2 * columns(scales, scales.dtype)).exp().unbind()
    shaped = [a * b for a, b in zip(variance, local, strict=True)]
    return torch.stack([v * gate for v in _rotate(w, axis, shaped)])


def _rotate(w: Tensor, q: list[Tensor], v: list[Tensor]) -> list[Tensor]:
    """Rotate v by the unit quaternion (w, q): v + w t + q x t with t = 2 q x v."""
    t = [2 * component for component in _cross(q, v)]
    return [a + w * b + c for a, b, c in zip(v, t, _cross(q, t), strict=True)]


def _cross(a: list[Tensor], b: list[Tensor]) -> list[Tensor]:
    return [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
