"""The embedded scene: reproducible, anti-aliased, and consistent between cameras and points."""

from __future__ import annotations

import functools

import torch
from splatting.embedded import embedded_scene
from splatting.scenes import Scene, load_scene


@functools.cache
def _small() -> Scene:
    return embedded_scene()


def test_views_and_sizes():
    scene = _small()
    assert (len(scene.train), len(scene.test)) == (24, 4)
    names = [view.name for view in (*scene.train, *scene.test)]
    assert len(set(names)) == 28
    for view in (*scene.train, *scene.test):
        assert view.image.shape == (72, 96, 3)
        assert (view.camera.height, view.camera.width) == (72, 96)
        assert view.image.dtype == torch.float32
        assert 0.0 <= view.image.min() < view.image.max() <= 1.0
        rotation = view.camera.viewmat[:3, :3].double()
        # 1e-6: the pose was rounded to float32
        torch.testing.assert_close(
            rotation @ rotation.T, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-6
        )
        assert torch.linalg.det(rotation) > 0


def test_load_scene_makes_it_by_name_with_the_same_bits():
    first, second = _small(), load_scene("embedded")
    assert torch.equal(first.points, second.points)
    assert torch.equal(first.colors, second.colors)
    for one, other in zip(first.train, second.train, strict=True):
        assert torch.equal(one.image, other.image)


def _project(points: torch.Tensor, camera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    x, y, z = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(1)
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, z


def test_points_lie_where_the_photos_show_their_colours():
    scene = _small()
    assert scene.points.shape == scene.colors.shape == (2000, 3)
    assert 0.0 <= scene.colors.min() < scene.colors.max() <= 1.0
    per_view = torch.arange(2000).tensor_split(24)  # each view saw its share, in order
    matched, shuffled = [], []
    for view, rows in zip(scene.train, per_view, strict=True):
        column, row, depth = _project(scene.points[rows], view.camera)
        assert depth.min() > 2.0  # nothing stands nearer to a camera
        inside = (column >= 0) & (column < 96) & (row >= 0) & (row < 72)
        assert inside.float().mean() > 0.95  # position noise moves few over the border
        pixels = view.image[row[inside].long(), column[inside].long()]
        colors = scene.colors[rows][inside]
        matched.append((pixels - colors).abs().mean(dim=1))
        shuffled.append((pixels - colors.roll(1, 0)).abs().mean(dim=1))
    # A pixel averages the texture that a point samples, which is what is left here.
    assert torch.cat(matched).mean() < 0.4 * torch.cat(shuffled).mean()
    assert torch.cat(matched).median() < 0.06
