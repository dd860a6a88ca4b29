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

# What a camera model's parameters start with; the others of COLMAP's models have lens distortion.
_PINHOLES = {0: "SIMPLE_PINHOLE", 1: "PINHOLE"}


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


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Posed images and a coloured point cloud in one world."""

    images: list[PosedImage]
    points: np.ndarray  # [P, 3] float64, world units
    colors: np.ndarray  # [P, 3] float64, 0..1


_Intrinsics = tuple[float, float, float, float, int, int]  # fx, fy, cx, cy, width, height


def read_colmap(folder: Path) -> SparseModel:
    """Read `cameras`, `images` and `points3D`, as .bin where present and else as .txt.

    Args:
        folder: the model folder, usually `<scene>/sparse/0`.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is truncated or malformed, or a camera is not a pinhole.
    """
    for suffix, readers in (
        (".bin", (_cameras_bin, _images_bin, _points_bin)),
        (".txt", (_cameras_txt, _images_txt, _points_txt)),
    ):
        paths = [folder / f"{stem}{suffix}" for stem in ("cameras", "images", "points3D")]
        present = [path for path in paths if path.is_file()]
        if present:
            missing = [path for path in paths if path not in present]
            if missing:
                raise FileNotFoundError(f"{missing[0]}: missing, but {present[0].name} is there")
            cameras = readers[0](paths[0])
            return SparseModel(readers[1](paths[1], cameras), *readers[2](paths[2]))
    raise FileNotFoundError(
        f"{folder}: expected cameras, images and points3D as .bin or .txt (a COLMAP model)"
    )


def _intrinsics(path: Path, model: str, width: int, height: int, params: list[float]):
    if model == "SIMPLE_PINHOLE" and len(params) == 3:
        fx, fy, cx, cy = params[0], *params
    elif model == "PINHOLE" and len(params) == 4:
        fx, fy, cx, cy = params
    else:
        raise ValueError(f"{path}: {model} camera with {len(params)} parameters")
    if not (width > 0 and height > 0 and 0 < fx < np.inf and 0 < fy < np.inf):
        raise ValueError(f"{path}: impossible camera {width}x{height}, focal lengths {fx}, {fy}")
    return fx, fy, cx, cy, width, height


def _refuse_distorted(path: Path, model: str) -> None:
    if model not in _PINHOLES.values():
        raise ValueError(
            f"{path}: camera model {model}; only PINHOLE and SIMPLE_PINHOLE can be rasterized. "
            "Undistort the photos first: colmap image_undistorter"
        )


def _world_to_camera(path: Path, quat: list[float], translation: list[float]) -> np.ndarray:
    """Return the [4, 4] matrix of a wxyz quaternion and a translation."""
    norm = float(np.linalg.norm(quat))
    if not (0 < norm < np.inf and np.isfinite(translation).all()):
        raise ValueError(f"{path}: impossible pose, quaternion {quat}, translation {translation}")
    w, x, y, z = (value / norm for value in quat)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    viewmat[:3, 3] = translation
    return viewmat


def _posed(path: Path, name: str, viewmat: np.ndarray, camera_id: int, cameras: dict) -> PosedImage:
    if camera_id not in cameras:
        raise ValueError(f"{path}: image {name} has camera {camera_id}, known are {list(cameras)}")
    return PosedImage(name, viewmat, *cameras[camera_id])


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
        raw = self.data[self.skip(end - self.offset + 1) : end]
        try:
            return raw.decode("utf-8")
        except UnicodeDecodeError:
            raise ValueError(f"{self.path}: image name {raw!r} is not UTF-8") from None

    def records(self) -> Iterator[int]:
        yield from range(self.take("Q")[0])
        if self.offset != len(self.data):
            raise ValueError(f"{self.path}: {len(self.data) - self.offset} bytes too many")


def _cameras_bin(path: Path) -> dict[int, _Intrinsics]:
    file, cameras = _Binary(path), {}
    for _ in file.records():
        camera_id, model_id, width, height = file.take("IiQQ")
        model = _PINHOLES.get(model_id, f"number {model_id}")
        _refuse_distorted(path, model)
        params = list(file.take("ddd" if model_id == 0 else "dddd"))
        cameras[camera_id] = _intrinsics(path, model, width, height, params)
    return cameras


def _images_bin(path: Path, cameras: dict[int, _Intrinsics]) -> list[PosedImage]:
    file, images = _Binary(path), []
    for _ in file.records():
        _, *pose, camera_id = file.take("I7dI")
        name = file.text()
        file.skip(24 * file.take("Q")[0])  # observations: x, y as float64, point id
        viewmat = _world_to_camera(path, pose[:4], pose[4:])
        images.append(_posed(path, name, viewmat, camera_id, cameras))
    return images


def _points_bin(path: Path) -> tuple[np.ndarray, np.ndarray]:
    file, rows = _Binary(path), []
    for _ in file.records():
        _, *row, _, track_length = file.take("Q3d3BdQ")
        file.skip(8 * track_length)  # track: image id, observation index
        rows.append(row)
    return _cloud(rows)


def _cloud(rows: list) -> tuple[np.ndarray, np.ndarray]:
    table = np.asarray(rows, dtype=np.float64).reshape(-1, 6)
    return table[:, :3], table[:, 3:] / 255.0


def _lines(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: expected UTF-8 text") from None
    return [line for line in lines if not line.startswith("#")]


def _cameras_txt(path: Path) -> dict[int, _Intrinsics]:
    cameras = {}
    for line in filter(str.strip, _lines(path)):
        try:
            camera_id, model, width, height, *params = line.split()
            numbers = int(camera_id), int(width), int(height), [float(p) for p in params]
        except ValueError:
            raise ValueError(
                f"{path}: expected ID MODEL WIDTH HEIGHT PARAMS, got {line!r}"
            ) from None
        _refuse_distorted(path, model)
        cameras[numbers[0]] = _intrinsics(path, model, *numbers[1:])
    return cameras


def _images_txt(path: Path, cameras: dict[int, _Intrinsics]) -> list[PosedImage]:
    images = []
    # Every second line holds observations, which nobody needs here, and may be empty.
    for line in filter(str.strip, _lines(path)[::2]):
        fields = line.strip().split(maxsplit=9)
        try:
            qw, qx, qy, qz, x, y, z = (float(value) for value in fields[1:8])
            camera_id, name = int(fields[8]), fields[9]
        except (ValueError, IndexError):
            raise ValueError(
                f"{path}: expected ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {line!r}"
            ) from None
        viewmat = _world_to_camera(path, [qw, qx, qy, qz], [x, y, z])
        images.append(_posed(path, name, viewmat, camera_id, cameras))
    return images


def _points_txt(path: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = []
    for line in filter(str.strip, _lines(path)):
        try:
            x, y, z, red, green, blue = (float(value) for value in line.split()[1:7])
        except ValueError:
            raise ValueError(f"{path}: expected ID X Y Z R G B ERROR, got {line!r}") from None
        rows.append((x, y, z, red, green, blue))
    return _cloud(rows)
