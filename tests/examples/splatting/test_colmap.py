"""COLMAP models: pinhole cameras, and an error that names every malformed file."""

from __future__ import annotations

import struct

import pytest
from scene_files import write_binary, write_images, write_scene
from splatting.scenes import load_scene


def test_simple_pinhole_has_one_focal_length(tmp_path):
    write_images(tmp_path, 4)
    write_binary(tmp_path / "sparse" / "0", 4, model=0)
    camera = load_scene(tmp_path, "images").train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 50.0, 19.0, 12.5)


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_truncated_and_padded_binaries_are_named(tmp_path, stem):
    folder = write_scene(tmp_path / "s", "bin")
    path = folder / "sparse" / "0" / f"{stem}.bin"
    whole = path.read_bytes()
    for cut in (0, 4, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=rf"{stem}.bin: truncated"):
            load_scene(folder)
    path.write_bytes(whole + b"\0\0")
    with pytest.raises(ValueError, match=rf"{stem}.bin: 2 bytes too many"):
        load_scene(folder)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=rf"{stem}.bin: missing"):
        load_scene(folder)


def test_impossible_cameras_and_unknown_ones_are_named(tmp_path):
    folder = write_scene(tmp_path / "s", "bin")
    path = folder / "sparse" / "0" / "cameras.bin"
    for camera, width, message in (
        (7, 0, r"image photo_00.png: impossible camera \(50.0, 48.0, 0, 24\)"),
        (8, 40, r"images.bin: image photo_00.png has camera 7, known are \[8\]"),
    ):
        path.write_bytes(struct.pack("<QIiQQ4d", 1, camera, 1, width, 24, 50, 48, 19, 12.5))
        with pytest.raises(ValueError, match=message):
            load_scene(folder)


def test_distorted_binary_camera_tells_to_undistort(tmp_path):
    folder = write_scene(tmp_path / "s", "bin")
    path = folder / "sparse" / "0" / "cameras.bin"
    path.write_bytes(struct.pack("<QIiQQ4d", 1, 7, 2, 40, 24, 50, 20, 12, 0.1))
    with pytest.raises(ValueError, match=r"cameras.bin: camera model number 2; .*undistorter"):
        load_scene(folder)
