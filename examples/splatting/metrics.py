"""Image metrics and the photometric training loss of 3D Gaussian Splatting."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import conv2d

PixelLoss = Callable[[Tensor, Tensor], Tensor]

RADIUS, SIGMA = 5, 1.5
_HALF = [math.exp(-0.5 * (offset / SIGMA) ** 2) for offset in range(RADIUS + 1)]
WINDOW = [weight / (_HALF[0] + 2 * sum(_HALF[1:])) for weight in (*_HALF[:0:-1], *_HALF)]
_C1, _C2 = 0.01**2, 0.03**2  # (K1 L)^2 and (K2 L)^2 of Wang et al. 2004, dynamic range L = 1


@lru_cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """`WINDOW` on a device; a copy to a GPU waits for all that is queued there."""
    return torch.tensor(WINDOW, dtype=dtype, device=device)


def _blur(maps: Tensor) -> Tensor:
    """The zero-padded Gaussian window over images [..., H, W, C]."""
    window = _window(maps.dtype, maps.device)
    planes = maps.movedim(-1, -3)
    flat = planes.reshape(-1, 1, *planes.shape[-2:])
    flat = conv2d(flat, window.view(1, 1, -1, 1), padding=(RADIUS, 0))
    flat = conv2d(flat, window.view(1, 1, 1, -1), padding=(0, RADIUS))
    return flat.reshape(planes.shape).movedim(-3, -1)


def psnr(render: Tensor, target: Tensor) -> Tensor:
    """Peak signal to noise ratio in dB, 10 log10(1 / mse), of images [..., H, W, C] in 0..1.

    Returns [...], one number an image: papers average these, not the errors.
    """
    return -10.0 * torch.log10((render - target).square().mean(dim=(-3, -2, -1)))


def ssim_map(render: Tensor, target: Tensor) -> Tensor:
    """Structural similarity at every pixel and channel, differentiable (twice).

    Window 11x11, Gaussian with sigma 1.5, zero padding: what the 3DGS papers compute. At least
    5 pixels away from the border it equals scikit-image's `structural_similarity` with
    `gaussian_weights=True, sigma=1.5, use_sample_covariance=False`. All are [..., H, W, C].
    """
    moments = (render, target, render * render, target * target, render * target)
    mu_r, mu_t, rr, tt, rt = _blur(torch.stack(moments))
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
        pixel_loss_fn: replaces the mean absolute error, takes `(render, target)` and returns a
            scalar; `PhaseScheduler.pixel_loss` fits (L1 while exploring, L2 while exploiting).
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

    return MeanSimilarity.apply(render, target, WINDOW, (_C1, _C2))  # pyright: ignore
