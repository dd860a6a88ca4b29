"""One picture of a comparison: a photo beside each arm's render of it, and error over seconds."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from opt3dgs_optim.runs.stats import Arm
from splatting.metrics import psnr
from splatting.scenes import View

COLOURS = ("#555555", "#0072b2", "#d55e00", "#009e73", "#cc79a7")
NAMES = {"stock": "stock 3DGS-MCMC", "defaults": "opt3dgs_optim", "x3": "rates times 3"}
SHOWN = 0.5  # of the range of PSNR, from above: the first iterations would flatten the rest


def draw_comparison(
    arms: Sequence[Arm], view: View, renders: Sequence[tuple[str, Tensor]], path: Path
) -> None:
    """Write `path` (PNG).

    Args:
        arms: as `opt3dgs_optim.runs.stats.compare` has them; each seed is a line.
        view: one that no arm was trained on.
        renders: each arm's name and render of that view, [H, W, 3] in 0..1.
        path: of the picture.
    """
    camera, count = view.camera, 1 + len(renders)
    width = 10 / count
    height = width * camera.height / camera.width
    figure = Figure(figsize=(10, 2 * height + 4.1), dpi=100, layout="constrained")
    rows: list[Any] = [[f"{kind} {i}" for i in range(count)] for kind in ("whole", "middle")]
    axes = figure.subplot_mosaic([*rows, ["curves"] * count], height_ratios=[height, height, 3.1])
    colours = {arm.name: COLOURS[i % len(COLOURS)] for i, arm in enumerate(arms)}
    seconds = {arm.name: arm.runs[0].series("psnr")[1][-1] for arm in arms}
    for i, (name, image) in enumerate([("", view.image), *renders]):
        title, shown = "photo that was\nheld out", image.clamp(0, 1).numpy()
        if name:
            found = f"{float(psnr(image, view.image)):.2f} dB after {seconds[name]:.0f} s"
            title = f"{NAMES.get(name, name)}\n{found}"
        axes[f"whole {i}"].imshow(shown, interpolation="nearest")
        axes[f"whole {i}"].set_title(title, color=colours.get(name, "black"), fontsize=13)
        y, x = camera.height // 4, camera.width // 4
        axes[f"middle {i}"].imshow(shown[y:-y, x:-x], interpolation="nearest")
        for kind in ("whole", "middle"):
            axes[f"{kind} {i}"].axis("off")
    axis, values = axes["curves"], []
    for arm in arms:
        for i, run in enumerate(arm.runs):
            _, at, metric = run.series("psnr")
            values += [*metric]
            label = NAMES.get(arm.name, arm.name) if i == 0 else None
            axis.plot(at, metric, color=colours[arm.name], lw=2.5, alpha=0.9, label=label)
    top, low = max(values), min(values)
    axis.set_xlim(left=0)
    axis.set_ylim(top - SHOWN * (top - low), top + 0.05 * (top - low))
    axis.set_xlabel("seconds of one CPU thread", fontsize=13)
    axis.set_ylabel("mean PSNR of all\nheld-out photos, dB", fontsize=13)
    axis.tick_params(labelsize=12)
    axis.legend(loc="lower right", frameon=False, fontsize=13)
    axis.grid(color="#e4e4e4", lw=0.8)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    # 256 colours: a third of the bytes.
    Image.open(drawn).convert("RGB").quantize(kmeans=1).save(path, format="png", optimize=True)
