"""The embedded scene: a procedural toy garden, rendered on the spot, so nothing is downloaded."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch

from splatting import patterns
from splatting.camera import Camera
from splatting.raycast import Array, Box, Ground, Solid, Sphere, trace
from splatting.scenes import Scene, Size, View, scene_extent

_VIEWS, _TEST_EVERY, _FIRST_TEST = 28, 7, 3  # test views lie inside the orbit, not at its ends
_POINTS = 2000
_POINT_NOISE = 0.01  # world units, about what a good reconstruction of this size leaves
# Width, height and rays a side of each pixel: 16 and 4 rays, averaged, keep the edges smooth.
_SIZES = {"images": (256, 192, 2), "images_2": (128, 96, 4), "images_4": (96, 72, 4)}
SUN = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])


def embedded_scene(size: Size = "images_4", held_out: int | None = None) -> Scene:
    """Make the scene: 24 train and 4 test views around a garden of patterned toys.

    It has the same bits whenever one machine makes it. The world is a sky of radius 10 around toys
    of about 3 units, z is up, the cameras orbit at 4.2 to 5 units.

    Args:
        size: "images" is 256x192 pixels, "images_2" 128x96, "images_4" 96x72, from the same
            cameras.
        held_out: the test views are those whose index is this modulo 7; by default 3.
    """
    rng = np.random.default_rng(0)
    solids = _toys(rng)
    width, height, rays_a_side = _SIZES[size]
    cameras = [_orbit_camera(index, width, height) for index in range(_VIEWS)]
    views = [
        View(f"view_{index:02d}", camera, photo(solids, camera, rays_a_side))
        for index, camera in enumerate(cameras)
    ]
    first = _FIRST_TEST if held_out is None else held_out % _TEST_EVERY
    train = [view for i, view in enumerate(views) if i % _TEST_EVERY != first]
    test = [view for i, view in enumerate(views) if i % _TEST_EVERY == first]
    seeing = [view.camera for view in train]
    points, colors = sparse_points(solids, seeing, _POINTS, rng)
    extent = scene_extent(seeing)
    return Scene("embedded", train, test, points, colors, extent)


def _toys(rng: np.random.Generator) -> list[Solid]:
    rough, fine = patterns.Noise(rng, falloff=1.5), patterns.Noise(rng, falloff=0.9)
    return [
        Sphere((0.0, 0.0, -0.5), 10.0, partial(patterns.sky, rough), is_sky=True),
        Ground(partial(patterns.garden, rough, fine)),
        Sphere((0.75, -0.85, 0.55), 0.55, patterns.beach_ball),
        Sphere((-1.15, -0.65, 0.38), 0.38, patterns.checker_ball),
        Box((-0.1, 0.35, 0.5), (0.4, 0.4, 0.5), 0.35, partial(patterns.bricks, rough)),
        Sphere((-0.1, 0.35, 1.42), 0.42, partial(patterns.planet, rough)),
        Box((1.15, 0.55, 0.32), (0.32, 0.32, 0.32), -0.5, partial(patterns.gift, 0.32)),
        Box((-1.25, 0.75, 0.225), (0.5, 0.25, 0.225), 0.9, partial(patterns.planks, fine)),
        Sphere((-1.25, 0.75, 0.72), 0.27, partial(patterns.marble, rough)),
    ]


def _orbit_camera(index: int, width: int, height: int) -> Camera:
    angle = 2 * np.pi * index / _VIEWS
    elevation = np.radians(27 + 13 * np.sin(3 * angle + 0.5))  # three waves over one turn
    distance = 4.6 + 0.4 * np.cos(2 * angle)
    outward = np.array(
        [np.cos(angle) * np.cos(elevation), np.sin(angle) * np.cos(elevation), np.sin(elevation)]
    )
    target = np.array([0.0, 0.0, 0.68])
    right = np.cross(-outward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack((right, np.cross(-outward, right), -outward))  # x right, y down, z forward
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ (target + distance * outward)
    focal = 1.05 * width
    return Camera(
        torch.from_numpy(viewmat).float(), focal, focal, width / 2, height / 2, width, height
    )


def _look(
    solids: Sequence[Solid], camera: Camera, columns: Array, rows: Array
) -> tuple[Array, Array]:
    """Colours and points [3, n] seen at the pixel coordinates `columns` and `rows`, [n]."""
    x = (columns - camera.cx) / camera.fx
    y = (rows - camera.cy) / camera.fy
    directions = np.stack((x, y, np.ones_like(x))).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=0)
    rotation = camera.viewmat[:3, :3].numpy()
    return trace(solids, SUN, camera.position.numpy()[:, None], rotation.T @ directions)


def photo(solids: Sequence[Solid], camera: Camera, rays_a_side: int) -> torch.Tensor:
    """Render with a box filter over `rays_a_side` squared rays a pixel, [H, W, 3]."""
    columns = (np.arange(camera.width * rays_a_side) + 0.5) / rays_a_side
    rows = (np.arange(camera.height * rays_a_side) + 0.5) / rays_a_side
    grid = np.meshgrid(columns, rows)
    colors, _ = _look(solids, camera, grid[0].ravel(), grid[1].ravel())
    fine = colors.reshape(3, camera.height, rays_a_side, camera.width, rays_a_side)
    return torch.from_numpy(np.ascontiguousarray(fine.mean(axis=(2, 4)).transpose(1, 2, 0)))


def sparse_points(
    solids: Sequence[Solid], cameras: Sequence[Camera], total: int, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """`total` points on what cameras see, displaced a little, as from structure from motion."""
    counts = np.full(len(cameras), total // len(cameras))
    counts[: total % len(cameras)] += 1
    seen = [
        _look(solids, camera, rng.uniform(0, camera.width, n), rng.uniform(0, camera.height, n))
        for camera, n in zip(cameras, counts, strict=True)
    ]
    colors, points = (np.concatenate(part, axis=1).T for part in zip(*seen, strict=True))
    points = points + _POINT_NOISE * rng.standard_normal(points.shape)
    return torch.from_numpy(points).float(), torch.from_numpy(np.ascontiguousarray(colors)).float()
