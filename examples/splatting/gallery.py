"""One picture: a test view's photo beside the render of every arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from splatting.metrics import psnr
from splatting.scenes import View

COLUMNS = 4


def draw_gallery(view: View, fitted: dict[str, Path], path: Path) -> None:
    """Write `path` (PNG): the photo, then each arm's render of that view with its PSNR.

    Args:
        view: a view that no arm was trained on.
        fitted: .npy of every arm's render [H, W, 3], in the order to show them.
        path: the picture to write.
    """
    tiles: list[tuple[str, np.ndarray]] = [(f"photo: {view.name}", view.image.numpy())]
    for name, file in fitted.items():
        image = np.load(file)
        quality = float(psnr(torch.from_numpy(image), view.image))
        tiles.append((f"{name}\n{quality:.2f} dB", image))
    rows, aspect = -(-len(tiles) // COLUMNS), view.camera.height / view.camera.width
    figure = Figure(figsize=(3.2 * COLUMNS, (3.2 * aspect + 0.55) * rows), layout="constrained")
    axes = np.atleast_1d(figure.subplots(rows, COLUMNS)).ravel()
    for axis in axes:
        axis.axis("off")
    for axis, (title, image) in zip(axes, tiles, strict=False):
        axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
        axis.set_title(title, fontsize=10)
    figure.savefig(path, dpi=110)
