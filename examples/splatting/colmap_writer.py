"""Writer of a scene in COLMAP's layout, so that other trainers can train on the embedded one."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatting.scenes import Scene, View

_PINHOLE = 1  # COLMAP's number of the camera model


def write_colmap(scene: Scene, folder: Path) -> None:
    """Write `images/*.png` and `sparse/0/*.bin`; the views in an order that holds out the test's.

    Every eighth photo by name, from the first, is a test view by the convention of all trainers, so
    that the test views are put there.

    Raises:
        ValueError: there are fewer test views than every eighth.
    """
    views = _in_order(scene.train, scene.test)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    (folder / "images").mkdir(exist_ok=True)
    cameras, images = [struct.pack("<Q", len(views))], [struct.pack("<Q", len(views))]
    for index, view in enumerate(views, 1):
        camera, name = view.camera, f"{index:04d}.png"
        pixels = (255 * view.image.clamp(0, 1)).round().to(torch.uint8).numpy()
        Image.fromarray(pixels).save(folder / "images" / name)
        inner = struct.pack("<4d", camera.fx, camera.fy, camera.cx, camera.cy)
        size = struct.pack("<QQ", camera.width, camera.height)
        cameras.append(struct.pack("<ii", index, _PINHOLE) + size + inner)
        pose = camera.viewmat.double().numpy()
        numbers = struct.pack("<7d", *_quaternion(pose[:3, :3]), *pose[:3, 3])
        ids = struct.pack("<I", index), struct.pack("<I", index)
        images.append(ids[0] + numbers + ids[1] + name.encode() + b"\0" + struct.pack("<Q", 0))
    points = [struct.pack("<Q", len(scene.points))]
    colors = (255 * scene.colors.clamp(0, 1)).round().to(torch.uint8).tolist()
    for index, (place, color) in enumerate(zip(scene.points.tolist(), colors, strict=True), 1):
        points.append(struct.pack("<Q3d3BdQ", index, *place, *color, 0.0, 0))
    for name, parts in (("cameras", cameras), ("images", images), ("points3D", points)):
        (sparse / f"{name}.bin").write_bytes(b"".join(parts))


def _in_order(train: Sequence[View], test: Sequence[View]) -> list[View]:
    """A test view, then up to seven to train on, and so on."""
    if len(train) > 7 * len(test):
        raise ValueError(
            f"write_colmap: {len(train)} views to train on and {len(test)} to judge by, but one of "
            "eight is needed to judge by"
        )
    share, made = -(-len(train) // 7), []
    for group in range(share):
        made += [test[group], *train[7 * group : 7 * group + 7]]
    return made


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """The unit quaternion (w, x, y, z) of a rotation matrix [3, 3], w >= 0 (Bar-Itzhack 2000)."""
    r = rotation
    symmetric = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0.0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
            [0.0, 0.0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
            [0.0, 0.0, 0.0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    largest = np.linalg.eigh(symmetric, UPLO="U")[1][:, -1]
    return largest if largest[0] >= 0 else -largest
