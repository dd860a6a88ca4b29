"""View-dependent colour from real spherical harmonics of degree 0 to 3, in plain torch.

Source: Ramamoorthi and Hanrahan, "An Efficient Representation for Irradiance Environment Maps"
(2001), eq. 3, for degrees 0 to 2, and Sloan, "Stupid Spherical Harmonics Tricks" (2008),
appendix A2, for degree 3. The signs are those of 3D Gaussian Splatting and gsplat: odd orders
carry the Condon-Shortley factor -1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

MAX_DEGREE = 3

# Normalisation of each basis function, named by degree; orders m and -m share it.
SH_0 = math.sqrt(1 / (4 * math.pi))
SH_1 = math.sqrt(3 / (4 * math.pi))
SH_2_0 = math.sqrt(5 / (16 * math.pi))
SH_2_1 = math.sqrt(15 / (4 * math.pi))
SH_2_2 = math.sqrt(15 / (16 * math.pi))
SH_3_0 = math.sqrt(7 / (16 * math.pi))
SH_3_1 = math.sqrt(21 / (32 * math.pi))
SH_3_2 = math.sqrt(105 / (16 * math.pi))
SH_3_3 = math.sqrt(35 / (32 * math.pi))


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """The basis functions [N, (degree + 1)^2] at unit directions [N, 3].

    Ordered by degree, then by order from -degree to degree.
    """
    x, y, z = directions.unbind(-1)
    columns = [torch.full_like(x, SH_0)]
    if degree >= 1:
        columns += [-SH_1 * y, SH_1 * z, -SH_1 * x]
    if degree >= 2:
        columns += [
            SH_2_1 * x * y,
            -SH_2_1 * y * z,
            SH_2_0 * (3 * z * z - 1),
            -SH_2_1 * x * z,
            SH_2_2 * (x * x - y * y),
        ]
    if degree >= 3:
        columns += [
            -SH_3_3 * y * (3 * x * x - y * y),
            2 * SH_3_2 * x * y * z,
            -SH_3_1 * y * (5 * z * z - 1),
            SH_3_0 * z * (5 * z * z - 3),
            -SH_3_1 * x * (5 * z * z - 1),
            SH_3_2 * z * (x * x - y * y),
            -SH_3_3 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(columns, -1)


def sh_colors(
    means: Tensor,  # [N, 3] world units
    viewpoint: Tensor,  # [3] camera centre, world units
    coefficients: Tensor,  # [N, K, 3] with K >= (degree + 1)^2
    degree: int,
) -> Tensor:
    """The colours [N, 3] that a viewpoint sees: max(SH + 0.5, 0), not limited to 1."""
    directions = functional.normalize(means - viewpoint, dim=-1)
    basis = sh_basis(directions, degree)
    colors = (basis[:, :, None] * coefficients[:, : basis.shape[1]]).sum(1)
    return torch.clamp_min(colors + 0.5, 0)
