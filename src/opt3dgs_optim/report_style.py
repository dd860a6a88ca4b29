"""How the report's pictures look: colours, names, plain axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

__all__ = [
    "FAINT",
    "INK",
    "binned",
    "draw_legend",
    "label_of",
    "look",
    "panel_grid",
    "plain_style",
]

# Okabe and Ito's colour-blind-safe palette, without the yellow that white swallows.
COLOURS = ("#333333", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
STYLES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)))  # one for each round through the colours
INK, FAINT = "#222222", "#8a8a8a"
NAMES = {"psnr": "PSNR (dB)", "train_psnr": "training PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS"}
BINS = 50


def look(index: int) -> dict[str, Any]:
    """Colour and line style of the arm or run number `index`."""
    return {
        "color": COLOURS[index % len(COLOURS)],
        "linestyle": STYLES[index // len(COLOURS) % len(STYLES)],
    }


def label_of(metric: str) -> str:
    """A metric's name, with its unit where it is known."""
    return NAMES.get(metric, metric)


def binned(x: np.ndarray, values: np.ndarray, bins: int = BINS) -> tuple[np.ndarray, np.ndarray]:
    """Means over equal stretches of the run: single steps are too noisy to look at."""
    finite = np.isfinite(values)
    x, values = x[finite], values[finite]
    parts = np.array_split(np.arange(len(x)), min(bins, len(x))) if len(x) else []
    return (
        np.array([x[part].mean() for part in parts]),
        np.array([values[part].mean() for part in parts]),
    )


def panel_grid(
    heights: Sequence[float],
    columns: int,
    size: tuple[float, float],
    *,
    sides: tuple[float, float],
    above: float,
    below: float,
    gap: float,
    dpi: int,
) -> tuple[Any, Any]:
    """A figure and its panels [rows, columns]: one x axis a column, one y axis a row.

    Uses matplotlib's Agg canvas alone: no backend is chosen and no global setting changed.

    Args:
        heights: of the rows, one against the other.
        columns: number of columns.
        size: (width, height) of the figure in inches.
        sides: where the panels begin and end, 0..1 of the width.
        above, below: inches left free.
        gap: between rows, in mean heights of a row.
        dpi: dots per inch.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=dpi, facecolor="white")
    FigureCanvasAgg(figure)
    spacing = {
        "height_ratios": heights,
        "left": sides[0],
        "right": sides[1],
        "top": 1 - above / size[1],
        "bottom": below / size[1],
        "wspace": 0.06,
        "hspace": gap,
    }
    shared = {"sharex": "col", "sharey": "row", "squeeze": False}
    return figure, figure.subplots(len(heights), columns, gridspec_kw=spacing, **shared)


def plain_style(panel: Any) -> None:
    """White, two spines, a faint grid."""
    panel.set_facecolor("white")
    panel.grid(True, axis="y", lw=0.6, color="#e4e4e4")
    panel.set_axisbelow(True)
    for side, spine in panel.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#999999")
    panel.tick_params(labelsize=9, colors=INK, length=3)
    for label in (panel.xaxis.label, panel.yaxis.label):
        label.set_fontsize(10)
        label.set_color(INK)
    panel.margins(x=0.02)


def draw_legend(
    figure: Any,
    labels: Sequence[str],
    anchor: tuple[float, float],
    columns: int,
    *,
    fontsize: float,
    spacing: float,
) -> None:
    """A legend whose upper left is at `anchor` (0..1 of the figure), a line in each run's look."""
    from matplotlib.lines import Line2D

    legend = figure.legend(
        [Line2D([], [], lw=2.4, **look(i)) for i in range(len(labels))],
        [f" {label}" for label in labels],  # a leading underscore would hide it
        loc="upper left",
        bbox_to_anchor=anchor,
        ncols=min(len(labels), columns),
        frameon=False,
        fontsize=fontsize,
        labelcolor=INK,
        handlelength=1.8,
        columnspacing=spacing,
    )
    for text in legend.get_texts():  # a dollar sign in an arm's name is no formula
        text.set_parse_math(False)
