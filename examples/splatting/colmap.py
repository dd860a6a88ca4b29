"""Reader of a COLMAP sparse model: cameras, poses and coloured points.

A well-kept library would be pycolmap. It is not used here because pycolmap and Pillow's PNG writer
in one process corrupted the heap (seen twice), and because it is a heavy native dependency for
three small, documented files: https://colmap.github.io/format.html (little endian throughout).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_PINHOLES = {0: 3, 1: 4}  # SIMPLE_PINHOLE, PINHOLE: parameters; other models have lens distortion
UNDISTORT = (
    "only pinhole cameras can be rasterized. Undistort the photos first: colmap image_undistorter"
)


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One photo of a scene: its name, pose and full-size pinhole intrinsics."""

    name: str  # path below the image folder
    viewmat: np.ndarray  # [4, 4] float64, world to camera, OpenCV axes
    fx: float  # pixels, like the next three
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        sizes = (self.fx, self.fy, self.width, self.height)
        if not all(0 < size < np.inf for size in sizes) or not np.isfinite(self.viewmat).all():
            raise ValueError(f"image {self.name}: impossible camera {sizes} or pose {self.viewmat}")


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Posed images and a coloured point cloud in one world."""

    images: list[PosedImage]
    points: np.ndarray  # [P, 3] float64, world units
    colors: np.ndarray  # [P, 3] float64, 0..1


def read_colmap(folder: Path) -> SparseModel:
    """Read `cameras.bin`, `images.bin` and `points3D.bin`, usually of `<scene>/sparse/0`.

    Raises FileNotFoundError, or ValueError where a file is malformed or a camera no pinhole.
    """
    paths = [folder / f"{stem}.bin" for stem in ("cameras", "images", "points3D")]
    for path in paths:
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: missing; expected cameras, images and points3D as .bin, which "
                "`colmap model_converter` makes of .txt"
            )
    cameras, images, points = map(_Binary, paths)
    return SparseModel(_images(images, _cameras(cameras)), *_points(points))


class _Binary:
    """A cursor over a little-endian file that names the file when it runs out of bytes."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.offset = path, path.read_bytes(), 0

    def skip(self, size: int) -> int:
        start, self.offset = self.offset, self.offset + size
        if self.offset > len(self.data):
            raise ValueError(
                f"{self.path}: truncated, needs at least {self.offset} bytes, has {len(self.data)}"
            )
        return start

    def take(self, layout: str) -> tuple:
        start = self.skip(struct.calcsize("<" + layout))
        return struct.unpack_from("<" + layout, self.data, start)

    def text(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise ValueError(f"{self.path}: truncated in the middle of an image name")
        return self.data[self.skip(end - self.offset + 1) : end].decode("utf-8")

    def records(self) -> Iterator[int]:
        yield from range(self.take("Q")[0])
        if self.offset != len(self.data):
            raise ValueError(f"{self.path}: {len(self.data) - self.offset} bytes too many")


def _cameras(file: _Binary) -> dict[int, tuple]:
    """Camera -> fx, fy, cx, cy, width, height."""
    cameras = {}
    for _ in file.records():
        camera_id, model, *size = file.take("IiQQ")
        if model not in _PINHOLES:
            raise ValueError(f"{file.path}: camera model number {model}; {UNDISTORT}")
        params = file.take("d" * _PINHOLES[model])
        cameras[camera_id] = (*(params[:1] if len(params) == 3 else ()), *params, *size)
    return cameras


def _images(file: _Binary, cameras: dict[int, tuple]) -> list[PosedImage]:
    images = []
    for _ in file.records():
        _, *pose, camera = file.take("I7dI")
        name = file.text()
        file.skip(24 * file.take("Q")[0])  # observations: x, y as float64, point id
        if camera not in cameras:
            known = list(cameras)
            raise ValueError(f"{file.path}: image {name} has camera {camera}, known are {known}")
        images.append(PosedImage(name, _world_to_camera(pose[:4], pose[4:]), *cameras[camera]))
    return images


def _world_to_camera(quat: list[float], translation: list[float]) -> np.ndarray:
    """The [4, 4] matrix of a wxyz quaternion and a translation."""
    w, x, y, z = np.array(quat) / np.linalg.norm(quat)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = translation
    return viewmat


def _points(file: _Binary) -> tuple[np.ndarray, np.ndarray]:
    rows = []
    for _ in file.records():
        _, *row, _, track_length = file.take("Q3d3BdQ")
        file.skip(8 * track_length)  # track: image id, observation index
        rows.append(row)
    table = np.asarray(rows, dtype=np.float64).reshape(-1, 6)
    return table[:, :3], table[:, 3:] / 255.0
