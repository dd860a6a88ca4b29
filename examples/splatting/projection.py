"""EWA projection of 3D Gaussians to the image plane, in plain torch.

Source: Zwicker et al., "EWA Splatting" (2002), eq. 29-31 for the local affine approximation, as
used by 3D Gaussian Splatting (Kerbl et al. 2023, eq. 5-6). The constants and the clamp of the
Jacobian are those of gsplat 1.5.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from splatting.camera import Camera

BLUR = 0.3  # pixels^2, added to both variances: a Gaussian is never narrower than about a pixel
NEAR_PLANE = 0.01  # world units
FAR_PLANE = 1e10  # world units
FIELD_OF_VIEW_MARGIN = 0.3  # of half the field of view, on each side
ALPHA_MIN = 1 / 255  # a contribution below one grey level of an 8-bit image is skipped


@dataclass(frozen=True)
class Projection:
    """The 2D Gaussians that a camera sees."""

    means: Tensor  # [N, 2] pixels
    covariances: Tensor  # [N, 3] pixels^2, (xx, xy, yy), blur included
    determinants: Tensor  # [N] of the covariances
    depths: Tensor  # [N] camera z, world units

    @property
    def conics(self) -> Tensor:
        """The inverse covariances, [N, 3] as (xx, xy, yy)."""
        xx, xy, yy = self.covariances.unbind(-1)
        return torch.stack([yy, -xy, xx], -1) / self.determinants[:, None]


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] (wxyz, normalised here)."""
    w, x, y, z = functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def slope_limits(
    camera: Camera,
) -> tuple[tuple[float, float], tuple[float, float]]:
    """The range of x/z and of y/z within which the Jacobian is evaluated.

    These are the image borders, widened by a margin. Outside them the affine approximation
    degrades without bound, so the Jacobian (not the mean) is taken at the nearest point inside.
    """

    def limits(focal: float, centre: float, size: int) -> tuple[float, float]:
        margin = FIELD_OF_VIEW_MARGIN * 0.5 * size / focal
        return -centre / focal - margin, (size - centre) / focal + margin

    return (
        limits(camera.fx, camera.cx, camera.width),
        limits(camera.fy, camera.cy, camera.height),
    )


def perspective_jacobians(points: Tensor, camera: Camera) -> Tensor:
    """The derivative [N, 2, 3] of the pixel position by the camera-space position [N, 3]."""
    x, y, z = points.unbind(-1)
    x_limits, y_limits = slope_limits(camera)
    slope_x = torch.clamp(x / z, *x_limits)
    slope_y = torch.clamp(y / z, *y_limits)
    zero = torch.zeros_like(z)
    return torch.stack(
        [
            torch.stack([camera.fx / z, zero, -camera.fx * slope_x / z], -1),
            torch.stack([zero, camera.fy / z, -camera.fy * slope_y / z], -1),
        ],
        -2,
    )


def project(
    means: Tensor,  # [N, 3] world units
    quats: Tensor,  # [N, 4] wxyz, not normalised
    scales: Tensor,  # [N, 3] log of world units
    camera: Camera,
) -> Projection:
    """Project Gaussians to the image plane (Zwicker et al. 2002, eq. 31).

    Points at or behind the camera plane give meaningless, possibly non-finite, numbers; see
    `visible_points`.
    """
    rotation, translation = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    points = means @ rotation.T + translation
    x, y, depths = points.unbind(-1)
    means2d = torch.stack(
        [camera.fx * x / depths + camera.cx, camera.fy * y / depths + camera.cy], -1
    )
    # Sigma' = (J W R S)(J W R S)^T: the 3D covariance itself is never needed.
    to_image = perspective_jacobians(points, camera) @ rotation
    factors = to_image @ (rotation_matrices(quats) * scales.exp()[:, None, :])
    first, second = factors.unbind(-2)
    xx = (first * first).sum(-1)
    xy = (first * second).sum(-1)
    yy = (second * second).sum(-1)
    # xx * yy - xy^2 as a sum of squares (Lagrange's identity): needle-like Gaussians would
    # otherwise lose all digits of the determinant, and its sign, in float32.
    area = torch.linalg.cross(first, second).square().sum(-1)
    return Projection(
        means=means2d,
        covariances=torch.stack([xx + BLUR, xy, yy + BLUR], -1),
        determinants=area + BLUR * (xx + yy) + BLUR * BLUR,
        depths=depths,
    )


def visible_points(projection: Projection, opacities: Tensor, camera: Camera) -> Tensor:
    """Which points [N] (bool) can change a pixel, given their opacities [N] in (0, 1).

    The bounding box of the ellipse alpha >= 1/255 (Radl et al. 2024, "StopThePop", B.2), in whole
    pixels as in gsplat, must overlap the image, and the depth lie between near and far plane.
    """
    extent = torch.sqrt(2 * torch.log(torch.clamp(opacities / ALPHA_MIN, min=1)))  # sigmas
    variances = projection.covariances[:, [0, 2]]
    radii = torch.ceil(extent[:, None] * torch.sqrt(variances))  # pixels
    size = torch.tensor([camera.width, camera.height]).to(radii)
    overlaps = (projection.means + radii > 0) & (projection.means - radii < size) & (radii > 0)
    in_depth = (projection.depths > NEAR_PLANE) & (projection.depths < FAR_PLANE)
    return in_depth & overlaps.all(-1) & torch.isfinite(projection.determinants)
