"""The examples' rasterizer as trainers call theirs: activated values, 2D gradients, any camera."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from splatting.camera import Camera
from splatting.rasterizer import render
from splatting.spherical_harmonics import SH_0, sh_colors
from torch import Tensor


class Drawn(NamedTuple):
    """A rendering, and what density control asks for."""

    image: Tensor  # [H, W, 3]
    alpha: Tensor  # [H, W]
    visible: Tensor  # [N] bool
    means2d: Tensor  # [N, 2] pixels, without gradients
    radii: Tensor  # [N] pixels, three standard deviations, 0 where not visible
    depths: Tensor  # [N] world units, with gradients


def draw(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Tensor | None = None,
    offset: Tensor | None = None,
) -> Drawn:
    """Render Gaussians given by their activated values.

    The Gaussians are moved into the camera's frame first, so that the pose gets gradients from
    any rasterizer.

    Args:
        means: [N, 3] world units.
        quats: [N, 4] wxyz.
        scales: [N, 3] world units.
        opacities: [N] in 0..1.
        colors: [N, 3], at least 0.
        camera: whose pose may carry gradients.
        background: [3].
        offset: [N, 2] pixels, zeros whose gradient is that of the projected means.
    """
    rotation, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    inside = means @ rotation.T + shift
    camera = replace(camera, viewmat=torch.eye(4, dtype=means.dtype))  # looks along z
    gaussians = {
        "means": inside,
        "quats": _product(_quaternion(rotation), quats),
        "scales": scales.clamp(min=1e-20).log(),
        "opacities": torch.logit(opacities.clamp(1e-7, 1 - 1e-7)),
        "sh0": ((colors - 0.5) / SH_0)[:, None],
    }
    got = render(gaussians, camera, sh_degree=0, background=background, offset=offset)
    return Drawn(got.image, got.alpha, got.visible, got.means2d, got.radii, inside[:, 2])


def view_colors(means: Tensor, coefficients: Tensor, degree: int, camera: Camera) -> Tensor:
    """Colours [N, 3] of spherical harmonics [N, K, 3] up to a degree, seen from a camera."""
    return sh_colors(means, camera.position, coefficients[:, : (degree + 1) ** 2], degree)


def _quaternion(rotation: Tensor) -> Tensor:
    """wxyz of a rotation matrix [3, 3], not normalised: the best conditioned of four forms."""
    m = rotation
    (a, b, c), (d, e, f), (g, h, i) = m[0], m[1], m[2]
    forms = [
        torch.stack([1 + a + e + i, h - f, c - g, d - b]),
        torch.stack([h - f, 1 + a - e - i, b + d, c + g]),
        torch.stack([c - g, b + d, 1 - a + e - i, f + h]),
        torch.stack([d - b, c + g, f + h, 1 - a - e + i]),
    ]
    return forms[int(torch.stack([form[k] for k, form in enumerate(forms)]).argmax())]


def _product(left: Tensor, right: Tensor) -> Tensor:
    """left [4] times each of right [N, 4], wxyz."""
    w, x, y, z = (left / left.norm()).unbind()
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return right @ torch.stack([torch.stack(row) for row in rows]).T
