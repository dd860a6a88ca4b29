"""A report as a picture: the metric over seconds and over iterations."""

import textwrap
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from opt3dgs_optim.runs.lines import Run
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
LARGEST = 1e30  # far below where matplotlib's own arithmetic overflows

Curve = tuple[np.ndarray, np.ndarray]


def draw(comparison: Comparison, path: Path, footer: str) -> None:
    """Draw `comparison` into the PNG file `path`, with `footer` in small print.

    Lines are means over seeds, bands reach from the least to the greatest. No matplotlib backend
    is chosen and no global setting stays changed.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    import matplotlib

    with matplotlib.rc_context(RC), warnings.catch_warnings():
        # Names in letters that matplotlib's font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        _figure(comparison, footer).savefig(path)


def _figure(comparison: Comparison, footer: str) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    labels = [_label(arm, comparison) for arm in comparison.arms]
    columns = max(1, min(4, 150 // (max(map(len, labels)) + 8)))  # of the legend
    height = 5 + 0.25 * -(-len(labels) // columns)  # inches
    figure = Figure(figsize=(11, height), dpi=150, facecolor="white", layout="constrained")
    metric = printable(LABELS.get(comparison.metric, comparison.metric))[:40]
    panels = figure.subplots(1, len(AXES), sharey=True)
    for panel, (axis, name) in zip(panels, AXES.items(), strict=True):
        _panel(panel, comparison, axis)
        panel.set_xlabel(name)
    panels[0].set_ylabel(metric)
    lines = [Line2D([], [], lw=2.4, **_look(arm)) for arm in comparison.arms]
    scene = "" if comparison.scene is None else f", {comparison.scene}"
    # " ": a label may begin with "_", which would hide it. A suptitle would lie below the legend.
    figure.legend(
        lines,
        [f" {la}" for la in labels],
        ncols=columns,
        alignment="left",
        loc="outside upper left",
        title=printable(f"{metric} against run time and iterations{scene}")[:85],
        title_fontproperties={"size": 13, "weight": "bold"},
    )
    better = {True: "; higher is better", False: "; lower is better", None: ""}
    caption = "Lines: mean over seeds; bands: least to greatest"
    caption += f"{better[comparison.higher_is_better]}. Dashed: "
    caption += f"the baseline's final mean. {footer}"
    figure.supxlabel(textwrap.fill(printable(caption)[:520], 175), fontsize=7.5, color="#666666")
    return figure


def _label(arm: Arm, comparison: Comparison) -> str:
    seeds = f"{len(arm.runs)} seeds" if len(arm.runs) > 1 else "1 seed"
    return f"{printable(arm.name)[:60]} ({seeds}{', baseline' * (arm.name == comparison.baseline)})"


def printable(text: str) -> str:
    """`text` on one line, with spaces in place of what cannot be printed."""
    return "".join(c if c.isprintable() else " " for c in text)


def _look(arm: Arm) -> dict[str, Any]:
    style = STYLES[arm.colour // len(COLOURS) % len(STYLES)]
    return {"color": COLOURS[arm.colour % len(COLOURS)], "linestyle": style}


def _panel(panel: Any, comparison: Comparison, axis: str) -> None:
    """The metric over seconds or iterations."""
    shown: list[np.ndarray] = []
    for arm in comparison.arms:
        curves = [curve for run in arm.runs if len((curve := _curve(run, comparison, axis))[0])]
        if not curves:
            continue
        x, table = _on_common_grid(curves)
        if len(table) > 1:
            low, high = table.min(axis=0), table.max(axis=0)
            panel.fill_between(x, low, high, color=_look(arm)["color"], alpha=0.16, lw=0)
        panel.plot(x, table.mean(axis=0), lw=1.8, **_look(arm))
        # Without the steep first fifth, which would flatten the differences to be seen.
        shown += [y[x >= 0.2 * x[-1]] for x, y in curves]
    if not shown:
        panel.text(0.5, 0.5, "nothing finite", transform=panel.transAxes, ha="center", color=FAINT)
        return
    low, high = float(np.concatenate(shown).min()), float(np.concatenate(shown).max())
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    panel.set_ylim(low - room, high + room)
    if low < comparison.target < high:
        panel.axhline(comparison.target, lw=0.8, ls="--", color=FAINT, zorder=1)


def _curve(run: Run, comparison: Comparison, axis: str) -> Curve:
    """All finite evaluations of a run."""
    iteration, seconds, values = run.series(comparison.metric)
    shown = np.abs(values) < LARGEST
    return (seconds if axis == "seconds" else iteration)[shown], values[shown]


def _on_common_grid(curves: list[Curve]) -> Curve:
    """All points of all curves inside the range they share: exact for piecewise lines."""
    end = min(x[-1] for x, _ in curves)
    start = min(end, max(x[0] for x, _ in curves))
    x = np.unique(np.concatenate([[start, end], *(x for x, _ in curves)]))
    x = x[(x >= start) & (x <= end)]
    return x, np.stack([np.interp(x, *curve) for curve in curves])
