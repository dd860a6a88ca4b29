"""Figures and tables of the explanation pages: python examples/studies/figures.py [NAME...]

`performance.png`, `stability.png` and `collapse.png` in docs/figures, and the tables of the pages
on performance and stability, all from committed JSON records; nothing is trained or timed here.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from splatting.stopping import command

from studies.pages import filled, table

DOCS = Path(__file__).resolve().parents[2] / "docs"
FIGURES = DOCS / "figures"
BENCHMARK = DOCS / "benchmarks" / "step_cpu.json"
STABILITY = DOCS / "results" / "stability" / "stability.json"
STEPS = {  # of the benchmark: what the page calls them, and their colour
    "the paper's exploitation": "#d55e00",
    "defaults, last thirtieth": "#56b4e9",
    "the paper's exploration": "#e69f00",
    "defaults": "#0072b2",
}
OPTIMIZERS = {
    "Adam": ("Adam", "#555555"),
    "LQNAdam": ("LQNAdam", "#0072b2"),
    "two-loop + line search": ("L-BFGS, line search", "#009e73"),
}
FALLS = (("lund_door", 2), ("lego", 1))  # scene and seed of the largest falls
COLLAPSE = {  # arm: name and colour
    "mcmc": ("3DGS-MCMC", "#999999"),
    "paper": ("the paper's preset", "#d55e00"),
    "awsgld-stable": ("EnergyHistogram()", "#0072b2"),
}
ITERATIONS = 30_000
TEXT = 12  # points; the figures are made for the width of a phone


def axes_of(width: float, height: float, panels: int = 1) -> tuple[Any, list[Any]]:
    """A figure with panels side by side, without the frame's upper and right side."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=150, layout="constrained", facecolor="white")
    axes = figure.subplots(1, panels, squeeze=False)[0]
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=TEXT - 1)
        axis.grid(axis="y", color="#e4e4e4", lw=0.8)
        axis.set_axisbelow(True)
    return figure, list(axes)


def legend(figure: Any, axis: Any) -> None:
    """The names of the lines, above all panels."""
    handles, labels = axis.get_legend_handles_labels()
    place: dict[str, Any] = {"loc": "outside upper center", "ncols": 3, "frameon": False}
    figure.legend(handles, labels, fontsize=TEXT, **place)


def spread(heights: Sequence[float], apart: float) -> list[float]:
    """Heights of names beside the ends of lines: in the same order, at least so far apart."""
    order = np.argsort(heights)
    placed = np.array(heights, dtype=float)[order]
    for _ in range(100):
        gaps = np.diff(placed)
        for i in np.flatnonzero(gaps < apart - 1e-9):
            move = (apart - (placed[i + 1] - placed[i])) / 2
            placed[i], placed[i + 1] = placed[i] - move, placed[i + 1] + move
    found = np.empty_like(placed)
    found[order] = placed
    return found.tolist()


def performance(path: Path) -> None:
    """What a step costs, as a multiple of six torch Adams, over the number of Gaussians."""
    bench = json.loads(BENCHMARK.read_text(encoding="utf-8"))
    results, counts = bench["results"], [int(count) for count in bench["results"]]
    figure, (axis,) = axes_of(6.4, 3.8)
    lines = {name: [results[str(n)][name]["per_adam"] for n in counts] for name in STEPS}
    heights = spread([line[-1] for line in lines.values()], 0.16)
    for (name, colour), height in zip(STEPS.items(), heights, strict=True):
        axis.plot(counts, lines[name], color=colour, lw=2.5, marker="o")
        axis.annotate(f"  {name}", (counts[-1], height), color=colour, fontsize=TEXT, va="center")
    axis.plot(counts[:: len(counts) - 1], [1, 1], color="#555555", lw=1.2, ls="--")
    axis.annotate("six Adams", (counts[0], 1.03), color="#555555", fontsize=TEXT - 1)
    axis.set(xscale="log", xlim=(counts[0] * 0.8, counts[-1] * 110))
    axis.set_ylim(0.8, max(max(line) for line in lines.values()) * 1.08)
    axis.set_xticks(counts, [f"{n:,}" for n in counts])
    axis.minorticks_off()
    axis.set_xlabel("Gaussians", fontsize=TEXT, loc="left")
    axis.set_ylabel("time of a step / Adam's", fontsize=TEXT)
    figure.savefig(path)


def stability(path: Path) -> None:
    """Digits reached on quadratics over their condition, and the error in Rosenbrock's valley."""
    results = json.loads(STABILITY.read_text(encoding="utf-8"))
    figure, (left, right) = axes_of(7.4, 3.9, 2)
    for key, (name, colour) in OPTIMIZERS.items():
        conditions, digits = [], []
        for title, courses in results["quadratics"].items():
            conditions.append(float(title.split()[-1]))
            digits.append(min(-math.log10(max(courses[key][-1][2], 1e-40)), 30))
        left.plot(conditions, digits, color=colour, lw=2.5, marker="o", label=name)
        course = np.array(results["problems"]["Rosenbrock"][key])
        right.plot(course[:, 0], course[:, 2].clip(1e-16), color=colour, lw=2.5, label=name)
    left.set(xscale="log", ylim=(0, 31))
    left.set_title("Quadratics", fontsize=TEXT + 1)
    left.set_xlabel("condition", fontsize=TEXT)
    left.set_ylabel("digits reached", fontsize=TEXT)
    right.set(xscale="log", yscale="log", ylim=(1e-16, 10))
    right.set_title("Rosenbrock's valley", fontsize=TEXT + 1)
    right.set_xlabel("iterations", fontsize=TEXT)
    right.set_ylabel("error / error at the start", fontsize=TEXT)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=TEXT
    )
    figure.savefig(path)


def collapse(path: Path) -> None:
    """Training PSNR over 30,000 iterations where the paper's preset falls furthest."""
    from studies.scenes.records import FOLDER, read

    found = {
        (record.setting.scene, record.arm, record.seed): record.curve
        for record in read(FOLDER)
        if record.setting.rotated
        and record.setting.size == "images_4"
        and record.setting.iterations == ITERATIONS
        and record.setting.sh_degree == record.setting.tiled == record.setting.views == 0
    }
    figure, axes = axes_of(7.4, 3.9, len(FALLS))
    for axis, (scene, seed) in zip(axes, FALLS, strict=True):
        lows = []
        for arm, (name, colour) in COLLAPSE.items():
            curve = found[scene, arm, seed]
            late = curve["iteration"] >= ITERATIONS / 10
            axis.plot(
                curve["iteration"] / 1000, curve["train_psnr"], color=colour, lw=2.5, label=name
            )
            lows.append(float(curve["train_psnr"][late].min()))
        top = max(line.get_ydata().max() for line in axis.lines)
        axis.set_ylim(min(lows) - 0.5, top + 0.5)
        axis.set_title(f"{scene}, seed {seed}", fontsize=TEXT + 1)
        axis.set_xlabel("thousand iterations", fontsize=TEXT)
    axes[0].set_ylabel("PSNR of training views (dB)", fontsize=TEXT)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper center", ncols=3, frameon=False, fontsize=TEXT
    )
    figure.savefig(path)


MADE: dict[str, Callable[[Path], None]] = {
    "performance.png": performance,
    "stability.png": stability,
    "collapse.png": collapse,
}


ROWS = (  # of the benchmark, on the page
    *("six Adams", "defaults", "defaults, a tenth in view", "defaults, last thirtieth"),
    "defaults and OwnFrame",
    *("defaults, steps of a tenth", "the paper's exploration", "the paper's exploitation"),
)


def step_costs() -> str:
    """What whole steps cost, of every docs/benchmarks/step_*.json, and whether that is the goal."""
    text = []
    for path in sorted(BENCHMARK.parent.glob("step_*.json")):
        bench = json.loads(path.read_text(encoding="utf-8"))
        rows = []
        for step in ROWS:
            found = [result[step] for result in bench["results"].values()]
            rows.append((step, *(f"{r['ns_per_point']:.0f} (x{r['per_adam']:.2f})" for r in found)))
        heads = ("ns per point", *(f"{int(n):,} points" for n in bench["results"]))
        text += [f"{bench['device']}, torch {bench['torch']}, {bench['date']}:", ""]
        text += [table(heads, "lr", rows), "", goal_table(bench), ""]
        text += [f"Made by `{bench['command']}`.", ""]
    return "\n".join(text).rstrip()


def goal_table(bench: dict[str, Any]) -> str:
    """What a step of the defaults costs of what it may cost, by the number of points."""
    goals = bench["goals"]
    found = {n: bench["results"][n]["defaults"]["per_adam"] for n in goals}
    rows = [
        ("goal", *(f"{goal:.2f}" for goal in goals.values())),
        ("measured", *(f"{ratio:.2f}" for ratio in found.values())),
        ("", *("reached" if found[n] <= goal else "missed" for n, goal in goals.items())),
    ]
    return table(("the defaults, times six Adams", *(f"{int(n):,}" for n in found)), "lr", rows)


PROBLEMS = {
    "Adam": "Adam",
    "LQNAdam": "LQNAdam",
    "two-loop + line search": "the recursion with a line search",
    "LBFGS (torch)": "`torch.optim.LBFGS`",
}


def digits_table() -> str:
    """Digits reached on the test functions."""
    results = json.loads(STABILITY.read_text(encoding="utf-8"))
    rows = []
    for kind in ("problems", "quadratics"):
        for name, courses in results[kind].items():
            digits = (-math.log10(max(courses[arm][-1][2], 1e-40)) for arm in PROBLEMS)
            cells = ("over 30" if d > 30 else f"{abs(d):.1f}" for d in digits)
            rows.append((name if kind == "problems" else f"quadratic, {name}", *cells))
    about = results["about"]
    return (
        f"{table(('problem', *PROBLEMS.values()), 'lr', rows)}\n\n"
        f"Digits: -log10 of what is left of the error after {about['steps']:,} steps\n"
        f"(line searches: up to 150), median of {about['rows']} rows.\n"
        f"{about['machine']}, {about['date']}."
    )


MARK = "<!-- figures:{} -->"
TABLES: dict[str, Callable[[], str]] = {"step-costs": step_costs, "digits": digits_table}
PAGES = (DOCS / "performance.md", DOCS / "stability.md")


def tabled(page: str) -> str:
    """A page with its tables."""
    return filled(page, {name: make() for name, make in TABLES.items()}, MARK, every=False)


@command("figures")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(MADE)}; none: all")
    parser.add_argument("--out", type=Path, default=FIGURES, metavar="DIR")
    args = parser.parse_args(arguments)
    unknown = sorted(set(args.names) - set(MADE))
    if unknown:
        raise ValueError(f"{', '.join(unknown)}: unknown; there are {', '.join(MADE)}")
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.names or MADE:
        MADE[name](args.out / name)
        print(args.out / name)
    # Not where the figures go elsewhere: whoever looks at them there changes no page.
    for page in PAGES if args.out == FIGURES else ():
        page.write_text(tabled(page.read_text(encoding="utf-8")), encoding="utf-8")
        print(page)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
