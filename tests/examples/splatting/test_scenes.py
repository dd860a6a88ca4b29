"""Scene loading: two layouts that must agree, splits, sizes, and errors that name the file.

The captures next to the repository are read too where they are present.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scene_files import (
    HEIGHT,
    PINHOLE,
    POINTS,
    WIDTH,
    image_names,
    poses,
    quat_to_rotation,
    write_scene,
)
from splatting.colmap import read_colmap
from splatting.scenes import load_scene
from splatting.transforms import read_transforms

_SHARED = Path(__file__).resolve().parents[4] / "shared" / "scenes"
_REAL = ("banana", "brighton_beach", "lund_door", "plush")


@pytest.mark.parametrize("background", ["black", "white"])
def test_what_a_photo_shows_through_is_the_background(tmp_path, background):
    """NeRF-synthetic's photos are transparent around the object."""
    folder = write_scene(tmp_path / "toy", "json")
    for path in (folder / "images").glob("*.png"):
        pixels = np.array(Image.open(path).convert("RGBA"))
        pixels[:, : WIDTH // 2, 3], pixels[0, 0, 3] = 0, 128
        Image.fromarray(pixels).save(path)
    scene = load_scene(folder, "images", background=background)
    for view in (*scene.train, *scene.test):
        behind = scene.background.expand_as(view.image[:, : WIDTH // 2])
        assert torch.equal(view.image[1:, : WIDTH // 2], behind[1:])
        assert not torch.equal(
            view.image[:, WIDTH // 2 :], torch.zeros(()).expand(HEIGHT, WIDTH - WIDTH // 2, 3)
        )


@pytest.mark.parametrize("layout", ["bin", "json"])
@pytest.mark.parametrize(("size", "scale"), [("images_4", 0.25), ("images", 1.0)])
def test_every_layout_gives_the_scene_that_was_written(tmp_path, layout, size, scale):
    scene = load_scene(write_scene(tmp_path / "toy", layout), size)
    assert scene.name == "toy"
    assert [view.name for view in scene.test] == ["photo_00.png", "photo_08.png"]
    assert [view.name for view in scene.train] == [
        image_names(10)[i] for i in (1, 2, 3, 4, 5, 6, 7, 9)
    ]
    table = torch.tensor(POINTS, dtype=torch.float32)
    assert torch.equal(scene.points, table[:, :3])
    torch.testing.assert_close(scene.colors, table[:, 3:] / 255)
    positions = []
    for view in (*scene.train, *scene.test):
        quat, shift = poses(10)[image_names(10).index(view.name)]
        camera = view.camera
        expected = torch.eye(4)
        expected[:3, :3] = torch.from_numpy(quat_to_rotation(quat))
        expected[:3, 3] = torch.tensor(shift)
        torch.testing.assert_close(camera.viewmat, expected)
        got = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        assert got == tuple(scale * number for number in (*PINHOLE, WIDTH, HEIGHT))
        assert view.image.shape == (camera.height, camera.width, 3)
        assert view.image.dtype == torch.float32
        folder = tmp_path / "toy" / size
        pixels = torch.from_numpy(np.array(Image.open(folder / view.name)))
        assert torch.equal((view.image * 255).round().byte(), pixels)
        if view in scene.train:
            positions.append(-quat_to_rotation(quat).T @ np.array(shift))
    offsets = np.array(positions) - np.mean(positions, axis=0)
    # 1e-6: float32 poses
    assert scene.extent == pytest.approx(1.1 * np.linalg.norm(offsets, axis=1).max(), rel=1e-6)


def test_colmap_is_preferred(tmp_path):
    folder = write_scene(write_scene(tmp_path / "s", "bin"), "json")
    (folder / "transforms.json").write_text("{")
    assert len(load_scene(folder).train) == 8


def test_too_few_photos_are_told(tmp_path):
    with pytest.raises(
        ValueError, match="needs at least 2 train views and a test view, got 1 and 1"
    ):
        load_scene(write_scene(tmp_path / "s", "json", count=2))


def test_bad_images_are_named(tmp_path):
    folder = write_scene(tmp_path / "s", "bin")
    path = folder / "images_4" / "photo_03.png"
    Image.new("RGB", (10, 9)).save(path)
    with pytest.raises(ValueError, match=r"photo_03.png: image is 10x9, .*40x24"):
        load_scene(folder)
    path.write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"photo_03.png: expected an image"):
        load_scene(folder)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"photo_03.png: missing"):
        load_scene(folder)
    shutil.rmtree(folder / "images_4")
    with pytest.raises(FileNotFoundError, match=r"images_4: missing.*size='images_4'"):
        load_scene(folder)


def test_too_few_views_and_cameras_at_one_place(tmp_path):
    with pytest.raises(ValueError, match="got 1 and 1 of 2 views"):
        load_scene(write_scene(tmp_path / "two", "bin", count=2))
    folder = write_scene(tmp_path / "still", "json", count=4)
    path = folder / "transforms.json"
    table = json.loads(path.read_text())
    for frame in table["frames"]:
        frame["transform_matrix"] = np.eye(4).tolist()
    path.write_text(json.dumps(table))
    with pytest.raises(ValueError, match=r"train cameras span 0.0, expected distinct positions"):
        load_scene(folder)
    path.write_text(json.dumps({**table, "frames": 3 * table["frames"][:1]}))
    with pytest.raises(ValueError, match=r"listed more than once: \['photo_00.png'\]"):
        load_scene(folder)


def test_bad_sources_and_options(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere is no folder; expected one, or 'embed"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"expected sparse/0/ \(COLMAP\) or transforms"):
        load_scene(tmp_path)
    (tmp_path / "sparse").mkdir()
    with pytest.raises(FileNotFoundError, match="expected cameras, images and points3D"):
        load_scene(tmp_path)
    with pytest.raises(ValueError, match=r"size='big', allowed are \('images', 'images_2',"):
        load_scene(tmp_path, "big")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", _REAL)
def test_both_readers_agree_on_a_capture(name):
    if not (_SHARED / name).is_dir():
        pytest.skip(f"no capture at {_SHARED / name}")
    colmap = read_colmap(_SHARED / name / "sparse" / "0")
    transforms = read_transforms(_SHARED / name)
    ours, theirs = ({image.name: image for image in m.images} for m in (colmap, transforms))
    assert ours.keys() == theirs.keys()
    for key, one in ours.items():
        # transforms.json took a detour over a float64 inverse
        np.testing.assert_allclose(one.viewmat, theirs[key].viewmat, rtol=0, atol=1e-5)
        for field in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(one, field) == pytest.approx(getattr(theirs[key], field), rel=1e-12)
    np.testing.assert_array_equal(np.float32(colmap.points), np.float32(transforms.points))
    np.testing.assert_array_equal(colmap.colors, transforms.colors)
