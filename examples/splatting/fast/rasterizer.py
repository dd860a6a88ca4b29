"""The compiled rasterizer as one differentiable torch function.

All that is computed per point is float64, of the visible points only; all per pixel is float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatting.camera import Camera
from splatting.fast.colors import colors_backward, colors_forward
from splatting.fast.points import points_backward, project_points
from splatting.fast.tiles import (
    composite_backward,
    composite_forward,
    depth_order,
    list_points,
    prepare_splats,
    splats_backward,
)
from splatting.projection import slope_limits


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _lens(camera: Camera) -> np.ndarray:
    x_limits, y_limits = slope_limits(camera)
    return np.array([[camera.fx, camera.cx, *x_limits], [camera.fy, camera.cy, *y_limits]])


class Rasterize(torch.autograd.Function):
    """Gaussians and background to what a `Rendering` is made of; see `render`."""

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
        offset: Tensor | None,
        camera: Camera,
        degree: int,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        arrays = [_array(t) for t in (means, quats, scales, opacities)]
        pose = camera.to(torch.float64)
        viewmat, viewpoint, lens = _array(pose.viewmat), _array(pose.position), _lens(camera)
        visible, index, geometry = project_points(
            *arrays, viewmat, lens, camera.width, camera.height
        )
        # Copies of the visible points, so that a step before `backward` changes no gradient.
        points = [_array(t)[index] for t in (means, quats, scales, sh0, shN)]
        colors = colors_forward(points[0], viewpoint, points[3], points[4], degree)
        splats = prepare_splats(geometry, colors, camera.height)
        order = depth_order(geometry[:, 6].copy())
        lists = list_points(order, splats, geometry, camera.width, camera.height)
        behind = _array(background).astype(np.float64)
        image, alpha, transmittance, blended, stops = composite_forward(
            *lists, splats, behind, camera.width, camera.height
        )
        ctx.camera_arrays = viewmat, viewpoint, lens, degree
        ctx.points = index, geometry, points, colors, splats, len(means)
        ctx.pixels = behind, transmittance, blended, stops, lists
        found = torch.from_numpy(visible), torch.from_numpy(geometry[:, :6])
        ctx.mark_non_differentiable(*found)
        return torch.from_numpy(image), torch.from_numpy(alpha), *found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_image: Tensor, grad_alpha: Tensor, *_: Tensor) -> Any:  # type: ignore[override]
        viewmat, viewpoint, lens, degree = ctx.camera_arrays
        index, geometry, points, colors, splats, count = ctx.points
        means, quats, scales, _, shN = points
        background, transmittance, blended, stops, (starts, entries) = ctx.pixels
        sums, by_background = composite_backward(
            _array(grad_image),
            _array(grad_alpha),
            background,
            transmittance,
            blended,
            starts,
            stops,
            entries,
            splats,
        )
        by_means2d, by_covariances, by_logits = splats_backward(sums, splats, geometry)
        by_means, by_quats, by_scales = points_backward(
            by_means2d, by_covariances, means, quats, scales, viewmat, lens
        )
        by_sh0, by_shN, by_means_color = colors_backward(
            sums[:, 6:9], colors, means, viewpoint, shN, degree, index, count
        )

        def of_all(grad: np.ndarray) -> Tensor:
            everything = np.zeros((count, *grad.shape[1:]), np.float32)
            everything[index] = grad
            return torch.from_numpy(everything)

        of_points = map(of_all, (by_means + by_means_color, by_quats, by_scales, by_logits))
        of_colors = map(torch.from_numpy, (by_sh0, by_shN))
        by_offset = of_all(by_means2d) if ctx.needs_input_grad[7] else None
        by_all = torch.from_numpy(by_background).float(), by_offset
        return *of_points, *of_colors, *by_all, None, None
