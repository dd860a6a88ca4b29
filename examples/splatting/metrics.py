"""Image metrics and the photometric training loss of 3D Gaussian Splatting."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

PixelLoss = Callable[[Tensor, Tensor], Tensor]

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2  # (K1 L)^2 and (K2 L)^2 of Wang et al. 2004, dynamic range L = 1


def _half_window() -> list[float]:
    """Return weights of the normalised 1-D window, from its centre outwards, [6]."""
    radius = _WINDOW // 2
    weights = [math.exp(-0.5 * (offset / _SIGMA) ** 2) for offset in range(radius + 1)]
    total = weights[0] + 2 * sum(weights[1:])
    return [weight / total for weight in weights]


_HALF_WINDOW = _half_window()


def _blur_axis(maps: Tensor, dim: int) -> Tensor:
    # Shifted adds instead of a convolution: on one CPU core torch's depthwise convolution takes
    # several times as long. What falls outside the image is never added, which is zero padding.
    length = maps.shape[dim]
    blurred = maps * _HALF_WINDOW[0]
    for offset, weight in enumerate(_HALF_WINDOW[1:], start=1):
        overlap = length - offset
        if overlap <= 0:
            break
        low, high = maps.narrow(dim, 0, overlap), maps.narrow(dim, offset, overlap)
        blurred.narrow(dim, offset, overlap).add_(low, alpha=weight)
        blurred.narrow(dim, 0, overlap).add_(high, alpha=weight)
    return blurred


class _Blur(torch.autograd.Function):
    """The zero-padded Gaussian window; symmetric, so it is its own adjoint."""

    @staticmethod
    def forward(ctx: Any, maps: Tensor) -> Tensor:
        return _blur_axis(_blur_axis(maps, -2), -3)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        return _Blur.apply(grad_outputs[0])


def _blur(maps: Tensor) -> Tensor:
    return _Blur.apply(maps.contiguous())  # pyright: ignore[reportReturnType]


def psnr(render: Tensor, target: Tensor) -> Tensor:
    """Peak signal to noise ratio of each image in dB, 10 log10(1 / mse); inf where equal.

    Args:
        render: `[..., H, W, C]`, 0..1.
        target: the same shape.

    Returns:
        `[...]`, one number an image: papers average these, not the errors.
    """
    return -10.0 * torch.log10((render - target).square().mean(dim=(-3, -2, -1)))


def ssim_map(render: Tensor, target: Tensor) -> Tensor:
    """Structural similarity at every pixel and channel, differentiable (twice).

    Window 11x11, Gaussian with sigma 1.5, zero padding: what the 3DGS papers compute. At least
    5 pixels away from the border it equals scikit-image's `structural_similarity` with
    `gaussian_weights=True, sigma=1.5, use_sample_covariance=False`.

    Args:
        render: `[..., H, W, C]`, 0..1.
        target: the same shape.

    Returns:
        `[..., H, W, C]`, at most 1.
    """
    # Two calls, so that the backward pass does not blur the target's moments when it is constant.
    mu_r, rr, rt = _blur(torch.stack((render, render * render, render * target)))
    mu_t, tt = _blur(torch.stack((target, target * target)))
    mu_rt, mu_squares = mu_r * mu_t, mu_r * mu_r + mu_t * mu_t
    # Wang et al. 2004, eq. 13
    numerator = (2.0 * mu_rt + _C1) * (2.0 * (rt - mu_rt) + _C2)
    denominator = (mu_squares + _C1) * (rr + tt - mu_squares + _C2)
    return numerator / denominator


def ssim(render: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity of each image, `[...]`; see `ssim_map`."""
    return ssim_map(render, target).mean(dim=(-3, -2, -1))


def photometric_loss(
    render: Tensor, target: Tensor, pixel_loss_fn: PixelLoss | None = None
) -> Tensor:
    """0.8 * pixel loss + 0.2 * (1 - SSIM), the loss of 3DGS (Kerbl et al. 2023, eq. 7).

    Differentiable once in the render where that is one float32 image on the CPU and the target
    is a constant (a compiled SSIM, see `fast/similarity.py`), and otherwise as often as one likes.

    Args:
        render: `[..., H, W, C]`, 0..1.
        target: the same shape.
        pixel_loss_fn: replaces the mean absolute error, takes `(render, target)` and returns a
            scalar; `PhaseScheduler.pixel_loss` fits (L1 while exploring, L2 while exploiting).

    Returns:
        a scalar.
    """
    if pixel_loss_fn is None:
        pixel = (render - target).abs().mean()
    else:
        pixel = pixel_loss_fn(render, target)
    return 0.8 * pixel + 0.2 * (1.0 - _mean_ssim(render, target))


def _mean_ssim(render: Tensor, target: Tensor) -> Tensor:
    """The mean of `ssim_map`, compiled where that can be: one float32 image on the CPU."""
    compiled = render.dim() == 3 and render.device.type == target.device.type == "cpu"
    compiled = compiled and render.dtype == target.dtype == torch.float32
    if not compiled or target.requires_grad:
        return ssim_map(render, target).mean()
    from splatting.fast.similarity import MeanSimilarity  # numba stays optional

    return MeanSimilarity.apply(render, target, _HALF_WINDOW, (_C1, _C2))  # pyright: ignore
