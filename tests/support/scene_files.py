"""Writers of tiny scenes in every layout, straight from the documented formats."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

WIDTH, HEIGHT = 40, 24
PINHOLE = (50.0, 48.0, 19.0, 12.5)  # fx, fy, cx, cy at full size
POINTS = [(0.5, -1.25, 2.0, 255, 0, 51), (1.0, 0.0, 3.0, 0, 102, 255), (0, 0, 1, 7, 8, 9)]


def poses(count: int) -> list[tuple[list[float], list[float]]]:
    """Return unit quaternions (wxyz) and translations, world to camera."""
    rng = np.random.default_rng(4)
    quats = rng.standard_normal((count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return list(zip(quats.tolist(), rng.standard_normal((count, 3)).tolist(), strict=True))


def quat_to_rotation(quat: list[float]) -> np.ndarray:
    """Rotate the basis vectors by the quaternion: q v conj(q), another way than the reader's."""
    w, u = quat[0], np.array(quat[1:])
    columns = [
        2 * u.dot(v) * u + (w * w - u.dot(u)) * v + 2 * w * np.cross(u, v) for v in np.eye(3)
    ]
    return np.stack(columns, axis=1)


def image_names(count: int) -> list[str]:
    """Return the sorted names of the images."""
    return [f"photo_{index:02d}.png" for index in range(count)]


def write_images(folder: Path, count: int) -> None:
    """Write noise into `images/` and every 4th pixel of it into `images_4/`."""
    rng = np.random.default_rng(5)
    for name in image_names(count):
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        for sub, step in (("images", 1), ("images_4", 4)):
            (folder / sub).mkdir(exist_ok=True)
            Image.fromarray(pixels[::step, ::step]).save(folder / sub / name)


def write_binary(folder: Path, count: int, model: int = 1) -> None:
    """Write a COLMAP .bin model; camera model 1 is PINHOLE, 0 SIMPLE_PINHOLE."""
    params = PINHOLE if model == 1 else (PINHOLE[0], *PINHOLE[2:])
    cameras = struct.pack("<QIiQQ", 1, 7, model, WIDTH, HEIGHT)
    cameras += struct.pack(f"<{len(params)}d", *params)
    images = struct.pack("<Q", count)
    for index, (name, (quat, shift)) in enumerate(
        zip(image_names(count), poses(count), strict=True)
    ):
        images += struct.pack("<I7dI", index + 3, *quat, *shift, 7) + name.encode() + b"\0"
        images += struct.pack("<Q", index) + struct.pack("<ddq", 1.0, 2.0, -1) * index
    points = struct.pack("<Q", len(POINTS))
    for index, point in enumerate(POINTS):
        points += struct.pack("<Q3d3BdQ", index * 9, *point, 0.5, index)
        points += struct.pack("<II", 3, 0) * index
    folder.mkdir(parents=True)
    for stem, data in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{stem}.bin").write_bytes(data)


def write_transforms(folder: Path, count: int) -> None:
    """Write the same cameras and points as transforms.json and points.ply."""
    frames = []
    for name, (quat, shift) in zip(image_names(count), poses(count), strict=True):
        rotation = quat_to_rotation(quat)
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3] = rotation.T @ np.diag([1, -1, -1])
        camera_to_world[:3, 3] = -rotation.T @ np.array(shift)
        frame = {"file_path": f"./images/{name}", "transform_matrix": camera_to_world.tolist()}
        frames.append(frame)
    table: dict = {"w": WIDTH, "h": HEIGHT, "k1": 0, "frames": frames}
    table |= dict(zip(("fl_x", "fl_y", "cx", "cy"), PINHOLE, strict=True))
    (folder / "transforms.json").write_text(json.dumps(table))
    types = [(key, "f4") for key in "xyz"] + [(key, "u1") for key in ("red", "green", "blue")]
    element = PlyElement.describe(np.array(POINTS, dtype=types), "vertex")
    PlyData([element]).write(str(folder / "points.ply"))


def write_scene(folder: Path, layout: str, count: int = 10) -> Path:
    """Write a whole scene in the layout "bin" or "json" and return its folder."""
    folder.mkdir(exist_ok=True)
    write_images(folder, count)
    if layout == "bin":
        write_binary(folder / "sparse" / "0", count)
    else:
        write_transforms(folder, count)
    return folder
