"""A report as a picture: the metric over seconds and over iterations, step columns underneath."""

from __future__ import annotations

import textwrap
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from opt3dgs_optim.runs.stats import Arm, Comparison, higher_is_better, step_names

# Okabe and Ito's colour-blind-safe palette, without the yellow that white swallows.
COLOURS = ("#333333", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
STYLES = ("-", (0, (5, 1.5)), (0, (1.5, 1.2)))  # one for each round through the colours
INK, GREY, FAINT = "#222222", "#666666", "#8a8a8a"
LABELS = {"psnr": "PSNR (dB)", "train_psnr": "training PSNR (dB)", "ssim": "SSIM", "lpips": "LPIPS"}
AXES = {"seconds": "run time (s)", "iteration": "iteration"}
STYLE: dict[Any, Any] = dict.fromkeys(("axes.spines.top", "axes.spines.right"), False)
STYLE |= dict.fromkeys(("text.usetex", "text.parse_math", "legend.frameon"), False)  # $ is a $
STYLE |= dict.fromkeys(("axes.labelcolor", "xtick.color", "ytick.color", "legend.labelcolor"), INK)
STYLE |= {"axes.facecolor": "white", "axes.edgecolor": "#999999", "axes.xmargin": 0.02}
STYLE |= {"axes.grid": True, "axes.grid.axis": "y", "axes.axisbelow": True}
STYLE |= {"grid.color": "#e4e4e4", "grid.linewidth": 0.6, "axes.labelsize": 10}
STYLE |= {"xtick.labelsize": 9, "ytick.labelsize": 9, "xtick.major.size": 3, "ytick.major.size": 3}
STYLE |= {"legend.fontsize": 9.5, "legend.handlelength": 1.8, "legend.columnspacing": 1.6}
PANELS = 4  # step columns shown
BINS = 50  # that a step column is averaged in: single steps are too noisy to look at
LARGEST = 1e30  # far below where matplotlib's own arithmetic overflows

Curve = tuple[np.ndarray, np.ndarray]


def draw(comparison: Comparison, path: Path, footer: str) -> None:
    """Draw `comparison` into the PNG file `path`, with `footer` in small print.

    Lines are means over seeds, bands reach from the least to the greatest. Uses matplotlib's Agg
    canvas alone: no backend is chosen and no global setting stays changed.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    import matplotlib

    with matplotlib.rc_context(STYLE), warnings.catch_warnings():
        # Names in letters that matplotlib's font lacks are drawn as boxes.
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        _figure(comparison, footer).savefig(path)


def _figure(comparison: Comparison, footer: str) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    rows = [None, *step_names([run for arm in comparison.arms for run in arm.runs])[:PANELS]]
    labels = [_label(arm, comparison) for arm in comparison.arms]
    columns = max(1, min(4, 150 // (max(map(len, labels)) + 8)))  # of the legend
    above = 0.8 + 0.25 * -(-len(labels) // columns)  # inches, as all here
    height = above + 3.4 + 1.3 * (len(rows) - 1) + 1.0
    figure = Figure(figsize=(11, height), dpi=150, facecolor="white")
    FigureCanvasAgg(figure)
    spacing = {"left": 0.075, "right": 0.985, "top": 1 - above / height, "bottom": 1.0 / height}
    spacing |= {"wspace": 0.06, "hspace": 0.14, "height_ratios": [3.4, *[1.15] * (len(rows) - 1)]}
    shape = {"sharex": "col", "sharey": "row", "squeeze": False}
    grid = figure.subplots(len(rows), len(AXES), gridspec_kw=spacing, **shape)
    for panels, (axis, name) in zip(grid.T, AXES.items(), strict=True):
        for panel, step in zip(panels, rows, strict=True):
            _panel(panel, comparison, axis, step)
        _phases(panels, comparison, axis)
        panels[-1].set_xlabel(name)
    metric = _cut(LABELS.get(comparison.metric, comparison.metric), 40)
    for panel, step in zip(grid[:, 0], rows, strict=True):
        panel.set_ylabel(_cut(step, 16) if step else metric)
    figure.align_ylabels(grid[:, 0])
    lines = [Line2D([], [], lw=2.4, **_look(arm)) for arm in comparison.arms]
    place = {"loc": "upper left", "bbox_to_anchor": (0.068, 1 - 0.5 / height), "ncols": columns}
    figure.legend(lines, [f" {label}" for label in labels], **place)  # " ": one may begin with "_"
    scene = "" if comparison.scene is None else f", {comparison.scene}"
    title = _cut(f"{metric} against run time and iterations{scene}", 85)
    figure.text(0.075, 1 - 0.22 / height, title, fontsize=13, weight="bold", color=INK, va="top")
    better = "higher" if higher_is_better(comparison.metric) else "lower"
    caption = f"Lines: mean over seeds; bands: least to greatest; {better} is better. Dashed: "
    caption += f"the baseline's final mean (above), 1 (below). Dotted: next phase. {footer}"
    small = textwrap.fill(_cut(caption, 520), 175)
    figure.text(0.075, 0.1 / height, small, fontsize=7.5, color=GREY, va="bottom")
    return figure


def _label(arm: Arm, comparison: Comparison) -> str:
    seeds = f"{len(arm.runs)} seeds" if len(arm.runs) > 1 else "1 seed"
    return f"{_cut(arm.name, 60)} ({seeds}{', baseline' * (arm.name == comparison.baseline)})"


def _cut(text: str, length: int) -> str:
    text = "".join(c if c.isprintable() else " " for c in text)
    return text if len(text) <= length else text[: length - 1] + "…"


def _look(arm: Arm) -> dict[str, Any]:
    style = STYLES[arm.colour // len(COLOURS) % len(STYLES)]
    return {"color": COLOURS[arm.colour % len(COLOURS)], "linestyle": style}


def _panel(panel: Any, comparison: Comparison, axis: str, step: str | None) -> None:
    """The metric, or a column of the step lines, over seconds or iterations."""
    seen: list[Curve] = []
    for arm in comparison.arms:
        curves = _curves(arm, comparison.metric if step is None else step, axis, step is not None)
        if not curves:
            continue
        x, table = _on_common_grid(curves)
        if len(table) > 1:
            low, high = table.min(axis=0), table.max(axis=0)
            panel.fill_between(x, low, high, color=_look(arm)["color"], alpha=0.16, lw=0)
        panel.plot(x, table.mean(axis=0), lw=1.8, solid_capstyle="round", **_look(arm))
        if step is None:
            panel.plot(x[-1:], table.mean(axis=0)[-1:], "o", ms=4, color=_look(arm)["color"])
        seen += curves
    level = comparison.target if step is None else 1.0
    if not seen:
        words = "no finite evaluation" if step is None else "nothing finite"
        panel.text(0.5, 0.5, words, transform=panel.transAxes, ha="center", color=FAINT)
        return
    if step is None:
        _zoom(panel, seen)
    low, high = panel.get_ylim()
    if level is not None and low < level < high:
        panel.axhline(level, lw=0.8, ls=(0, (4, 3)), color=FAINT, zorder=1)


def _curves(arm: Arm, name: str, axis: str, step: bool) -> list[Curve]:
    """One curve a run: all finite evaluations, or the means of the steps of equal stretches."""
    curves = []
    for run in arm.runs:
        iteration, seconds, values = run.series(name, "step" if step else "evaluation")
        x = seconds if axis == "seconds" else iteration.astype(float)
        finite = np.abs(values) < LARGEST
        x, values = x[finite], values[finite]
        if step and len(x):
            parts = np.array_split(np.arange(len(x)), min(BINS, len(x)))
            x = np.array([x[part].mean() for part in parts])
            values = np.array([values[part].mean() for part in parts])
        if len(x):
            curves.append((x, values))
    return curves


def _on_common_grid(curves: list[Curve]) -> Curve:
    """All points of all curves inside the range they share: exact for piecewise lines."""
    start, end = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    x = np.unique(np.concatenate([[min(start, end), end], *(x for x, _ in curves)]))
    x = x[(x >= min(start, end)) & (x <= end)]
    return x, np.stack([np.interp(x, *curve) for curve in curves])


def _zoom(panel: Any, curves: list[Curve]) -> None:
    """Cut off the steep first fifth of the run, which would flatten the differences to be seen."""
    last = max(x[-1] for x, _ in curves)
    shown = np.concatenate([y[x >= 0.2 * last] for x, y in curves])
    low, high = float(shown.min()), float(shown.max())
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    panel.set_ylim(low - room, high + room)


def _phases(panels: Any, comparison: Comparison, axis: str) -> None:
    """Dotted lines where a phase begins, at the mean over an arm's seeds; a name stands once."""
    places: dict[tuple[str, float], None] = {}
    for arm in comparison.arms:
        begins: dict[str, list[float]] = {}
        for run in arm.runs:
            phase = run.steps.get("phase", np.array([], str))
            x, phase = run.steps[axis][: len(phase)][phase != ""], phase[phase != ""]
            for i in np.flatnonzero(phase[1:] != phase[:-1]) + 1:
                begins.setdefault(str(phase[i]), []).append(float(x[i]))
        places |= {(name, round(float(np.mean(x)), 3)): None for name, x in begins.items()}
    for x in {x for _, x in places}:
        for panel in panels:
            panel.axvline(x, lw=1.0, ls=(0, (1, 1.5)), color=FAINT, zorder=1)
    where = {"xycoords": ("data", "axes fraction"), "ha": "right", "fontsize": 8.5, "color": GREY}
    for name, x in dict(reversed(places)).items():
        panels[0].annotate(f"{_cut(name, 40)} ", (x, 0.02), **where)
