"""The rasterizer that stands in for the trainers' own, against the examples' itself."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hosts.cpu_host.gsplat_modules import rasterize
from hosts.cpu_host.rendering import draw
from raster_scene import synthetic_scene
from splatting.camera import Camera
from splatting.projection import rotation_matrices
from splatting.rasterizer import render
from splatting.spherical_harmonics import SH_0
from torch import Tensor


def camera() -> Camera:
    viewmat = torch.eye(4)
    viewmat[:3, :3] = rotation_matrices(torch.tensor([[0.9, 0.3, -0.2, 0.1]]))[0]
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 3.0])
    return Camera(viewmat, 26.0, 29.0, 11.3, 9.4, 24, 17)


def activated(gaussians: dict[str, Tensor]) -> Any:
    """Means, quats, scales, opacities and colours, as trainers hand them to a rasterizer."""
    colors = (SH_0 * gaussians["sh0"][:, 0] + 0.5).clamp(min=0)
    opacities = torch.sigmoid(gaussians["opacities"])
    return [gaussians["means"], gaussians["quats"], gaussians["scales"].exp(), opacities, colors]


def gradients(image: Tensor, *leaves: Tensor) -> tuple[Tensor, ...]:
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(7))
    return torch.autograd.grad((image * weights).sum(), leaves)


def test_draws_what_the_rasterizer_draws() -> None:
    gaussians = synthetic_scene(60, 0, 1)
    gaussians["means"][::7] *= 8  # behind and beside the camera
    offsets = [torch.zeros(60, 2, requires_grad=True) for _ in range(2)]
    expected = render(gaussians, camera(), sh_degree=0, offset=offsets[0])
    call: Any = draw
    drawn = call(*activated(gaussians), camera(), offset=offsets[1])
    assert torch.equal(drawn.visible, expected.visible)
    assert not drawn.visible.all()
    torch.testing.assert_close(drawn.image, expected.image, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(drawn.means2d, expected.means2d, rtol=1e-4, atol=1e-4)
    assert torch.equal(drawn.radii, expected.radii)
    (mine,), (its,) = gradients(drawn.image, offsets[1]), gradients(expected.image, offsets[0])
    torch.testing.assert_close(mine, its, rtol=1e-3, atol=1e-3 * float(its.abs().max()))


@pytest.mark.parametrize("packed", [False, True])
def test_gsplats_info_has_the_gradient_of_the_projected_means(packed: bool) -> None:
    gaussians, view = synthetic_scene(60, 0, 1), camera()
    gaussians["means"][::7] *= 8
    offset = torch.zeros(60, 2, requires_grad=True)
    expected = render(gaussians, view, sh_degree=0, offset=offset)
    (its,) = gradients(expected.image, offset)
    lens = torch.tensor([[view.fx, 0.0, view.cx], [0.0, view.fy, view.cy], [0.0, 0.0, 1.0]])
    pose, size = (view.viewmat[None], lens[None]), (view.width, view.height)
    call: Any = rasterize
    image, _, info = call(*activated(gaussians), *pose, *size, packed=packed)
    weights = torch.randn(image[0].shape, generator=torch.Generator().manual_seed(7))
    (image[0] * weights).sum().backward()
    if packed:
        its = its[info["gaussian_ids"]]
    else:
        assert info["radii"].shape == (1, 60, 2)
        its = its[None]
    torch.testing.assert_close(info["means2d"].grad, its, rtol=1e-3, atol=1e-3)
    assert its.any()
