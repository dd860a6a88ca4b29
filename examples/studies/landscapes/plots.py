"""The pictures of docs/landscapes.md, from the results' files."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

import torch

from studies.landscapes.energies import (
    BOUNDARY,
    exact_rate,
    kramers_rate,
    nine_minima,
    nine_modes,
    well_potential,
)
from studies.landscapes.laws import WELL_BINS, WELL_EDGE

Results = dict[str, Any]
PATHS = (
    "sgld",
    "cyclic",
    "constant-0.3",
    "awsgld-clamped",
    "adam-constant-long",
    "adam-clamped-long",
)
# "adam-clamped" is the beginning of its long run. The colours differ in lightness as well.
STYLES = {
    "sgld": ("#000000", "-"),
    "cyclic": ("#8c8c8c", "-"),
    "constant-0.5": ("#56b4e9", "--"),
    "constant-0.3": ("#0072b2", "--"),
    "awsgld": ("#e69f00", "-"),
    "awsgld-clamped": ("#d55e00", "-"),
    "adam": ("#000000", ":"),
    "adam-positive": ("#cc79a7", ":"),
    "adam-constant-long": ("#009e73", "--"),
    "adam-clamped-long": ("#7b3294", "-"),
}
DPI = 110


def short(label: str) -> str:
    """A label that fits over a panel."""
    return label.replace(" (control)", "").replace("constant multiplier", "constant nu")


def paths(results: Results, path: Path) -> None:
    """The landscape with the samples of one chain of six arms."""
    import matplotlib.pyplot as plt

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
        panel.set_title(short(entry["result"]["arm"]["label"]), fontsize=10.5)
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


def modes(results: Results, path: Path) -> None:
    """How many of the nine wells a chain has found, over the steps."""
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(8.2, 6.4), layout="constrained")
    for name, (color, line) in STYLES.items():
        if f"nine-{name}" not in results:
            continue
        entry = results[f"nine-{name}"]
        curve = entry["result"]["curve"]
        thousands = [step / 1000 for step in curve["iterations"]]
        label = short(entry["result"]["arm"]["label"])
        label += f" ({entry['settings']['steps'] / 1000:,.0f}k)" if "Adam" in label else ""
        axis.plot(thousands, curve["modes"], color=color, ls=line, lw=2, label=label)
    axis.set(xlabel="steps (1,000)", ylabel="wells found, mean of the chains", ylim=(0, 9.3))
    axis.set_yticks(range(10))
    axis.grid(alpha=0.3)
    figure.legend(fontsize=9.5, loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def wells(results: Results, path: Path) -> None:
    """The double well's law: exact, of SGLD, and of AWSGLD before and after re-weighting."""
    import matplotlib.pyplot as plt

    heights = sorted({name.split("-")[-1] for name in results if name.startswith("well-")})
    figure, panels = plt.subplots(1, len(heights), figsize=(9.2, 3.7), layout="constrained")
    width = 2 * WELL_EDGE / WELL_BINS
    centres = [-WELL_EDGE + width * (i + 0.5) for i in range(WELL_BINS)]
    for panel, height in zip(panels, heights, strict=True):
        plain = results[f"well-sgld-{height}"]["result"]
        flat = results[f"well-awsgld-{height}"]["result"]
        kinds = (
            (plain["truth"], "exp(-U/T) / Z", {"color": "#bbbbbb", "lw": 6}),
            (plain["raw"], "SGLD", {"color": "#000000", "lw": 1.3}),
            (flat["raw"], "AWSGLD, visits", {"color": "#e69f00", "lw": 1.5, "ls": "--"}),
            (flat["weighted"], "AWSGLD, re-weighted", {"color": "#d55e00", "lw": 1.8}),
        )
        for mass, label, style in kinds:
            panel.plot(centres, [m / width for m in mass], label=label, **style)
        panel.set(title=f"h / T = {height}", xlabel="x", ylim=(0, None))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("density")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def escapes(results: Results, path: Path) -> None:
    """Escape rates over the barrier, on a logarithmic axis."""
    import matplotlib.pyplot as plt

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
    import matplotlib

    matplotlib.use("Agg")
    paths(results, output / "nine.png")
    modes(results, output / "modes.png")
    wells(results, output / "well.png")
    escapes(results, output / "kramers.png")
