"""One picture: a test view's photo beside the render of every arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from splatting.camera import Camera
from splatting.gaussians import load_ply
from splatting.metrics import psnr
from splatting.rasterizer import render
from splatting.scenes import View

COLUMNS = 4


def draw_gallery(view: View, fitted: dict[str, Path], path: Path) -> None:
    """Write `path` (PNG): the photo, then each arm's render of that view with its PSNR.

    Args:
        view: a view that no arm was trained on.
        fitted: .ply of the Gaussians of every arm, in the order to show them.
        path: the picture to write.
    """
    tiles: list[tuple[str, np.ndarray]] = [(f"photo: {view.name}", view.image.numpy())]
    for name, ply in fitted.items():
        image = _image(ply, view.camera)
        tiles.append((f"{name}\n{float(psnr(image, view.image)):.2f} dB", image.numpy()))
    rows, aspect = -(-len(tiles) // COLUMNS), view.camera.height / view.camera.width
    figure = Figure(figsize=(3.2 * COLUMNS, (3.2 * aspect + 0.55) * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, COLUMNS)).ravel()
    for axis in axes:
        axis.axis("off")
    for axis, (title, image) in zip(axes, tiles, strict=False):
        axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
        axis.set_title(title, fontsize=10)
    figure.savefig(path, dpi=110)


def _image(ply: Path, camera: Camera):
    gaussians = {key: value.detach() for key, value in load_ply(ply).items()}
    return render(gaussians, camera).image.clamp(0, 1)
