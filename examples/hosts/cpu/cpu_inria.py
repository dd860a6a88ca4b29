"""The CUDA extensions of INRIA's trainer and its derivatives, as modules that run on a CPU."""

from __future__ import annotations

import sys
import types
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from cpu_gsplat import fused_ssim, masked_adam, relocation
from cpu_rendering import Drawn, draw, view_colors
from matplotlib.backends.backend_agg import FigureCanvasAgg
from splatting.camera import Camera
from splatting.gaussians import neighbour_distance
from torch import Tensor


@dataclass
class GaussianRasterizationSettings:
    """INRIA's settings, with the extra ones of its derivatives."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor  # [4, 4] transposed: row vectors
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    antialiasing: bool | None = None  # since 2024-10, which returns the inverse depth too
    pixel_weights: Any = "none"  # taming-3dgs, which returns importances too

    def view(self) -> Camera:
        """The camera, as the examples write it."""
        width, height = self.image_width, self.image_height
        fx, fy = width / (2 * self.tanfovx), height / (2 * self.tanfovy)
        return Camera(self.viewmatrix.T, fx, fy, width / 2, height / 2, width, height)


class GaussianRasterizer(torch.nn.Module):
    """INRIA's rasterizer; what it returns follows from the settings that the trainer gives."""

    extra: str | None = None  # what a derivative's module returns besides

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        dc: Tensor | None = None,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple:
        """Image [3, H, W], radii [N], and what the trainer's own module returns besides."""
        settings = self.raster_settings
        if cov3D_precomp is not None or scales is None or rotations is None:
            raise ValueError("the rasterizer on a CPU needs scales and rotations")
        view = settings.view()
        colors = colors_precomp
        if colors is None:
            coefficients = shs if dc is None else dc if shs is None else torch.cat([dc, shs], 1)
            assert coefficients is not None
            colors = view_colors(means3D, coefficients, settings.sh_degree, view)
        half = torch.tensor([view.width / 2, view.height / 2])
        offset = means2D[:, :2] * half if means2D.requires_grad else None
        if scales.shape[1] == 2:  # a disc
            scales = torch.cat([scales, torch.full_like(scales[:, :1], 1e-6)], 1)
        scales = scales * settings.scale_modifier
        geometry = (means3D, rotations, scales, opacities.reshape(-1))
        drawn = draw(*geometry, colors, view, settings.bg, offset)
        image, radii = drawn.image.permute(2, 0, 1), drawn.radii.int()
        if self.extra == "is_used":
            return image, radii, drawn.visible.float()
        if self.extra == "weights":
            weights = self._weights(geometry, view)
            return image, radii, weights, *self._areas(drawn, weights)
        if self.extra == "surfels":  # 2DGS: depth, alpha, normal and distortion, without gradients
            return image, radii, torch.ones(7, view.height, view.width)
        if settings.pixel_weights != "none":
            return image, radii, *self._taming(drawn, self._weights(geometry, view))
        if settings.antialiasing is not None:
            # The depth is for depth supervision only, which this rasterizer leaves out.
            return image, radii, torch.zeros(1, view.height, view.width)
        return image, radii

    @staticmethod
    def _weights(geometry: tuple[Tensor, ...], view: Camera) -> Tensor:
        """[N] the sum of each Gaussian's blending weights: the derivative by its colour."""
        with torch.enable_grad():
            still = [value.detach() for value in geometry]
            colors = torch.ones(len(still[0]), 3, requires_grad=True)
            image = draw(still[0], still[1], still[2], still[3], colors, view).image
            return torch.autograd.grad(image[..., 0].sum(), colors)[0][:, 0]

    @staticmethod
    def _areas(drawn: Drawn, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels that a Gaussian covers, and those where it is the strongest: both estimated."""
        area = torch.where(weights > 0, torch.pi * (drawn.radii / 3).square(), 0.0)
        return area.clamp(min=0.0), torch.minimum(area, weights)

    @staticmethod
    def _taming(drawn: Drawn, weights: Tensor) -> tuple:
        """taming-3dgs's eleven importances; all that are sums over pixels are the weights'."""
        counts = (weights > 0).float()
        none = torch.zeros(0)
        depths = drawn.depths.detach()
        lists = (none, none, none)
        sums = (weights, counts, weights, weights)
        return counts, *lists, drawn.means2d, depths, drawn.radii, *sums


class ImportanceRasterizer(GaussianRasterizer):
    """mini-splatting's, which returns weights and areas too."""

    extra = "weights"


class SurfelRasterizer(GaussianRasterizer):
    """2DGS's: thin Gaussians in the place of discs, and no depths or normals."""

    extra = "surfels"


class UsedRasterizer(GaussianRasterizer):
    """3dgs-mcmc's, which returns who was used too."""

    extra = "is_used"


class SparseGaussianAdam(torch.optim.Adam):
    """INRIA's Adam on the visible rows; like the original without bias correction."""

    def __init__(self, params: Any, lr: float, eps: float) -> None:
        super().__init__(params=params, lr=lr, eps=eps)

    @torch.no_grad()
    def step(self, visibility: Tensor, N: int) -> None:  # pyright: ignore
        """One step; parameters without a gradient are left alone."""
        for group in self.param_groups:
            (param,) = group["params"]
            if param.grad is None:
                continue
            state = self.state[param]
            if not state:
                state["step"] = torch.tensor(0.0)
                state["exp_avg"] = torch.zeros_like(param)
                state["exp_avg_sq"] = torch.zeros_like(param)
            if visibility.numel() != N or len(param) != N:
                raise RuntimeError(f"sparse Adam: {len(param)} rows, a mask of {N}")
            first, second, (beta1, beta2) = state["exp_avg"], state["exp_avg_sq"], group["betas"]
            rest = (visibility, group["lr"], beta1, beta2, group["eps"])
            masked_adam(param, param.grad, first, second, *rest)


def distCUDA2(points: Tensor) -> Tensor:  # noqa: N802 (its name)
    """[P] mean squared distance to the three nearest other points."""
    return neighbour_distance(points).square()


def install(folder: Path) -> None:
    """Put the modules that the trainer in `folder` needs into sys.modules."""
    mcmc = (folder / "utils" / "reloc_utils.py").is_file()
    usual = {
        "GaussianRasterizationSettings": GaussianRasterizationSettings,
        "GaussianRasterizer": UsedRasterizer if mcmc else GaussianRasterizer,
        "SparseGaussianAdam": SparseGaussianAdam,
        "compute_relocation": relocation,
    }
    _module("diff_gaussian_rasterization", **usual)
    _module(
        "diff_gaussian_rasterization_ms", **usual | {"GaussianRasterizer": ImportanceRasterizer}
    )
    _module("diff_surfel_rasterization", **usual | {"GaussianRasterizer": SurfelRasterizer})
    _module("simple_knn")
    _module("simple_knn._C", distCUDA2=distCUDA2)
    _module("fused_ssim", fused_ssim=fused_ssim)
    canvas: Any = FigureCanvasAgg  # 2DGS calls what matplotlib 3.10 has no more
    canvas.tostring_rgb = lambda self: np.asarray(self.buffer_rgba())[..., :3].tobytes()


def _module(name: str, **names: Any) -> None:
    module = types.ModuleType(name)
    module.__dict__.update(names)
    sys.modules[name] = module
