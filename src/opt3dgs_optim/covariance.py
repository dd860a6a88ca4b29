"""3DGS-MCMC's covariance-shaped position noise (eq. 2)."""

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.backend import uses_kernel
from opt3dgs_optim.lbfgs.pairs import columns, row_chunks

GATE_SHARPNESS = 100.0  # k of eq. 2's gate
GATE_OPACITY = 0.005  # t of eq. 2's gate: the opacity under which a Gaussian counts as dead


def covariance_noise(scales: Tensor, quats: Tensor, opacities: Tensor, eta: Tensor) -> Tensor:
    """Noise shaped by each Gaussian's covariance and gated by its opacity (eq. 2).

        sigmoid(-k (o - t)) * Sigma @ eta,   Sigma = R diag(s)^2 R^T,   k = 100, t = 0.005

    Nearly transparent Gaussians wander along their own shape, opaque ones stand still.

    Args:
        scales: [N, 3] log of the standard deviations, world units.
        quats: [N, 4] rotations, wxyz, need not be normalised.
        opacities: [N] or [N, 1] logits.
        eta: [N, 3] standard normal.

    Returns:
        [N, 3] in squared world units; the caller multiplies by noise scale and learning rate.
    """
    noise = torch.empty_like(eta)
    for rows in row_chunks(eta):
        noise[rows] = _noise(scales[rows], quats[rows], opacities[rows], eta[rows]).T
    return noise


def add_covariance_noise(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    eta: Tensor,
    lr: float | Tensor,
    *,
    noise_scale: float,
    backend: str = "auto",
) -> None:
    """Add `lr * noise_scale * covariance_noise(...)` to `means` [N, 3] in place.

    lr is a number, or 0-d; on a GPU it is read there, when the step runs.

    Raises:
        RuntimeError: `backend="cuda"` where the kernel cannot run.
        ValueError: the shapes or dtypes do not fit (the kernel's; torch has its own words).
    """
    if not uses_kernel(backend, means.device, means.dtype, means.shape[1]):
        means += covariance_noise(scales, quats, opacities, eta) * (lr * noise_scale)
        return
    rows = means.shape[0]
    vectors = {"scales": (scales, (rows, 3)), "quats": (quats, (rows, 4)), "eta": (eta, (rows, 3))}
    logits = opacities.reshape(-1), (rows,)
    cuda.check_alike("add_covariance_noise", means, opacities=logits, **vectors)
    if isinstance(lr, Tensor) and lr.is_cuda:
        rate, factor = lr.to(torch.float32), noise_scale
    else:
        rate, factor = 0, noise_scale * float(lr)  # a null pointer
    target = means.contiguous()
    tensors = (tensor.contiguous() for tensor in (scales, quats, opacities, eta))
    numbers = map(cuda.real(means.dtype), (factor, GATE_SHARPNESS, GATE_OPACITY))
    count = np.int64(rows)
    cuda.launch("add_covariance_noise", means, rows, target, *tensors, rate, *numbers, count)
    if target is not means:
        means.copy_(target)


def largest_noise(scales: Tensor, opacities: Tensor, noise_scale: float) -> Tensor:
    """The largest noise of any Gaussian, in learning rates of the positions, 0-d.

    Along a Gaussian's longest axis its deviation is lr * noise_scale * gate * s^2 (eq. 2), and an
    Adam step is about lr. Arguments as in `add_covariance_noise`.
    """
    if scales.numel() == 0:
        return scales.new_zeros(())
    return noise_scale * (_gate(opacities) * (2 * scales.amax(1)).exp()).amax()


def _gate(opacities: Tensor) -> Tensor:
    opacity = torch.sigmoid(opacities.reshape(-1))
    return torch.sigmoid(-GATE_SHARPNESS * (opacity - GATE_OPACITY))


def _noise(scales: Tensor, quats: Tensor, opacities: Tensor, eta: Tensor) -> Tensor:
    """`covariance_noise` as [3, N]."""
    q = columns(quats, quats.dtype)
    # clamp: as torch.nn.functional.normalize
    w, *axis = (q / (q * q).sum(0).sqrt().clamp(min=1e-12)).unbind()
    # R^T eta: rotation by the conjugate quaternion; then the variances; then R.
    local = _rotate(w, [-a for a in axis], list(columns(eta, eta.dtype).unbind()))
    variance = (2 * columns(scales, scales.dtype)).exp().unbind()
    shaped = [a * b for a, b in zip(variance, local, strict=True)]
    gate = _gate(opacities)
    return torch.stack([v * gate for v in _rotate(w, axis, shaped)])


def _rotate(w: Tensor, q: list[Tensor], v: list[Tensor]) -> list[Tensor]:
    """Rotate v by the unit quaternion (w, q): v + w t + q x t with t = 2 q x v."""
    t = [2 * component for component in _cross(q, v)]
    return [a + w * b + c for a, b, c in zip(v, t, _cross(q, t), strict=True)]


def _cross(a: list[Tensor], b: list[Tensor]) -> list[Tensor]:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]
