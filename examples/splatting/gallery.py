"""One picture of a comparison: error over seconds, and a photo beside each arm's render of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from torch import Tensor

from opt3dgs_optim.runs.stats import Arm
from splatting.metrics import psnr
from splatting.scenes import View

COLOURS = ("#555555", "#0072b2", "#d55e00", "#009e73", "#cc79a7")
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
    aspect, count = view.camera.height / view.camera.width, 1 + len(renders)
    width = 10 / count
    figure = Figure(figsize=(10, width * aspect + 4.2), dpi=120, layout="constrained")
    names = [str(i) for i in range(count)]
    rows: list[Any] = [names, ["curves"] * count]
    axes = figure.subplot_mosaic(rows, height_ratios=[width * aspect, 3.4])
    colours = {arm.name: COLOURS[i % len(COLOURS)] for i, arm in enumerate(arms)}
    axes["0"].imshow(view.image.numpy(), interpolation="nearest")
    axes["0"].set_title("photo, held out")
    for place, (name, image) in zip(names[1:], renders, strict=True):
        axes[place].imshow(image.clamp(0, 1).numpy(), interpolation="nearest")
        title = f"{name}: {float(psnr(image, view.image)):.2f} dB"
        axes[place].set_title(title, color=colours[name])
    for place in names:
        axes[place].axis("off")
    axis, values = axes["curves"], []
    for arm in arms:
        for i, run in enumerate(arm.runs):
            _, seconds, metric = run.series("psnr")
            values += [*metric]
            label = arm.name if i == 0 else None
            axis.plot(seconds, metric, color=colours[arm.name], lw=2, alpha=0.9, label=label)
    top, low = max(values), min(values)
    axis.set_xlim(left=0)
    axis.set_ylim(top - SHOWN * (top - low), top + 0.05 * (top - low))
    axis.set(xlabel="seconds of one CPU thread", ylabel="PSNR of held-out views, dB")
    axis.legend(loc="lower right", frameon=False)
    axis.grid(color="#e4e4e4", lw=0.8)
    figure.savefig(path)
