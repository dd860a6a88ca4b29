"""Front-to-back alpha compositing of 2D Gaussians, in plain torch: every pixel sees every point.

Source: 3D Gaussian Splatting (Kerbl et al. 2023, eq. 3), with the thresholds of gsplat 1.5.3.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splatting.projection import ALPHA_MIN

ALPHA_MAX = 0.999  # keeps 1 - alpha, which the gradient divides by, away from zero
TRANSMITTANCE_MIN = 1e-4  # a pixel is finished before its transmittance gets here


def pixel_centres(width: int, height: int, like: Tensor) -> Tensor:
    """Pixel centres (x, y), [H * W, 2] in row-major order; the left-most is at 0.5."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([columns, rows], -1).reshape(-1, 2).to(like) + 0.5


def composite(
    means: Tensor,  # [N, 2] pixels
    conics: Tensor,  # [N, 3] 1/pixels^2, (xx, xy, yy)
    colors: Tensor,  # [N, 3]
    opacities: Tensor,  # [N] in (0, 1)
    depths: Tensor,  # [N]; points of equal depth keep their order
    *,
    background: Tensor,  # [3]
    width: int,
    height: int,
) -> tuple[Tensor, Tensor]:
    """Blend 2D Gaussians into an image [H, W, 3] and its alpha [H, W].

    Time and memory grow as pixels times points: for small scenes and for tests.
    """
    order = torch.argsort(depths, stable=True)
    means, conics, colors, opacities = (
        values[order] for values in (means, conics, colors, opacities)
    )
    x, y = (pixel_centres(width, height, means)[:, None] - means).unbind(-1)  # [P, N]
    xx, xy, yy = conics.unbind(-1)
    exponents = 0.5 * (xx * x * x + yy * y * y) + xy * x * y
    alphas = torch.clamp(opacities * torch.exp(-exponents), max=ALPHA_MAX)
    # Rounding can make the exponent of a needle-like Gaussian negative: no valid Gaussian.
    alphas = torch.where((alphas >= ALPHA_MIN) & (exponents >= 0), alphas, 0)
    # The point that would take the transmittance to the limit is left out, and all behind it.
    finished = torch.cumprod(1 - alphas.detach(), 1) <= TRANSMITTANCE_MIN
    alphas = torch.where(finished, 0, alphas)
    transmittances = torch.cumprod(1 - alphas, 1)  # [P, N], behind each point
    in_front = torch.cat([alphas.new_ones(len(alphas), 1), transmittances], 1)  # [P, N + 1]
    left = in_front[:, -1]
    image = (alphas * in_front[:, :-1]) @ colors + left[:, None] * background
    return image.reshape(height, width, 3), (1 - left).reshape(height, width)
