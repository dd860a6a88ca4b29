"""A report as a picture: the metric over iterations and over seconds."""

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from opt3dgs_optim.runs.stats import Arm, Comparison, higher_is_better

# Okabe and Ito's colour-blind-safe palette, without the yellow that white swallows.
COLOURS = ("#333333", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
RC: dict[Any, Any] = {  # text.*: a $ is a $
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "text.usetex"), False),
    **dict.fromkeys(("text.parse_math", "legend.frameon"), False),
    **{"axes.xmargin": 0.02, "axes.grid": True, "axes.grid.axis": "y", "grid.color": "#e4e4e4"},
}


def draw(comparison: Comparison, path: Path, footer: str) -> None:
    """Draw `comparison` into the PNG file `path`, with `footer` in small print; a line a run.

    No matplotlib backend is chosen and no global setting stays changed.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    import matplotlib
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    metric, arms = comparison.metric, comparison.arms
    better = "higher" if higher_is_better(metric) else "lower"
    caption = f"A line is a run, an arm has n; {better} is better. "
    caption += f"Dashed: the baseline's final mean. {footer}"
    with matplotlib.rc_context(RC):
        size = (11, 5 + 0.25 * len(arms) / 3)  # inches
        figure = Figure(figsize=size, dpi=150, facecolor="white", layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for i, name in enumerate(("iteration", "run time (s)")):
            _panel(panels[i], comparison, i)
            panels[i].set_xlabel(name)
        panels[0].set_ylabel(metric)
        figure.legend(  # a suptitle would lie below it; " ": "_" at its begin would hide a label
            [Line2D([], [], lw=2.4, color=_colour(arm)) for arm in arms],
            [f" {arm.name[:40]} (n = {len(arm.runs)})" for arm in arms],
            ncols=3,
            alignment="left",
            loc="outside upper left",
            title=f"{metric} against run time: {comparison.scene}"[:85].removesuffix(": "),
        )
        figure.supxlabel(textwrap.fill(caption[:520], 175), fontsize=7.5, color="#666666")
        figure.savefig(path)


def _colour(arm: Arm) -> str:
    return COLOURS[arm.colour % len(COLOURS)]


def _panel(panel: Any, comparison: Comparison, axis: int) -> None:
    """The metric over iterations (axis 0) or seconds (1)."""
    shown: list[np.ndarray] = []
    for arm in comparison.arms:
        for run in arm.runs:
            series = run.series(comparison.metric)
            finite = np.isfinite(series[2])
            x, y = series[axis][finite], series[2][finite]
            panel.plot(x, y, lw=1.6, alpha=0.9, color=_colour(arm))
            # Without the steep first fifth, which would flatten the differences to be seen.
            shown.append(y[x >= 0.2 * x.max(initial=0)])
    values = np.concatenate(shown)
    if len(values):
        low, high = values.min(), values.max()
        room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
        panel.set_ylim(low - room, high + room)
    panel.axhline(comparison.target, lw=0.8, ls="--", color="#8a8a8a", zorder=1)
