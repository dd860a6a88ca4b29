"""The live view's picture: runs overlaid, error, nu, accepted pairs and phase over time."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from opt3dgs_optim.report_style import (
    FAINT,
    binned,
    draw_legend,
    label_of,
    look,
    panel_grid,
    plain_style,
)
from opt3dgs_optim.runread import Run

__all__ = ["draw_live"]

BINS = 100
EXPLOITATION = "exploitation"
LABELS = {"nu": "nu", "accepted": "accepted\npairs", "phase": "phase"}
LossName = str | None


def draw_live(labels: Sequence[str], runs: Sequence[Run], metric: str, *, narrow: bool) -> bytes:
    """A PNG of all runs, or b"" if they have logged nothing to draw.

    Args:
        labels: a name for each run.
        runs: in the order of the colours.
        metric: of the first panel, where it has been evaluated.
        narrow: over seconds alone, for a phone; else over seconds and iterations, side by side.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    rows = _rows(runs, metric)
    if not rows:
        return b""
    axes = ("seconds",) if narrow else ("seconds", "iteration")
    width = 4.4 if narrow else 11.0
    columns = legend_columns(labels, width, 2 if narrow else 4)
    heights = [_height(name, len(runs)) for name in rows]
    legend = 0.2 * -(-len(runs) // columns) + 0.2
    height = sum(heights) + 0.16 * (len(rows) - 1) + legend + 0.65
    figure, grid = panel_grid(
        heights,
        len(axes),
        (width, height),
        sides=(0.19, 0.97) if narrow else (0.075, 0.985),
        above=legend,
        below=0.55,
        gap=0.16 * len(rows) / sum(heights),
        dpi=200 if narrow else 150,
    )
    for column, axis in enumerate(axes):
        for row, name in enumerate(rows):
            _panel(grid[row, column], name, runs, axis)
            grid[row, 0].set_ylabel(LABELS.get(name, label_of(name)))
        grid[-1, column].set_xlabel("run time (s)" if axis == "seconds" else "iteration")
    for panel in grid.flat:
        plain_style(panel)
    figure.align_ylabels(grid[:, 0])
    _legend(figure, labels, height, columns, 0.02 if narrow else 0.068)
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    return picture.getvalue()


def _rows(runs: Sequence[Run], metric: str) -> list[str]:
    """Which panels have something to show, from the top."""
    rows = [metric] if any(len(run.series(metric)[2]) for run in runs) else []
    loss = _loss_name(runs)
    rows += [loss] if loss else []
    rows += [name for name in ("nu", "accepted") if any(_has(run, name) for run in runs)]
    rows += ["phase"] if any("phase" in run.steps for run in runs) else []
    return rows


def _loss_name(runs: Sequence[Run]) -> LossName:
    found = [name for name in ("loss", "energy") if any(_has(run, name) for run in runs)]
    return found[0] if found else None


def _has(run: Run, name: str) -> bool:
    return name in run.steps and bool(np.isfinite(run.steps[name]).any())


def _height(name: str, runs: int) -> float:
    """Inches."""
    if name == "phase":
        return 0.16 * runs + 0.14
    return 1.0 if name in LABELS else 1.9


def _panel(panel: Any, name: str, runs: Sequence[Run], axis: str) -> None:
    if name == "phase":
        _phase_bars(panel, runs, axis)
        return
    for i, run in enumerate(runs):
        if name in ("loss", "energy", "nu", "accepted"):
            iteration, seconds, values = run.series(name, "step")
            bins = BINS // 2 if name in LABELS else BINS  # nu and the share jump more
            x, y = binned(seconds if axis == "seconds" else iteration.astype(float), values, bins)
            panel.plot(x, y, lw=1.5, solid_capstyle="round", **look(i))
        else:
            iteration, seconds, y = run.series(name)
            x = seconds if axis == "seconds" else iteration.astype(float)
            panel.plot(x, y, lw=1.7, marker="o", ms=3.2, **look(i))
    if name == "nu":
        panel.axhline(1.0, lw=0.8, ls=(0, (4, 3)), color=FAINT, zorder=1)
    elif name == "accepted":
        panel.set_ylim(-0.04, 1.04)
    elif name in ("loss", "energy"):
        log_scale(panel)
    else:
        _zoom(panel, [run.series(name) for run in runs])


def legend_columns(labels: Sequence[str], width: float, most: int) -> int:
    """How many columns of the longest label fit into so many inches, 1 to `most`."""
    longest = max(map(len, labels), default=0)
    return max(1, min(most, int(width / (0.45 + 0.075 * longest))))


def log_scale(panel: Any) -> None:
    """Logarithmic if all values allow it, with plain numbers: powers of ten are too wide."""
    values = [y for line in panel.get_lines() for y in line.get_ydata()]
    if not values or min(values) <= 0:
        return
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

    panel.set_yscale("log")
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_formatter("")
    if max(values) < 10 * min(values):  # hardly a power of ten in it
        panel.yaxis.set_major_locator(MaxNLocator(5))
    elif max(values) < 1000 * min(values):
        panel.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))


def _zoom(panel: Any, series: Sequence[tuple[np.ndarray, ...]]) -> None:
    """Cut off the steep first fifth, which would flatten what is going on now."""
    last = max((int(iteration[-1]) for iteration, _, _ in series if len(iteration)), default=0)
    shown = [values[iteration >= 0.2 * last] for iteration, _, values in series]
    values = np.concatenate(shown) if shown else np.array([])
    values = values[np.isfinite(values)]
    if len(values) > 2 * len(series):
        room = 0.08 * float(values.max() - values.min()) or 1.0
        panel.set_ylim(values.min() - room, values.max() + room)


def _phase_bars(panel: Any, runs: Sequence[Run], axis: str) -> None:
    """A bar per run, pale while exploring and full while exploiting."""
    for i, run in enumerate(runs):
        phase = run.steps.get("phase", np.array([], str))
        if not len(phase):
            continue
        x = run.steps[axis].astype(float)
        starts = [0, *(np.flatnonzero(phase[1:] != phase[:-1]) + 1)]
        for start, end in zip(starts, [*starts[1:], len(phase) - 1], strict=True):
            full = phase[start] == EXPLOITATION
            panel.barh(
                -i,
                x[end] - x[start],
                left=x[start],
                height=0.62,
                color=look(i)["color"],
                alpha=1.0 if full else 0.28,
                lw=0,
            )
    panel.set_ylim(-len(runs) + 0.4, 0.6)
    panel.set_yticks([])


def _legend(figure: Any, labels: Sequence[str], height: float, columns: int, left: float) -> None:
    anchor = (left, 1 - 0.02 / height)
    draw_legend(figure, labels, anchor, columns, fontsize=8.5, spacing=1.4)
