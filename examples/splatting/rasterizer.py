"""Rendering of 3D Gaussians: the public entry point, and the reference made of its plain parts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from splatting.camera import Camera
from splatting.compositing import composite
from splatting.projection import project, visible_points
from splatting.spherical_harmonics import MAX_DEGREE, sh_colors

Backend = Literal["auto", "reference", "fast"]
TRAILING_SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3)}


@dataclass(frozen=True)
class Rendering:
    """What `render` returns; `image` and `alpha` carry gradients."""

    image: Tensor  # [H, W, 3] linear in the colours, not limited to 1
    alpha: Tensor  # [H, W] in [0, 1)
    visible: Tensor  # [N] bool, projected inside the image with positive radius
    footprints: Tensor  # [V, 6] of the visible: mean x, y, covariance xx, xy, yy, its determinant

    @property
    def means2d(self) -> Tensor:
        """The projected means [N, 2] in pixels, 0 where not visible."""
        return self._of_all(self.footprints[:, :2])

    @property
    def radii(self) -> Tensor:
        """Three standard deviations along the longer axis [N], in whole pixels; 0: not visible."""
        middle = self.footprints[:, [2, 4]].mean(1)
        spread = (middle.square() - self.footprints[:, 5]).clamp(min=0.1).sqrt()
        return self._of_all((3 * (middle + spread).sqrt()).ceil())

    def _of_all(self, values: Tensor) -> Tensor:
        everything = self.image.new_zeros(len(self.visible), *values.shape[1:])
        everything[self.visible] = values.to(everything)
        return everything


def render(
    gaussians: Mapping[str, Tensor],
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    offset: Tensor | None = None,
    backend: Backend = "auto",
) -> Rendering:
    """Render Gaussians as gsplat 1.5.3 does with its defaults ("classic" mode, no antialiasing).

    Args:
        gaussians: means [N, 3] world units; quats [N, 4] wxyz, not normalised; scales [N, 3] log
            of world units; opacities [N] logit; sh0 [N, 1, 3] and, if there are any, shN
            [N, K - 1, 3] spherical harmonics with K = 1, 4, 9 or 16. All of one floating dtype.
            Other entries are ignored.
        camera: The pinhole camera.
        sh_degree: The highest degree of spherical harmonics to use; by default all there are.
        background: The colour [3] behind everything; by default black.
        offset: Zeros [N, 2], whose gradient will be that of the projected means, in 1 / pixels.
        backend: "fast", compiled, for float32 on the CPU with constant cameras; "reference",
            plain torch of any floating dtype on any device, whose memory grows as pixels times
            points, differentiable in the camera's pose too; or "auto", the fast one where it can.
            They agree within 1e-4 of the largest value, gradients too; in float32 the reference
            loses Gaussians so large that their variance squared overflows.

    Raises:
        ValueError: on a missing entry, wrong shape, dtype or device, sh_degree or backend.

    Source: 3D Gaussian Splatting (Kerbl et al. 2023, section 4 and 6).
    """
    degree = _check(gaussians, camera, sh_degree, backend)
    values = {name: gaussians[name] for name in TRAILING_SHAPES}
    values["shN"] = _higher_harmonics(gaussians)
    means = values["means"]
    if background is None:
        background = means.new_zeros(3)
    elif background.shape != (3,):
        raise ValueError(f"render: background has shape {tuple(background.shape)}, must be (3,)")
    background = background.to(means)
    if offset is not None and offset.shape != (len(means), 2):
        raise ValueError(f"render: offset is {tuple(offset.shape)}, must be ({len(means)}, 2)")
    if backend == "reference" or (backend == "auto" and _obstacle(means, camera)):
        return _render_reference(values, camera.to(means.dtype), degree, background, offset)
    from splatting.fast.rasterizer import Rasterize  # numba stays optional

    return Rendering(*Rasterize.apply(*values.values(), background, offset, camera, degree))


def _render_reference(
    values: Mapping[str, Tensor],
    camera: Camera,
    degree: int,
    background: Tensor,
    offset: Tensor | None,
) -> Rendering:
    means, quats, scales = values["means"], values["quats"], values["scales"]
    # Cull first and differentiate only what is left: a point behind the camera would otherwise
    # turn its zero gradient into 0 * inf = NaN.
    with torch.no_grad():
        everything = project(means, quats, scales, camera)
        visible = visible_points(everything, torch.sigmoid(values["opacities"]), camera)
    means, quats, scales = means[visible], quats[visible], scales[visible]
    projection = project(means, quats, scales, camera)
    coefficients = torch.cat([values["sh0"], values["shN"]], 1)[visible]
    image, alpha = composite(
        projection.means if offset is None else projection.means + offset[visible],
        projection.conics,
        sh_colors(means, camera.position, coefficients, degree),
        torch.sigmoid(values["opacities"][visible]),
        projection.depths,
        background=background,
        width=camera.width,
        height=camera.height,
    )
    ellipses = projection.covariances, projection.determinants[:, None]
    footprints = torch.cat([projection.means, *ellipses], 1).detach()
    return Rendering(image, alpha, visible, footprints)


def _higher_harmonics(gaussians: Mapping[str, Tensor]) -> Tensor:
    sh0 = gaussians["sh0"]
    return gaussians["shN"] if "shN" in gaussians else sh0.new_empty(len(sh0), 0, 3)


def _check(
    gaussians: Mapping[str, Tensor], camera: Camera, sh_degree: int | None, backend: str
) -> int:
    """Raise ValueError on unusable input; otherwise return the degree to use."""
    means, shN = gaussians["means"], _higher_harmonics(gaussians)
    counts = [(degree + 1) ** 2 - 1 for degree in range(MAX_DEGREE + 1)]
    if shN.dim() != 3 or shN.shape[1] not in counts:
        raise ValueError(f"render: shN has shape {tuple(shN.shape)}, must be (N, K, 3), K {counts}")
    for name, trailing in (TRAILING_SHAPES | {"shN": (shN.shape[1], 3)}).items():
        tensor = gaussians.get(name, shN)
        its = tuple(tensor.shape), tensor.dtype, tensor.device
        wanted = (len(means), *trailing), means.dtype, means.device
        if its != wanted:
            raise ValueError(f"render: {name} is {its}, must be {wanted}")
    if backend not in get_args(Backend):
        raise ValueError(f"render: backend is {backend!r}, must be one of {get_args(Backend)}")
    if backend == "fast" and (obstacle := _obstacle(means, camera)):
        raise ValueError(
            f'render: backend "fast" with {obstacle}, must be float32 on the CPU and a constant; '
            'the backend "reference" has neither limit'
        )
    stored = counts.index(shN.shape[1])
    degree = stored if sh_degree is None else sh_degree
    if degree not in range(stored + 1):
        raise ValueError(f"render: sh_degree is {sh_degree}, must be from 0 to the stored {stored}")
    return degree


def _obstacle(means: Tensor, camera: Camera) -> str | None:
    """What keeps the fast backend from rendering, if anything does."""
    if means.device.type != "cpu" or means.dtype != torch.float32:
        return f"means {means.dtype} on {means.device}"
    return "camera.viewmat.requires_grad True" if camera.viewmat.requires_grad else None
