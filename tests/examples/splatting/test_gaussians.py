"""Initial Gaussians and learning rates."""

from __future__ import annotations

import math

import pytest
import torch
from splatting.gaussians import (
    DEFAULT_PRESET,
    gaussians_from_points,
    neighbour_distance,
    stock_learning_rates,
)


def _cloud(count: int, dtype: torch.dtype = torch.float32):
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(count, 3, generator=generator, dtype=dtype)
    return points, torch.rand(count, 3, generator=generator, dtype=dtype)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 200])
def test_neighbour_distance_against_sorting_every_pair(count):
    points, _ = _cloud(count, torch.float64)
    expected = []
    for i in range(count):
        others = sorted(float((points[i] - points[j]).norm()) for j in range(count) if j != i)[:3]
        expected.append(math.sqrt(sum(d * d for d in others) / len(others)))
    # 1e-12: float64 rounding
    torch.testing.assert_close(
        neighbour_distance(points, chunk=7),
        torch.tensor(expected, dtype=torch.float64),
        rtol=1e-12,
        atol=0,
    )


def test_coincident_and_lone_points_stay_finite():
    points = torch.ones(5, 3)
    torch.testing.assert_close(neighbour_distance(points), torch.full((5,), math.sqrt(1e-7)))
    assert neighbour_distance(points[:1]).tolist() == [1.0]
    far = torch.tensor([[1000.0, 0, 0], [1000.001, 0, 0]])  # cancels in a matrix product
    expected = far[1, 0] - far[0, 0]
    torch.testing.assert_close(neighbour_distance(far), expected.repeat(2))


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
def test_shapes_and_activations(sh_degree):
    points, colors = _cloud(50)
    gaussians = gaussians_from_points(points, colors, sh_degree=sh_degree, **DEFAULT_PRESET)
    coefficients = (sh_degree + 1) ** 2
    shapes = {
        "means": (50, 3),
        "scales": (50, 3),
        "quats": (50, 4),
        "opacities": (50,),
        "sh0": (50, 1, 3),
    }
    if sh_degree:
        shapes["shN"] = (50, coefficients - 1, 3)
    assert {key: tuple(p.shape) for key, p in gaussians.items()} == shapes
    assert all(isinstance(p, torch.nn.Parameter) and p.is_leaf for p in gaussians.values())
    torch.testing.assert_close(torch.sigmoid(gaussians["opacities"]), torch.full((50,), 0.1))
    distance = neighbour_distance(points)
    torch.testing.assert_close(gaussians["scales"].exp(), distance[:, None].expand(50, 3))
    shown = 0.5 + 0.5 / math.sqrt(math.pi) * gaussians["sh0"][:, 0]
    torch.testing.assert_close(shown, colors)
    assert torch.equal(gaussians["quats"].detach(), torch.tensor([[1.0, 0, 0, 0]]).expand(50, 4))
    gaussians["means"].data.zero_()
    assert points.abs().sum() > 0  # the parameters are copies


def test_a_subset_follows_the_generator_and_keeps_points_with_their_colours():
    points, colors = _cloud(40)
    first, second = (
        gaussians_from_points(
            points, colors, num_points=15, generator=torch.Generator().manual_seed(1)
        )
        for _ in range(2)
    )
    assert torch.equal(first["means"], second["means"])
    assert len(first["means"]) == 15
    rows = [(points == mean).all(dim=1).nonzero()[0, 0] for mean in first["means"].detach()]
    assert len(set(map(int, rows))) == 15
    shown = 0.5 + 0.28209479177387814 * first["sh0"][:, 0]
    torch.testing.assert_close(shown, colors[torch.stack(rows)])
    assert len(gaussians_from_points(points, colors, num_points=99)["means"]) == 40


def test_stock_learning_rates():
    assert stock_learning_rates(4.0) == {
        "means": 4 * 1.6e-4,
        "scales": 5e-3,
        "quats": 1e-3,
        "opacities": 5e-2,
        "sh0": 2.5e-3,
        "shN": 1.25e-4,
    }
