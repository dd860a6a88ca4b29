"""Reader of the `transforms.json` layout of instant-ngp and nerfstudio, with its point cloud."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyParseError

from splatting.colmap import UNDISTORT, PosedImage, SparseModel

_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2", "distortion_params", "is_fisheye")
_CAMERAS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")  # the last with the distortion above
_OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # y up, looking along -z: y down, along +z


def read_transforms(folder: Path) -> SparseModel:
    """Read `transforms.json` and the point cloud it names (`points.ply` where it names none).

    Intrinsics may stand at the top, or in a frame, which then wins. Image names lose a leading
    `images/`, so that they agree with COLMAP's.

    Raises FileNotFoundError, or ValueError where a file is malformed or a lens distorts.
    """
    path = folder / "transforms.json"
    table = read_json_object(path)
    frames = table.get("frames")
    if not isinstance(frames, list):
        raise ValueError(f"{path}: expected a list under 'frames', got {type(frames).__name__}")
    images = [_posed_image(path, index, table, frame) for index, frame in enumerate(frames)]
    ply_path = folder / str(table.get("ply_file_path", "points.ply"))
    return SparseModel(images, *_read_points(ply_path))


def read_json_object(path: Path) -> dict[str, Any]:
    """Read a file that holds one JSON object."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: missing")
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # JSONDecodeError and UnicodeDecodeError are both one
        raise ValueError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(table, dict):
        raise ValueError(f"{path}: expected a JSON object, got {type(table).__name__}")
    return table


def _posed_image(path: Path, index: int, table: dict[str, Any], frame: Any) -> PosedImage:
    where = f"{path}: frame {index}"
    try:
        merged = {**table, **frame}
        fx, fy, cx, cy, width, height = (float(merged[key]) for key in _INTRINSICS)
        pose = np.array(frame["transform_matrix"], dtype=np.float64).reshape(4, 4)
        name = frame["file_path"].removeprefix("./").removeprefix("images/")
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error!r}") from None
    if not np.isfinite([cx, cy, width, height]).all():
        raise ValueError(f"{where}: impossible camera: cx={cx}, cy={cy}, w={width}, h={height}")
    model = merged.get("camera_model", "OPENCV")
    if model not in _CAMERAS:
        raise ValueError(f"{where}: camera_model={model!r}, allowed are {_CAMERAS}; {UNDISTORT}")
    distortion = {key: merged[key] for key in _DISTORTION if np.any(merged.get(key) or 0.0)}
    if distortion:
        raise ValueError(f"{where}: lens distortion {distortion}; {UNDISTORT}")
    rotation = pose[:3, :3]
    # 1e-3 lets matrices through that were written with few digits; a scaled or mirrored one is
    # off by far more, and would silently bend the scene.
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not off < 1e-3 or np.linalg.det(rotation) < 0:
        raise ValueError(f"{where}: 'transform_matrix' is no rotation and translation: {pose}")
    viewmat = np.linalg.inv(pose @ _OPENGL_TO_OPENCV)
    return PosedImage(name, viewmat, fx, fy, cx, cy, int(width), int(height))


def _read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: missing, expected the scene's coloured points")
    try:
        vertices = PlyData.read(str(path))["vertex"]
        columns = [np.asarray(vertices[key], dtype=np.float64) for key in ("x", "y", "z")]
        channels = [np.asarray(vertices[key], dtype=np.float64) for key in ("red", "green", "blue")]
    except (PlyParseError, KeyError, ValueError, EOFError) as error:
        raise ValueError(
            f"{path}: expected a PLY file with vertices x, y, z, red, green, blue: {error}"
        ) from None
    return np.stack(columns, axis=1), np.stack(channels, axis=1) / 255.0
