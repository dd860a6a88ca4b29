"""The pictures of docs/landscapes.md, from the results' files."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch

from studies.landscapes.energies import (
    BOUNDARY,
    exact_rate,
    kramers_rate,
    nine_minima,
    nine_modes,
    well_potential,
)

Results = dict[str, Any]
PATHS = (
    *("sgld", "cyclic", "constant-0.3"),
    *("awsgld-clamped", "adam-constant-long", "adam-clamped-long"),
)
DPI = 110


def paths(results: Results, path: Path) -> None:
    """The landscape with the samples of one chain of six arms."""
    axis = torch.linspace(-BOUNDARY, BOUNDARY, 200, dtype=torch.float64)
    energy = nine_modes(torch.cartesian_prod(axis, axis)).reshape(200, 200).T
    names = [name for name in PATHS if f"nine-{name}" in results]
    figure, panels = plt.subplots(
        2, 3, figsize=(9.2, 6.0), layout="constrained", sharex=True, sharey=True
    )
    dots = None
    for panel, name in zip(panels.flat, names, strict=False):
        entry = results[f"nine-{name}"]
        points = entry["result"]["path"]
        panel.contourf(axis, axis, energy, levels=14, cmap="Greys", alpha=0.55)
        x, y = zip(*points, strict=True)
        panel.plot(x, y, color="#333333", lw=0.3, alpha=0.35)
        times = [i / max(len(points) - 1, 1) for i in range(len(points))]
        dots = panel.scatter(x, y, c=times, cmap="plasma", s=7, lw=0, vmin=0, vmax=1)
        minima = nine_minima().tolist()
        panel.scatter(*zip(*minima, strict=True), marker="+", color="#00a0c0", s=70, lw=1.6)
        label = entry["result"]["arm"]["label"].replace(" (control)", "")
        panel.set_title(label.replace("constant multiplier", "constant nu"), fontsize=10.5)
        panel.set(xlim=(-2.5, 2.5), ylim=(-2.5, 2.5), aspect="equal", xticks=[-2, 0, 2])
        panel.set_yticks([-2, 0, 2])
    for panel in panels.flat[len(names) :]:
        panel.axis("off")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06)  # pyright: ignore
    if dots is not None:
        bar = figure.colorbar(dots, ax=panels, location="right", shrink=0.8, ticks=[0, 0.5, 1])
        bar.set_label("share of the run", fontsize=10.5)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def escapes(results: Results, path: Path) -> None:
    """Escape rates over the barrier, on a logarithmic axis."""
    plain = results["escape-sgld"]["result"]["rows"]
    flat = results["escape-awsgld"]["result"]["rows"]
    heights = [row["height"] for row in plain]
    fine = [heights[0] + (heights[-1] - heights[0]) * i / 40 for i in range(41)]
    figure, axis = plt.subplots(figsize=(7.6, 4.9), layout="constrained")
    exact = [exact_rate(well_potential(h)) for h in fine]
    axis.plot(fine, [kramers_rate(h) for h in fine], "--", color="#56b4e9", lw=2, label="Kramers")
    axis.plot(fine, exact, color="#0072b2", lw=2, label="exact (quadrature)")
    theory = [row["flattened"] for row in flat]
    axis.plot(heights, theory, color="#e69f00", lw=2, label="eq. 14 with the exact theta")
    constant = [row["constant"] for row in flat]
    axis.plot(
        heights, constant, ":", color="#009e73", lw=2, label="constant nu of AWSGLD's mean, exact"
    )
    for rows, label, color, mark in (
        (plain, "SGLD, simulated", "#000000", "o"),
        (flat, "AWSGLD, simulated", "#d55e00", "s"),
    ):
        means = [statistics.fmean(row["rate"]) for row in rows]
        errors = [statistics.stdev(row["rate"]) for row in rows]
        points = axis.errorbar(heights, means, errors, fmt=mark, color=color, capsize=3, ms=6)
        points.set_label(label)
    axis.set(xlabel="barrier h / T", ylabel="escapes per unit of time", yscale="log")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=9.5, loc="lower left")
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def all_plots(results: Results, output: Path) -> None:
    """Write every picture into `output`."""
    paths(results, output / "nine.png")
    escapes(results, output / "kramers.png")
