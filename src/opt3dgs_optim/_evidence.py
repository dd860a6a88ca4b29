"""What the parts of a training do to it, as numbers on the device: nothing here synchronises."""

from __future__ import annotations

import torch
from torch import Tensor

from opt3dgs_optim import _pairs, curvature
from opt3dgs_optim._columns import columns
from opt3dgs_optim._covariance import GATE_OPACITY, GATE_SHARPNESS
from opt3dgs_optim.energy import EnergyHistogram
from opt3dgs_optim.noise import CovarianceNoise, GaussianTensors


def foresight(
    history: Tensor,
    history_size: int,
    position: Tensor,
    gradient: Tensor,
    visible: Tensor | None = None,
) -> Tensor:
    """How much better the stored pairs foretell the pair that comes next than gamma I would.

    A pair (s, y) that a curvature matrix describes has H y = s. The pairs know something about a
    point if H y, with H from the pairs before this one, is closer to the direction of s than y
    itself is: cos(H y, s) - cos(y, s). Where y is mostly the difference between two views, or
    where the curvature is the same in all directions, it is 0: then Adam fed with the gradient
    does as well.

    Args:
        history: [N, slots, 2 (D + 1)] before the new pair is stored.
        history_size: K.
        position, gradient: [N, D] of this step.
        visible: [N] bool; None: where the gradient is finite and not 0.

    Returns:
        [2] float64 (float32 on MPS): sum of that difference over the points that hold a pair,
        and their number.
    """
    if visible is None:
        visible = (gradient != 0).any(1) & torch.isfinite(gradient).all(1)
    head = curvature.header(history, history_size)
    s = position.to(history.dtype) - head.position
    y = gradient.to(history.dtype) - head.gradient
    foretold = curvature.two_loop(y, history, history_size)
    s, y, foretold = (columns(each, history.dtype) for each in (s, y, foretold))
    gain = _cosine(foretold, s) - _cosine(y, s)
    known = visible & (head.counter > 1) & torch.isfinite(gain) & (s != 0).any(0) & (y != 0).any(0)
    summed = torch.stack([torch.where(known, gain, 0.0).sum(), known.sum().to(gain.dtype)])
    return summed.to(widest_float(summed.device))


def _cosine(a: Tensor, b: Tensor) -> Tensor:
    return _pairs.dot(a / _pairs.length(a), b / _pairs.length(b))


def largest_noise(scales: Tensor, opacities: Tensor, noise_scale: float) -> Tensor:
    """The largest noise of any Gaussian, in learning rates of the positions, 0-d.

    Noise is lr * noise_scale * gate * Sigma eta (eq. 2), so its deviation along the longest axis is
    lr * noise_scale * gate * s^2; an Adam step is about lr.

    Args:
        scales: [N, 3] log of the standard deviations.
        opacities: [N] or [N, 1] logits.
    """
    if scales.numel() == 0:
        return scales.new_zeros(())
    gate = torch.sigmoid(-GATE_SHARPNESS * (torch.sigmoid(opacities.reshape(-1)) - GATE_OPACITY))
    return noise_scale * (gate * (2 * scales.amax(1)).exp()).amax()


def noise_tensors(noise: CovarianceNoise) -> GaussianTensors:
    """The Gaussians' present tensors that the noise reads."""
    return noise.gaussians() if callable(noise.gaussians) else noise.gaussians


def nu_numbers(histogram: EnergyHistogram) -> Tensor:
    """[4]: energies since the warm-up, nu's mean and sum of squared deviations over them, and
    Theta's share in the open partition above the range.
    """
    return torch.cat([histogram.multiplier_moments, histogram.weights[-1:]])


def widest_float(device: torch.device) -> torch.dtype:
    """float64, where the device has it."""
    return torch.float32 if device.type == "mps" else torch.float64
