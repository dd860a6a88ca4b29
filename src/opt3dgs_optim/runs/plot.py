"""A report as a picture: the metric over seconds and over iterations."""

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from opt3dgs_optim.runs.stats import Arm, Comparison

# Okabe and Ito's colour-blind-safe palette, without the yellow that white swallows.
COLOURS = ("#333333", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
STYLES = ("-", "--", ":")  # one for each round through the colours
FAINT = "#8a8a8a"
LABELS = {"psnr": "PSNR (dB)", "train_psnr": "training PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS"}
AXES = {"seconds": "run time (s)", "iteration": "iteration"}
RC: dict[Any, Any] = {  # text.*: a $ is a $
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "text.usetex"), False),
    **dict.fromkeys(("text.parse_math", "legend.frameon"), False),
    **{"axes.xmargin": 0.02, "axes.grid": True, "axes.grid.axis": "y", "axes.axisbelow": True},
    **{"grid.color": "#e4e4e4", "grid.linewidth": 0.6, "axes.edgecolor": "#999999"},
}


def draw(comparison: Comparison, path: Path, footer: str) -> None:
    """Draw `comparison` into the PNG file `path`, with `footer` in small print.

    Lines are means over seeds, bands reach from the least to the greatest. No matplotlib backend
    is chosen and no global setting stays changed.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    import matplotlib

    with matplotlib.rc_context(RC):
        _figure(comparison, footer).savefig(path)


def _figure(comparison: Comparison, footer: str) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    # " ": a label may begin with "_", which would hide it.
    labels = [f" {arm.name[:60]} (n = {len(arm.runs)})" for arm in comparison.arms]
    columns = max(1, min(4, 150 // (max(map(len, labels)) + 8)))  # of the legend
    height = 5 + 0.25 * -(-len(labels) // columns)  # inches
    figure = Figure(figsize=(11, height), dpi=150, facecolor="white", layout="constrained")
    metric = LABELS.get(comparison.metric, comparison.metric)
    panels = figure.subplots(1, len(AXES), sharey=True)
    for panel, (axis, name) in zip(panels, AXES.items(), strict=True):
        _panel(panel, comparison, axis)
        panel.set_xlabel(name)
    panels[0].set_ylabel(metric)
    lines = [Line2D([], [], lw=2.4, **_look(arm)) for arm in comparison.arms]
    scene = "" if comparison.scene is None else f", {comparison.scene}"
    figure.legend(  # a suptitle would lie below it
        lines,
        labels,
        ncols=columns,
        alignment="left",
        loc="outside upper left",
        title=f"{metric} against run time and iterations{scene}"[:85],
        title_fontproperties={"size": 13, "weight": "bold"},
    )
    better = "higher" if comparison.higher_is_better else "lower"
    caption = f"Lines: mean over the n seeds; bands: least to greatest; {better} is better. "
    caption += f"Dashed: the baseline's final mean. {footer}"
    figure.supxlabel(textwrap.fill(caption[:520], 175), fontsize=7.5, color="#666666")
    return figure


def _look(arm: Arm) -> dict[str, Any]:
    style = STYLES[arm.colour // len(COLOURS) % len(STYLES)]
    return {"color": COLOURS[arm.colour % len(COLOURS)], "linestyle": style}


def _panel(panel: Any, comparison: Comparison, axis: str) -> None:
    """The metric over seconds or iterations."""
    shown: list[np.ndarray] = []
    for arm in comparison.arms:
        series = [run.series(comparison.metric) for run in arm.runs]
        curves = [
            ((seconds if axis == "seconds" else iteration)[np.isfinite(y)], y[np.isfinite(y)])
            for iteration, seconds, y in series
            if np.isfinite(y).any()
        ]
        if not curves:
            continue
        x, table = _on_common_grid(curves)
        if len(table) > 1:
            low, high = table.min(axis=0), table.max(axis=0)
            panel.fill_between(x, low, high, color=_look(arm)["color"], alpha=0.16, lw=0)
        panel.plot(x, table.mean(axis=0), lw=1.8, **_look(arm))
        # Without the steep first fifth, which would flatten the differences to be seen.
        shown += [y[x >= 0.2 * x[-1]] for x, y in curves]
    if shown:
        low, high = np.concatenate(shown).min(), np.concatenate(shown).max()
        room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
        panel.set_ylim(low - room, high + room)
        if low < comparison.target < high:
            panel.axhline(comparison.target, lw=0.8, ls="--", color=FAINT, zorder=1)


def _on_common_grid(curves: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """All points of all curves inside the range they share: exact for piecewise lines."""
    end = min(x[-1] for x, _ in curves)
    start = min(end, max(x[0] for x, _ in curves))
    x = np.unique(np.concatenate([[start, end], *(x for x, _ in curves)]))
    x = x[(x >= start) & (x <= end)]
    return x, np.stack([np.interp(x, *curve) for curve in curves])
