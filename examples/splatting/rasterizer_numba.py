"""The compiled rasterizer as one differentiable torch function.

The kernels compute in float64 whatever the parameters' dtype: at this size memory traffic does
not matter, there is one compilation instead of two, and a float32 image differs from the float64
reference by its last rounding only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatting.camera import Camera
from splatting.compositing_numba import (
    composite_backward,
    composite_forward,
    list_runs,
    moments_backward,
)
from splatting.projection import slope_limits
from splatting.projection_numba import project_backward, project_forward
from splatting.spherical_harmonics_numba import colors_backward, colors_forward


def _array(tensor: Tensor) -> np.ndarray:
    """A float64 copy, so that an optimizer's step before `backward` changes no gradient."""
    copy = tensor.detach().to(torch.float64, copy=True, memory_format=torch.contiguous_format)
    return copy.numpy()


def _lens(camera: Camera) -> np.ndarray:
    x_limits, y_limits = slope_limits(camera)
    return np.array([[camera.fx, camera.cx, *x_limits], [camera.fy, camera.cy, *y_limits]])


class RasterizeNumba(torch.autograd.Function):
    """Gaussians and background to image [H, W, 3], alpha [H, W], visible [N]; see `render`."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,  # [N] logit
        sh0: Tensor,
        shN: Tensor,
        background: Tensor,
        camera: Camera,
        degree: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        arrays = [_array(t) for t in (means, quats, scales, sh0, shN, background)]
        means_, quats_, scales_, sh0_, shN_, background_ = arrays
        alphas = torch.sigmoid(opacities.detach().double()).numpy()
        viewmat, viewpoint = _array(camera.viewmat), _array(camera.to(torch.float64).position)
        lens, size = _lens(camera), (camera.width, camera.height)
        means2d, covariances, determinants, depths, visible = project_forward(
            means_, quats_, scales_, alphas, viewmat, lens, *size
        )
        colors = colors_forward(means_, viewpoint, sh0_, shN_, degree, visible)
        order = np.flatnonzero(visible)
        order = order[np.argsort(depths[order], kind="stable")]
        runs = list_runs(order, means2d, covariances, determinants, alphas, *size)
        pixels, finished = composite_forward(*runs, colors, *size)
        ctx.camera_arrays = viewmat, viewpoint, lens, degree
        ctx.points = arrays, alphas, means2d, covariances, determinants, visible, colors
        ctx.pixels = runs, pixels[:, 3], finished, size
        ctx.dtype = means.dtype
        image = pixels[:, :3] + pixels[:, 3:] * background_
        visible = torch.from_numpy(visible.copy())
        ctx.mark_non_differentiable(visible)
        shape = (camera.height, camera.width)
        return (
            torch.from_numpy(image).to(means.dtype).reshape(*shape, 3),
            torch.from_numpy(1 - pixels[:, 3]).to(means.dtype).reshape(shape),
            visible,
        )

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor, _: Tensor) -> Any:  # type: ignore[override]
        viewmat, viewpoint, lens, degree = ctx.camera_arrays
        arrays, alphas, means2d, covariances, determinants, visible, colors = ctx.points
        means, quats, scales, sh0, shN, background = arrays
        runs, transmittance, finished, size = ctx.pixels
        by_image = _array(grad_image).reshape(-1, 3)
        by_alpha = _array(grad_alpha).reshape(-1)
        by_colors, moments = composite_backward(
            by_image,
            transmittance.copy(),
            transmittance * (by_image @ background - by_alpha),
            finished,
            *runs,
            means2d,
            colors,
            size[0],
        )
        by_means2d, by_covariances = moments_backward(moments, covariances, determinants, visible)
        by_means, by_quats, by_scales = project_backward(
            by_means2d, by_covariances, means, quats, scales, viewmat, lens, visible
        )
        by_sh0, by_shN, by_means_color = colors_backward(
            by_colors, colors, means, viewpoint, sh0, shN, degree, visible
        )
        # alpha = opacity exp(-e): opacity d/d(opacity) = -d/de; the sigmoid adds 1 - opacity.
        by_logits = np.where(visible, -moments[:, 0] * (1 - alphas), 0)
        grads = (
            by_means + by_means_color,
            by_quats,
            by_scales,
            by_logits,
            by_sh0,
            by_shN,
            transmittance @ by_image,
        )
        return *(torch.from_numpy(grad).to(ctx.dtype) for grad in grads), None, None
