"""Random Gaussians, for the tests of the rasterizer."""

from __future__ import annotations

import torch
from torch import Tensor


def synthetic_scene(points: int, degree: int, seed: int = 0) -> dict[str, Tensor]:
    """A cube of `points` Gaussians, each about as wide as the mean distance between them."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    spacing = 2.0 * max(points, 1) ** (-1 / 3)
    return {
        "means": 2 * torch.rand(points, 3, generator=generator) - 1,
        "quats": normal(points, 4),
        "scales": 0.3 * normal(points, 3) + torch.log(torch.tensor(0.3 * spacing)),
        "opacities": 1.5 * normal(points),
        "sh0": normal(points, 1, 3),
        "shN": 0.1 * normal(points, (degree + 1) ** 2 - 1, 3),
    }
