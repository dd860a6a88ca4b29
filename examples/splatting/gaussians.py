"""Gaussians as a dict of parameters: how they start, and their learning rates.

Keys and activations are gsplat's: `means` [N, 3] world units, `scales` [N, 3] log, `quats` [N, 4]
wxyz, not normalised, `opacities` [N] logit, `sh0` [N, 1, 3] and, from SH degree 1 on, `shN`
[N, K - 1, 3], with K = (degree + 1)^2 coefficients a channel.
"""

from __future__ import annotations

import math
from typing import TypedDict

import torch
from torch import Tensor
from torch.nn import Parameter

from splatting.spherical_harmonics import SH_0

Gaussians = dict[str, Parameter]


class InitPreset(TypedDict):
    """Options of `gaussians_from_points`."""

    init_opacity: float
    init_scale: float


MCMC_PRESET: InitPreset = {"init_opacity": 0.5, "init_scale": 0.1}  # 3dgs-mcmc, gsplat's "mcmc"
DEFAULT_PRESET: InitPreset = {"init_opacity": 0.1, "init_scale": 1.0}  # INRIA, gsplat's "default"

_MIN_SQUARED_DISTANCE = 1e-7  # world units squared; INRIA's bound, keeps coincident points finite


def gaussians_from_points(
    points: Tensor,
    colors: Tensor,
    *,
    num_points: int | None = None,
    sh_degree: int = 0,
    init_opacity: float = 0.5,
    init_scale: float = 0.1,
    generator: torch.Generator | None = None,
) -> Gaussians:
    """One round Gaussian a point, as wide as its neighbours are far (3DGS; gsplat `sfm`).

    Args:
        points: [P, 3], world units.
        colors: [P, 3], 0..1.
        num_points: keep a random subset of at most so many; None keeps all.
        sh_degree: 0..3; what is above the constant term starts at zero.
        init_opacity: after the sigmoid.
        init_scale: factor on the root mean square distance to the three nearest neighbours. The
            defaults of both are those of MCMC trainers, `DEFAULT_PRESET` has the others.
        generator: for the subset; None is torch's global one.

    Returns:
        leaf parameters of the dtype of `points`.
    """
    if num_points is not None and num_points < len(points):
        kept = torch.randperm(len(points), generator=generator)[:num_points]
        points, colors = points[kept], colors[kept]
    count, dtype = len(points), points.dtype
    # gsplat starts from random rotations and INRIA from none: a round Gaussian looks the same.
    quats = torch.zeros(count, 4, dtype=dtype)
    quats[:, 0] = 1.0
    tensors = {
        "means": points.clone(),
        "scales": torch.log(neighbour_distance(points) * init_scale)[:, None].repeat(1, 3),
        "quats": quats,
        "opacities": torch.full((count,), math.log(init_opacity / (1 - init_opacity)), dtype=dtype),
        "sh0": ((colors.to(dtype) - 0.5) / SH_0)[:, None],
    }
    if sh_degree > 0:
        tensors["shN"] = torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3, dtype=dtype)
    return {key: Parameter(tensor) for key, tensor in tensors.items()}


def neighbour_distance(points: Tensor, chunk: int = 512) -> Tensor:
    """Root mean square distance to the (up to) three nearest other points, [P], world units.

    Exact search, P^2 distances in chunks of rows. A lone point has no neighbour and gets 1.
    """
    neighbours = min(3, len(points) - 1)
    if neighbours == 0:
        return torch.ones(len(points), dtype=points.dtype)
    squared = torch.empty(len(points), dtype=points.dtype)
    for start in range(0, len(points), chunk):
        # The matrix product form of cdist loses small distances to cancellation.
        distances = torch.cdist(
            points[start : start + chunk], points, compute_mode="donot_use_mm_for_euclid_dist"
        )
        nearest = distances.topk(neighbours + 1, largest=False).values[:, 1:]  # [0] is itself
        squared[start : start + chunk] = nearest.square().mean(dim=1)
    return squared.clamp(min=_MIN_SQUARED_DISTANCE).sqrt()


def stock_learning_rates(extent: float) -> dict[str, float]:
    """Adam's learning rate for each parameter, as in 3DGS and gsplat.

    That of the means is the initial one; trainers let it decay to 1 % over the run.

    Args:
        extent: `Scene.extent`, world units.
    """
    return {
        "means": 1.6e-4 * extent,
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 2.5e-3 / 20,
    }
