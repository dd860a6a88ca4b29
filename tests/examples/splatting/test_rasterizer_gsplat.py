"""The reference rasterizer against gsplat's own torch functions, where gsplat is installed."""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import warnings

import pytest
import torch
import torch.utils.cpp_extension
from raster_scene import synthetic_scene
from splatting.camera import Camera
from splatting.projection import project, rotation_matrices, visible_points
from splatting.rasterizer import Backend, render
from splatting.spherical_harmonics import sh_colors
from torch import Tensor


def import_gsplat():
    """Import the torch functions quietly, and without gsplat building its CUDA extension."""
    try:
        with (
            pytest.MonkeyPatch.context() as patch,
            warnings.catch_warnings(),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            warnings.simplefilter("ignore")
            patch.setattr(torch.utils.cpp_extension, "_find_cuda_home", lambda: None)
            import gsplat.cuda._torch_impl as torch_impl  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        pytest.skip(f"needs gsplat 1.5: {error}", allow_module_level=True)
    return torch_impl


gsplat = import_gsplat()


def turned_camera() -> Camera:
    viewmat = torch.eye(4).double()
    viewmat[:3, :3] = rotation_matrices(torch.tensor([[0.9, -0.3, 0.2, 0.4]]).double())[0]
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 2.5])
    return Camera(viewmat, 20.0, 24.0, 11.0, 10.0, 26, 18)


def wide_scene(degree: int = 3) -> dict[str, Tensor]:
    """Points inside the image, beside it (beyond the Jacobian's clamp too), and behind it."""
    gaussians = {k: v.double() for k, v in synthetic_scene(300, degree).items()}
    gaussians["means"] = gaussians["means"] * 4
    gaussians["scales"] = gaussians["scales"] + 0.5
    return gaussians


def project_with_gsplat(gaussians: dict[str, Tensor], camera: Camera) -> tuple[Tensor, ...]:
    """Radii, means, depths and conics of each point."""
    covariances, _ = gsplat._quat_scale_to_covar_preci(
        gaussians["quats"], gaussians["scales"].exp(), compute_preci=False
    )
    assert covariances is not None
    intrinsics = torch.tensor(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    ).double()
    projected = gsplat._fully_fused_projection(
        gaussians["means"],
        covariances,
        camera.viewmat[None],
        intrinsics[None],
        camera.width,
        camera.height,
    )
    return tuple(tensor[0] for tensor in projected[:4])


def test_projection_and_its_gradients():
    gaussians, camera = wide_scene(), turned_camera()
    inputs = [gaussians[name].requires_grad_() for name in ("means", "quats", "scales")]
    projection = project(inputs[0], inputs[1], inputs[2], camera)
    radii, means, depths, conics = project_with_gsplat(gaussians, camera)
    front = depths > 0.01
    torch.testing.assert_close(projection.depths, depths)
    torch.testing.assert_close(projection.means[front], means[front])
    torch.testing.assert_close(projection.conics[front], conics[front])

    # With opacity 1 our alpha >= 1/255 is 3.329 sigma, gsplat's constant 3.33.
    visible = visible_points(projection, torch.ones(300).double(), camera)
    assert torch.equal(visible, (radii > 0).all(-1))
    # Visible points are among those whose Jacobian is clamped on each side, in x and in y.
    size = torch.tensor([camera.width, camera.height])
    clamped = torch.cat([means < -0.15 * size, means > 1.15 * size], -1)
    assert (visible[:, None] & clamped).any(0).all()

    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(int(visible.sum()), 5, generator=generator).double()

    def functional(means: Tensor, conics: Tensor) -> Tensor:
        return (torch.cat([means, conics], -1)[visible] * weights).sum()

    expected = torch.autograd.grad(functional(means, conics), inputs, retain_graph=True)
    actual = torch.autograd.grad(functional(projection.means, projection.conics), inputs)
    for a, b in zip(actual, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9 * b.abs().max().item())


@pytest.mark.parametrize("degree", range(4))
def test_colors(degree: int):
    gaussians, camera = wide_scene(), turned_camera()
    coefficients = torch.cat([gaussians["sh0"], gaussians["shN"]], 1)
    means = gaussians["means"]
    expected = gsplat._spherical_harmonics(degree, means - camera.position, coefficients)
    actual = sh_colors(means, camera.position, coefficients, degree)
    torch.testing.assert_close(actual, torch.clamp_min(expected + 0.5, 0))


@pytest.mark.parametrize("backend", ["reference", "fast"])
def test_image_from_gsplats_projection_and_colors(backend: Backend):
    """Its compositing needs a GPU (or nerfacc): here its rules stand in a loop."""
    gaussians, camera = wide_scene(), turned_camera()
    radii, means, depths, conics = project_with_gsplat(gaussians, camera)
    opacities = torch.sigmoid(gaussians["opacities"]).tolist()
    coefficients = torch.cat([gaussians["sh0"], gaussians["shN"]], 1)
    colors = gsplat._spherical_harmonics(3, gaussians["means"] - camera.position, coefficients)
    colors = torch.clamp_min(colors + 0.5, 0)
    kept = [i for i in torch.argsort(depths).tolist() if (radii[i] > 0).all()]
    image = torch.zeros(camera.height, camera.width, 3).double()
    for row, column in itertools.product(range(camera.height), range(camera.width)):
        transmittance = 1.0
        for i in kept:
            x, y = column + 0.5 - means[i, 0].item(), row + 0.5 - means[i, 1].item()
            a, b, c = conics[i].tolist()
            exponent = 0.5 * (a * x * x + c * y * y) + b * x * y
            alpha = min(0.999, opacities[i] * math.exp(-exponent))
            if exponent < 0 or alpha < 1 / 255:
                continue
            if transmittance * (1 - alpha) <= 1e-4:
                break
            image[row, column] += transmittance * alpha * colors[i]
            transmittance *= 1 - alpha
    if backend == "fast":
        gaussians = {name: value.float() for name, value in gaussians.items()}
    actual = render(gaussians, camera, backend=backend).image
    tolerance = 1e-9 if backend == "reference" else 1e-5
    torch.testing.assert_close(actual.double(), image, rtol=tolerance, atol=tolerance)
