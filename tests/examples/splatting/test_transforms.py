"""transforms.json: an error that names every malformed field and file."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from scene_files import write_scene
from splatting.scenes import load_scene


def _change(table: dict, key: str, value) -> dict:
    """Return the table with `key` replaced, at the top or in the first frame; None removes it."""
    target = table["frames"][0] if key in table["frames"][0] else table
    if value is None:
        del target[key]
    else:
        target[key] = value
    return table


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("frames", None, "expected a list under 'frames', got NoneType"),
        ("fl_x", math.nan, "impossible camera"),
        ("w", math.inf, "impossible camera"),
        ("k1", 0.1, "lens distortion {'k1': 0.1}.*colmap image_undistorter"),
        ("distortion_params", [0.1, 0.0], "lens distortion {'distortion_params'"),
        ("camera_model", "OPENCV_FISHEYE", "camera_model='OPENCV_FISHEYE', allowed are"),
        ("transform_matrix", [[1, 2], [3]], "frame 0: ValueError"),
        ("transform_matrix", np.diag([2.0, 2, 2, 1]).tolist(), "no rotation and translation"),
        ("transform_matrix", np.diag([1.0, 1, -1, 1]).tolist(), "no rotation and translation"),
        ("ply_file_path", "gone.ply", "gone.ply: missing"),
    ],
)
def test_malformed_transforms_are_named(tmp_path, key, value, message):
    folder = write_scene(tmp_path / "s", "json")
    path = folder / "transforms.json"
    path.write_text(json.dumps(_change(json.loads(path.read_text()), key, value)))
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_scene(folder)


@pytest.mark.parametrize(
    ("text", "message"), [("[1, 2]", "expected a JSON object, got list"), ("{", "not valid JSON")]
)
def test_bad_json_is_named(tmp_path, text, message):
    folder = write_scene(tmp_path / "s", "json")
    (folder / "transforms.json").write_text(text)
    with pytest.raises(ValueError, match=rf"transforms.json: {message}"):
        load_scene(folder)


def test_bad_point_clouds_are_named(tmp_path):
    folder = write_scene(tmp_path / "s", "json")
    path = folder / "points.ply"
    whole = path.read_bytes()
    for data in (b"ply\n", b"hello", whole[:-4], whole.replace(b"green", b"groen")):
        path.write_bytes(data)
        with pytest.raises(ValueError, match=r"points.ply: expected a PLY file with vertices"):
            load_scene(folder)
    path.write_bytes(whole.split(b"end_header")[0].replace(b"vertex 3", b"vertex 0"))
    path.write_bytes(path.read_bytes() + b"end_header\n")
    with pytest.raises(ValueError, match="expected finite sparse points, got 0 points"):
        load_scene(folder)
