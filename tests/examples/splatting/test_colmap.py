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


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras", "7 OPENCV 40 24 50 50 20 12 0 0 0 0", "OPENCV.*colmap image_undistorter"),
        ("cameras", "7 PINHOLE 40 24 50 50", "PINHOLE camera with 2 parameters"),
        ("cameras", "7 PINHOLE 40", "expected ID MODEL WIDTH HEIGHT PARAMS, got '7 PINHOLE 40'"),
        ("cameras", "7 PINHOLE 0 24 50 50 20 12", "impossible camera 0x24"),
        ("images", "3 1 0 0 0 0 0 0", "expected ID QW QX QY QZ"),
        ("images", "3 1 0 0 0 0 0 0 99 a.png", "image a.png has camera 99, known are"),
        ("images", "3 0 0 0 0 0 0 0 7 a.png", "impossible pose"),
        ("points3D", "1 2 3", "expected ID X Y Z R G B ERROR, got '1 2 3'"),
        ("points3D", "1 2 3 x 4 5 6", "expected ID X Y Z"),
    ],
)
def test_malformed_text_is_named(tmp_path, name, text, message):
    folder = write_scene(tmp_path / "s", "txt")
    (folder / "sparse" / f"{name}.txt").write_text(text + "\n")
    with pytest.raises(ValueError, match=rf"{name}.txt: .*{message}"):
        load_scene(folder)


def test_distorted_binary_camera_tells_to_undistort(tmp_path):
    folder = write_scene(tmp_path / "s", "bin")
    path = folder / "sparse" / "0" / "cameras.bin"
    path.write_bytes(struct.pack("<QIiQQ4d", 1, 7, 2, 40, 24, 50, 20, 12, 0.1))
    with pytest.raises(ValueError, match=r"cameras.bin: camera model number 2; .*undistorter"):
        load_scene(folder)
