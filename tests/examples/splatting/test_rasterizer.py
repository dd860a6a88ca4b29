"""The examples' rasterizer: the reference against closed forms, the compiled one against it."""

from __future__ import annotations

import math

import pytest
import torch
from raster_scene import synthetic_scene
from splatting.camera import Camera
from splatting.projection import rotation_matrices
from splatting.rasterizer import Backend, render
from splatting.spherical_harmonics import SH_0
from torch import Tensor

BACKENDS: tuple[Backend, ...] = ("reference", "fast")
# The fast twin is float32; what it gives is compared within its rounding.
DTYPES = {"reference": torch.float64, "fast": torch.float32}


def look_at_origin(width: int = 24, height: int = 17, dtype: torch.dtype = torch.float64) -> Camera:
    """A camera that is special in nothing: turned, off-centre, fx != fy."""
    viewmat = torch.eye(4, dtype=dtype)
    quat = torch.tensor([[0.9, 0.3, -0.2, 0.1]], dtype=dtype)
    viewmat[:3, :3] = rotation_matrices(quat)[0]
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 3.0], dtype=dtype)
    return Camera(viewmat, 1.1 * width, 1.2 * width, 0.47 * width, 0.55 * height, width, height)


def straight_camera(size: int = 9) -> Camera:
    """At the origin, looking along z, the principal point at the centre of the middle pixel."""
    return Camera(torch.eye(4).double(), 10.0, 10.0, size / 2, size / 2, size, size)


def scene(points: int, degree: int, seed: int = 0) -> dict[str, Tensor]:
    return {k: v.double() for k, v in synthetic_scene(points, degree, seed).items()}


def one_point(depth: float = 2.0, color: float = 0.8, opacity: float = 0.6) -> dict[str, Tensor]:
    """A sphere of radius 0.1 on the axis of `straight_camera`."""
    return {
        "means": torch.tensor([[0.0, 0.0, depth]]).double(),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).double(),
        "scales": torch.full((1, 3), math.log(0.1)).double(),
        "opacities": torch.logit(torch.tensor([opacity]).double()),
        "sh0": torch.full((1, 1, 3), (color - 0.5) / SH_0).double(),
    }


def as_read(gaussians: dict[str, Tensor], backend: Backend) -> dict[str, Tensor]:
    """In the backend's precision."""
    return {name: value.to(DTYPES[backend]) for name, value in gaussians.items()}


def stack(*scenes: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: torch.cat([s[name] for s in scenes]) for name in scenes[0]}


def image_and_gradients(
    gaussians: dict[str, Tensor],
    camera: Camera,
    backend: Backend,
    dtype: torch.dtype,
    sh_degree: int | None = None,
) -> dict[str, Tensor]:
    """What a rendering has, and the gradients of a random functional of image and alpha."""
    leaves = {k: v.to(dtype).clone().requires_grad_() for k, v in gaussians.items()}
    leaves["background"] = torch.tensor([0.2, 0.5, 0.9], dtype=dtype, requires_grad=True)
    leaves["offset"] = torch.zeros(len(leaves["means"]), 2, dtype=dtype, requires_grad=True)
    rendering = render(
        leaves,
        camera,
        background=leaves["background"],
        offset=leaves["offset"],
        backend=backend,
        sh_degree=sh_degree,
    )
    generator = torch.Generator().manual_seed(7)
    weights = torch.randn(camera.height, camera.width, 4, generator=generator).to(dtype)
    (
        (rendering.image * weights[..., :3]).sum() + (rendering.alpha * weights[..., 3]).sum()
    ).backward()
    result = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    assert result.keys() == leaves.keys()
    for name in ("image", "alpha", "visible", "means2d", "radii"):
        result[name] = getattr(rendering, name).detach()
    return result


def assert_close(actual: dict[str, Tensor], expected: dict[str, Tensor], tolerance: float) -> None:
    """Largest difference below tolerance times largest value, for each entry."""
    assert torch.equal(actual["visible"], expected["visible"])
    for name in expected.keys() - {"visible"}:
        assert actual[name].shape == expected[name].shape
        assert torch.isfinite(actual[name]).all(), name
        if expected[name].numel() == 0:
            continue
        difference = (actual[name].double() - expected[name].double()).abs().max()
        assert difference <= tolerance * expected[name].abs().max().clamp(min=1e-3), name


# Known answers


@pytest.mark.parametrize("backend", BACKENDS)
def test_single_gaussian(backend: Backend):
    background = torch.tensor([0.1, 0.2, 0.3]).double()
    gaussians = as_read(one_point(), backend)
    rendering = render(gaussians, straight_camera(), background=background, backend=backend)
    # Variance: (focal * radius / depth)^2 + blur.
    variance = (10 * 0.1 / 2) ** 2 + 0.3
    offsets = torch.arange(9).double() - 4
    squares = offsets[:, None] ** 2 + offsets**2
    alpha = 0.6 * torch.exp(-squares / (2 * variance))
    alpha[alpha < 1 / 255] = 0
    # The opacity and the colour of the scene pass through float32.
    torch.testing.assert_close(rendering.alpha.double(), alpha, rtol=2e-6, atol=1e-7)
    expected = alpha[..., None] * 0.8 + (1 - alpha[..., None]) * background
    torch.testing.assert_close(rendering.image.double(), expected, rtol=2e-6, atol=1e-7)
    assert rendering.visible.tolist() == [True]


# Gradients


@pytest.mark.parametrize("degree", range(4))
def test_gradcheck(degree: int):
    gaussians = scene(4, degree, seed=degree)
    gaussians["sh0"] = gaussians["sh0"].abs()  # no colour near 0, where max(., 0) has a kink
    camera = look_at_origin(5, 4)
    names = [*gaussians, "background", "offset"]
    inputs = [*gaussians.values(), torch.tensor([0.3, 0.6, 0.9]).double()]
    inputs.append(torch.zeros(4, 2).double())

    def function(*values: Tensor) -> tuple[Tensor, Tensor]:
        named = dict(zip(names, values, strict=True))
        behind, offset = named["background"], named["offset"]
        rendering = render(named, camera, background=behind, offset=offset, backend="reference")
        return rendering.image, rendering.alpha

    leaves = [value.requires_grad_() for value in inputs]
    assert render(gaussians, camera).visible.all()
    assert torch.autograd.gradcheck(function, leaves)


@pytest.mark.parametrize("backend", BACKENDS)
def test_means2d_and_radii_of_a_sphere(backend: Backend):
    spheres = stack(one_point(), one_point(depth=-2.0))  # the other is behind the camera
    rendering = render(as_read(spheres, backend), straight_camera(), backend=backend)
    assert rendering.means2d.tolist() == [[4.5, 4.5], [0.0, 0.0]]
    # 10 pixels of focal length, 0.1 at a distance of 2, and 0.3 pixels^2 of blur.
    # The two axes differ by nothing, of which the rasterizers make sqrt(0.1).
    expected = math.ceil(3 * math.sqrt(0.25 + 0.3 + math.sqrt(0.1)))
    assert rendering.radii.tolist() == [expected, 0.0]


def test_reference_differentiates_the_camera():
    gaussians, camera = scene(3, 1), look_at_origin(5, 4)

    def function(viewmat: Tensor) -> Tensor:
        moved = Camera(viewmat, camera.fx, camera.fy, camera.cx, camera.cy, 5, 4)
        return render(gaussians, moved, backend="reference").image

    assert torch.autograd.gradcheck(function, [camera.viewmat.requires_grad_()])


# The compiled rasterizer against the reference


def behind_and_beside() -> dict[str, Tensor]:
    gaussians = scene(80, 3)
    gaussians["means"] = 8 * gaussians["means"]  # the camera is at a distance of 3
    return gaussians


def extreme_scales() -> dict[str, Tensor]:
    gaussians = scene(80, 2)
    gaussians["scales"][::4] += 6
    gaussians["scales"][1::4] -= 20
    gaussians["scales"][2::8, 0] += 5  # needles
    gaussians["scales"][3::8, 1] -= 10  # discs
    gaussians["scales"][5::8] += 20
    gaussians["opacities"] -= 2
    return gaussians


def saturated_opacities() -> dict[str, Tensor]:
    gaussians = scene(80, 1)
    gaussians["opacities"][::2] = 20.0
    gaussians["opacities"][1::2] *= 3
    gaussians["opacities"][::5] = -20.0
    return gaussians


def identical_depths() -> dict[str, Tensor]:
    """Planes of equal depth: their points must be blended in the order in which they are given."""
    gaussians = scene(80, 0)
    rotation = look_at_origin().viewmat[:3, :3]
    points = gaussians["means"] @ rotation.T
    points[:, 2] = (2 * points[:, 2]).round() / 2
    # Exactly equal in floating point too: all of a plane at one place.
    points[:, :2] = 0.3 * points[:, 2:]
    gaussians["means"] = points @ rotation
    return gaussians


SCENES = {
    "no points": lambda: scene(0, 3),
    "one point": lambda: scene(1, 3),
    "7 points": lambda: scene(7, 2),
    "1000 points": lambda: scene(1000, 3),
    "no shN": lambda: {k: v for k, v in scene(50, 0).items() if k != "shN"},
    "behind and beside": behind_and_beside,
    "extreme scales": extreme_scales,
    "saturated opacities": saturated_opacities,
    "identical depths": identical_depths,
}


def assert_twins_agree(gaussians: dict[str, Tensor], camera: Camera, tolerance: float) -> None:
    """The fast twin against the float64 reference, from the same float32 numbers."""
    rounded = {name: value.float() for name, value in gaussians.items()}
    camera = camera.to(torch.float32)
    exact = {name: value.double() for name, value in rounded.items()}
    expected = image_and_gradients(exact, camera.to(torch.float64), "reference", torch.float64)
    assert_close(image_and_gradients(rounded, camera, "fast", torch.float32), expected, tolerance)


@pytest.mark.parametrize("name", SCENES)
def test_fast_agrees_with_reference(name: str):
    # float32 sums of float32 products: about 5e-7, and 2e-6 where scales are extreme. A pixel on
    # the wrong side of a threshold would exceed this a hundred times.
    assert_twins_agree(SCENES[name](), look_at_origin(), 1e-5)


@pytest.mark.parametrize("size", [(1, 1), (1, 13), (37, 2), (8, 8), (65, 47)])
def test_fast_agrees_at_odd_image_sizes(size: tuple[int, int]):
    assert_twins_agree(scene(40, 1), look_at_origin(*size), 1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(8))
def test_fast_agrees_where_thousands_of_edges_pass_pixels(seed: int):
    """Large Gaussians of many layers: alpha >= 1/255 is decided as in float64, pixel by pixel."""
    gaussians = scene(600, 1, seed)
    gaussians["scales"] += 1.0
    assert_twins_agree(gaussians, look_at_origin(72, 50), 1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_lower_sh_degree_ignores_higher_harmonics(backend: Backend):
    gaussians, camera = as_read(scene(20, 3), backend), look_at_origin()
    full = image_and_gradients(gaussians, camera, backend, DTYPES[backend], sh_degree=1)
    assert torch.equal(full["shN"][:, 3:], torch.zeros_like(full["shN"][:, 3:]))
    assert full["shN"][:, :3].abs().max() > 0
    truncated = {**gaussians, "shN": gaussians["shN"][:, :3]}
    expected = render(truncated, camera, backend=backend).image
    assert torch.equal(render(gaussians, camera, backend=backend, sh_degree=1).image, expected)


def test_step_before_backward_changes_no_gradient():
    gaussians, camera = as_read(scene(20, 1), "fast"), look_at_origin()
    leaves = [value.requires_grad_() for value in gaussians.values()]
    image = render(gaussians, camera).image
    expected = torch.autograd.grad(image.sum(), leaves, retain_graph=True)
    with torch.no_grad():
        for leaf in leaves:
            leaf.add_(1)
    actual = torch.autograd.grad(image.sum(), leaves)
    assert all(torch.equal(a, b) for a, b in zip(actual, expected, strict=True))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("name", "value"), [("means", math.nan), ("scales", math.inf), ("opacities", math.nan)]
)
def test_broken_point_is_invisible(name: str, value: float, backend: Backend):
    gaussians, camera = scene(10, 1), look_at_origin()
    gaussians[name][3] = value
    result = image_and_gradients(gaussians, camera, backend, DTYPES[backend])
    assert not result["visible"][3]
    assert all(torch.isfinite(tensor).all() for tensor in result.values())


# Errors


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"quats": torch.zeros(5, 3)}, r"quats is \(\(5, 3\), .* must be \(\(5, 4\)"),
        ({"sh0": torch.zeros(4, 1, 3)}, r"sh0 is \(\(4, 1, 3\), .* must be \(\(5, 1, 3\)"),
        ({"shN": torch.zeros(5, 4, 3)}, r"shN has shape \(5, 4, 3\).*K \[0, 3, 8, 15\]"),
        ({"scales": torch.zeros(5, 3).half()}, r"scales is .*torch.float16.* must be .*float32"),
    ],
)
def test_wrong_gaussians_are_refused(changes: dict[str, Tensor], message: str):
    with pytest.raises(ValueError, match=f"^render: {message}"):
        render({**synthetic_scene(5, 1), **changes}, look_at_origin())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sh_degree": 2}, "sh_degree is 2, must be from 0 to the stored 1"),
        ({"background": torch.zeros(4)}, r"background has shape \(4,\), must be \(3,\)"),
        ({"offset": torch.zeros(4, 2)}, r"offset is \(4, 2\), must be \(5, 2\)"),
        ({"backend": "cuda"}, "backend is 'cuda', must be one of"),
    ],
)
def test_wrong_options_are_refused(options: dict, message: str):
    with pytest.raises(ValueError, match=f"^render: {message}"):
        render(synthetic_scene(5, 1), look_at_origin(), **options)


def test_what_the_fast_twin_cannot_render_is_refused():
    camera = look_at_origin()
    with pytest.raises(ValueError, match=r'"fast" with means torch.float64 on cpu, must be'):
        render(scene(5, 1), camera, backend="fast")
    camera.viewmat.requires_grad_()
    with pytest.raises(ValueError, match="requires_grad True"):
        render(as_read(scene(5, 1), "fast"), camera, backend="fast")


def test_auto_takes_the_fast_twin_where_it_can():
    camera = look_at_origin()
    cases: tuple[tuple[torch.dtype, Backend], ...] = (
        (torch.float32, "fast"),
        (torch.float64, "reference"),
    )
    for dtype, backend in cases:
        gaussians = {name: value.to(dtype) for name, value in scene(30, 1).items()}
        expected = render(gaussians, camera, backend=backend).image
        assert torch.equal(render(gaussians, camera).image, expected)
