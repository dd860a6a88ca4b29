"""A report as a picture: the metric over seconds and over iterations, nu and pairs underneath."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from opt3dgs_optim.report_stats import Arm, Comparison, higher_is_better
from opt3dgs_optim.report_style import (
    FAINT,
    INK,
    binned,
    draw_legend,
    label_of,
    look,
    panel_grid,
    plain_style,
)
from opt3dgs_optim.runread import Run

__all__ = ["draw"]

AXES = ("seconds", "iteration")
LEGEND_COLUMNS = 4


def draw(comparison: Comparison, path: Path, footer: str) -> None:
    """Draw `comparison` into the PNG file `path`, with `footer` in small print.

    Lines are means over seeds, bands reach from the least to the greatest.

    Raises:
        ModuleNotFoundError: matplotlib is not installed.
    """
    extras = [name for name in ("nu", "accepted") if _has_step(comparison, name)]
    heights = [3.4, *[1.15] * len(extras)]
    legend = 0.25 * -(-len(comparison.arms) // LEGEND_COLUMNS)  # inches
    figure, grid = panel_grid(
        heights,
        len(AXES),
        (11, 1.85 + legend + sum(heights)),
        sides=(0.075, 0.985),
        above=0.8 + legend,
        below=1.0,
        gap=0.14,
        dpi=150,
    )
    for column, axis in enumerate(AXES):
        _metric_panel(grid[0, column], comparison, axis)
        for row, name in enumerate(extras, start=1):
            _step_panel(grid[row, column], comparison, axis, name)
        grid[-1, column].set_xlabel("run time (s)" if axis == "seconds" else "iteration")
        _phases(grid[:, column], comparison, axis)
    for row, name in enumerate(["metric", *extras]):
        labels = {"nu": "nu", "accepted": "accepted\npairs (share)"}
        grid[row, 0].set_ylabel(labels.get(name, label_of(comparison.metric)))
    for panel in grid.flat:
        plain_style(panel)
    _texts(figure, comparison, footer)
    figure.savefig(path)


def _has_step(comparison: Comparison, name: str) -> bool:
    return any(name in run.steps for arm in comparison.arms for run in arm.runs)


def _metric_panel(panel: Any, comparison: Comparison, axis: str) -> None:
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    for i, arm in enumerate(comparison.arms):
        curves = _metric_curves(arm, comparison.metric, axis)
        if curves:
            x, table = _on_common_grid(curves)
            _line_and_band(panel, x, table, i)
            panel.plot(x[-1:], table.mean(axis=0)[-1:], "o", ms=4, color=look(i)["color"])
            seen += curves
    if not seen:
        text = f"no finite evaluation of {comparison.metric}"
        panel.text(0.5, 0.5, text, transform=panel.transAxes, ha="center", color=FAINT)
        return
    if comparison.target is not None:
        panel.axhline(comparison.target, lw=0.8, ls=(0, (4, 3)), color=FAINT, zorder=1)
    _zoom(panel, seen)


def _metric_curves(arm: Arm, metric: str, axis: str) -> list[tuple[np.ndarray, np.ndarray]]:
    curves = []
    for run in arm.runs:
        iteration, seconds, values = run.series(metric)
        x = seconds if axis == "seconds" else iteration.astype(float)
        finite = np.isfinite(values)
        if finite.any():
            curves.append((x[finite], values[finite]))
    return curves


def _on_common_grid(curves: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """All points of all curves inside the range they share: exact for piecewise lines."""
    start, end = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    x = np.unique(np.concatenate([[min(start, end), end], *(x for x, _ in curves)]))
    x = x[(x >= min(start, end)) & (x <= end)]
    return x, np.stack([np.interp(x, *curve) for curve in curves])


def _line_and_band(panel: Any, x: np.ndarray, table: np.ndarray, index: int) -> None:
    style = look(index)
    if len(table) > 1:
        low, high = table.min(axis=0), table.max(axis=0)
        panel.fill_between(x, low, high, color=style["color"], alpha=0.16, lw=0)
    panel.plot(x, table.mean(axis=0), lw=1.8, solid_capstyle="round", **style)


def _zoom(panel: Any, curves: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Cut off the steep first fifth of the run, which would flatten the differences to be seen."""
    last = max(x[-1] for x, _ in curves)
    shown = np.concatenate([y[x >= 0.2 * last] for x, y in curves])
    low, high = float(shown.min()), float(shown.max())
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    panel.set_ylim(low - room, high + room)


def _step_panel(panel: Any, comparison: Comparison, axis: str, name: str) -> None:
    for i, arm in enumerate(comparison.arms):
        curves = [_binned_steps(run, name, axis) for run in arm.runs]
        curves = [curve for curve in curves if len(curve[0])]
        if curves:
            _line_and_band(panel, *_on_common_grid(curves), i)
    if name == "nu":
        panel.axhline(1.0, lw=0.8, ls=(0, (4, 3)), color=FAINT, zorder=1)
    else:
        panel.set_ylim(-0.04, 1.04)


def _binned_steps(run: Run, name: str, axis: str) -> tuple[np.ndarray, np.ndarray]:
    iteration, seconds, values = run.series(name, "step")
    return binned(seconds if axis == "seconds" else iteration.astype(float), values)


def _phases(panels: Any, comparison: Comparison, axis: str) -> None:
    """Vertical lines where the phase changes: one in grey if the arms agree, else in colours."""
    found = [(i, _switches(arm, axis)) for i, arm in enumerate(comparison.arms)]
    found = [(i, switches) for i, switches in found if switches]
    places = {(round(x, 3), name) for _, switches in found for x, name in switches}
    agree = len(places) == max((len(switches) for _, switches in found), default=0)
    for i, switches in found[:1] if agree else found:
        for x, name in switches:
            colour = FAINT if agree else look(i)["color"]
            for panel in panels:
                panel.axvline(x, lw=1.0, ls=(0, (1, 1.5)), color=colour, zorder=1)
            if agree:
                panels[0].annotate(
                    f"{name} ",
                    (x, 0.02),
                    xycoords=("data", "axes fraction"),
                    ha="right",
                    fontsize=8.5,
                    color="#666666",
                )


def _switches(arm: Arm, axis: str) -> list[tuple[float, str]]:
    """(mean place over the seeds, name) of every phase that begins during the run."""
    places: dict[str, list[float]] = {}
    for run in arm.runs:
        phase = run.steps.get("phase", np.array([], str))
        for i in np.flatnonzero(phase[1:] != phase[:-1]) + 1:
            places.setdefault(str(phase[i]), []).append(float(run.steps[axis][i]))
    return [(float(np.mean(where)), name) for name, where in places.items()]


def _texts(figure: Any, comparison: Comparison, footer: str) -> None:
    height = figure.get_figheight()
    metric = label_of(comparison.metric)
    title = f"{metric} against run time and iterations"
    if comparison.scene is not None:
        title += f", {comparison.scene}"
    place = {"fontsize": 13, "weight": "bold", "color": INK, "va": "top", "parse_math": False}
    figure.text(0.075, 1 - 0.22 / height, title, **place)
    labels = []
    for arm in comparison.arms:
        seeds = f"{len(arm.runs)} seeds" if len(arm.runs) > 1 else "1 seed"
        role = ", baseline" if arm.name == comparison.baseline else ""
        labels.append(f"{arm.name} ({seeds}{role})")
    anchor = (0.068, 1 - 0.5 / height)
    draw_legend(figure, labels, anchor, LEGEND_COLUMNS, fontsize=9.5, spacing=1.6)
    better = "higher" if higher_is_better(comparison.metric) else "lower"
    caption = f"Lines: mean over seeds; bands: least to greatest; {better} is better. "
    caption += "Dashed: the baseline's final mean (above), nu = 1 (below). Dotted: next phase. "
    text = textwrap.fill(caption + footer, 175)
    small = {"fontsize": 7.5, "color": "#666666", "va": "bottom", "parse_math": False}
    figure.text(0.075, 0.1 / height, text, **small)
