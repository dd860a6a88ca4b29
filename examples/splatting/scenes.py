"""Scenes to fit: photos with known cameras, and the sparse points to start from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from splatting.camera import Camera
from splatting.colmap import PosedImage, SparseModel, read_colmap
from splatting.transforms import read_transforms

Size = Literal["images", "images_2", "images_4"]  # the folder of the photos
Background = Literal["black", "white"]

_TEST_EVERY = 8  # the convention of Mip-NeRF 360 and of every 3DGS paper since


@dataclass(frozen=True, eq=False)
class View:
    """One photo and the camera that took it."""

    name: str
    camera: Camera
    image: Tensor  # [H, W, 3] float32, 0..1


@dataclass(frozen=True, eq=False)
class Scene:
    """Views to train on, views to judge by, and sparse points to start from."""

    name: str
    train: list[View]
    test: list[View]
    points: Tensor  # [P, 3] float32, world units
    colors: Tensor  # [P, 3] float32, 0..1
    extent: float  # world units; see `scene_extent`
    background: Tensor = field(default_factory=lambda: torch.zeros(3))  # [3] float32, 0..1


def load_scene(
    source: str | Path,
    size: Size = "images_4",
    *,
    background: Background = "black",
    held_out: int | None = None,
) -> Scene:
    """Load a scene from a folder, or make the embedded one.

    A folder holds `images/`, its halves `images_2/` and quarters `images_4/`, and either a COLMAP
    model in `sparse/0/` (or `sparse/`), or `transforms.json` with its .ply; COLMAP's is preferred.
    Test views are every 8th of the names.

    Args:
        source: "embedded" (procedural, nothing to download; see `embedded.py`) or a folder.
        size: the folder of the photos; intrinsics follow the actual image size.
        background: what is behind the Gaussians; "white" for NeRF-synthetic scenes.
        held_out: the test views are those whose index among the sorted names is this modulo 8
            (7 in the embedded scene); by default 0 (3 there).

    Raises FileNotFoundError, or ValueError where a file is malformed or an option none of these.
    """
    options = ("size", size, Size), ("background", background, Background)
    for option, value, allowed in options:
        if value not in get_args(allowed):
            raise ValueError(f"load_scene: {option}={value!r}, allowed are {get_args(allowed)}")
    if held_out is not None and held_out not in range(_TEST_EVERY):
        raise ValueError(f"load_scene: held_out={held_out!r}, must be from 0 to {_TEST_EVERY - 1}")
    if str(source) == "embedded":
        from splatting.embedded import embedded_scene  # it imports Scene from here

        made = embedded_scene(size, held_out=held_out)
        return replace(made, background=torch.full((3,), float(background == "white")))
    folder = Path(source)
    if not folder.is_dir():
        raise FileNotFoundError(f"load_scene: {folder} is no folder; expected one, or 'embedded'")
    model = _read_model(folder)
    if len(model.points) == 0 or not np.isfinite(model.points).all():
        raise ValueError(f"{folder}: expected finite sparse points, got {len(model.points)} points")
    names = sorted(image.name for image in model.images)
    train_names, test_names = _split(folder, names, held_out)
    images = folder / size
    if not images.is_dir():
        raise FileNotFoundError(f"{images}: missing, expected the photos of size={size!r}")
    views = {posed.name: _load_view(images, posed, background) for posed in model.images}
    train = [views[name] for name in train_names]
    return Scene(
        folder.resolve().name,
        train,
        [views[name] for name in test_names],
        torch.from_numpy(model.points).float(),
        torch.from_numpy(model.colors).float(),
        scene_extent([view.camera for view in train]),
        torch.full((3,), float(background == "white")),
    )


def scene_extent(cameras: list[Camera]) -> float:
    """1.1 times the largest distance of a camera from their mean (INRIA and gsplat), world units.

    Learning rates of the positions are multiples of it, so zero is refused.
    """
    if len(cameras) < 2:
        raise ValueError(f"scene_extent: needs at least 2 train views, got {len(cameras)}")
    positions = torch.stack([camera.position for camera in cameras]).double()
    extent = 1.1 * float((positions - positions.mean(dim=0)).norm(dim=1).max())
    if not 0.0 < extent < float("inf"):
        raise ValueError(f"scene_extent: train cameras span {extent}, expected distinct positions")
    return extent


def _read_model(folder: Path) -> SparseModel:
    sparse = folder / "sparse"
    if sparse.is_dir():
        return read_colmap(sparse / "0" if (sparse / "0").is_dir() else sparse)
    if (folder / "transforms.json").is_file():
        return read_transforms(folder)
    raise FileNotFoundError(f"{folder}: expected sparse/0/ (COLMAP) or transforms.json, found none")


def _split(folder: Path, names: list[str], held_out: int | None) -> tuple[list[str], list[str]]:
    if len(set(names)) != len(names):
        doubled = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"{folder}: images listed more than once: {doubled}")
    test = names[held_out or 0 :: _TEST_EVERY]
    train = [name for name in names if name not in test]
    if len(train) < 2 or not test:
        raise ValueError(
            f"{folder}: needs at least 2 train views and a test view, got {len(train)} and "
            f"{len(test)} of {len(names)} views"
        )
    return train, test


def _load_view(folder: Path, posed: PosedImage, background: Background) -> View:
    path = folder / posed.name
    if not path.is_file():
        raise FileNotFoundError(f"{path}: missing, but the scene's model lists it")
    try:
        with Image.open(path) as file:
            photo: Image.Image = file
            if file.has_transparency_data:  # as NeRF-synthetic's photos have it
                photo = file.convert("RGBA")
                photo = Image.alpha_composite(Image.new("RGBA", photo.size, background), photo)
            pixels = np.array(photo.convert("RGB"))
    except (UnidentifiedImageError, OSError) as error:
        raise ValueError(f"{path}: expected an image: {error}") from None
    height, width = pixels.shape[:2]
    scale_x, scale_y = width / posed.width, height / posed.height
    # A downscaled side is rounded by up to a pixel, so that is how far the two may disagree.
    if min(abs(width - posed.width * scale_y), abs(height - posed.height * scale_x)) > 1.0:
        raise ValueError(
            f"{path}: image is {width}x{height}, expected the shape of its camera, "
            f"{posed.width}x{posed.height}, at some scale"
        )
    camera = Camera(
        torch.from_numpy(posed.viewmat).float(),
        posed.fx * scale_x,
        posed.fy * scale_y,
        posed.cx * scale_x,
        posed.cy * scale_y,
        width,
        height,
    )
    return View(posed.name, camera, torch.from_numpy(pixels).float() / 255.0)
