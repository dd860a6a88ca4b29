"""Make the tables and the picture of docs/evidence.md anew: python examples/benchmarks/report.py

So it does with the tables of README and of docs/performance.md. All comes from
docs/results/evidence.jsonl, and the cost of a step from steps.json and gpu.json beside it. In a
page a table stands between `<!-- evidence:NAME -->` and `<!-- end -->`, where NAME is a function of
`TABLES`.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import evidence, steps
from benchmarks.evidence import RELOCATION, SPLIT, Line

ROOT = Path(__file__).resolve().parents[2]
PAGES = tuple(ROOT / each for each in ("README.md", "docs/evidence.md", "docs/performance.md"))
GPU = evidence.FILE.with_name("gpu.json")
PICTURE = evidence.FILE.with_name("iterations.png")
MAIN = ("bonsai", "lego", "plush")
FEW = ("banana", "brighton_beach", "lund_door")
HALF: dict[str, Any] = {"size": "images_2", "points": 50_000, "sh_degree": 0}
WHOLE: dict[str, Any] = {"size": "images", "points": 200_000, "sh_degree": 3}
QUARTER: dict[str, Any] = {"size": "images_4", "sh_degree": 0}
# With clone and split, where a threshold of 1 would give 270,000 Gaussians and more.
THRESHOLDS = {("bonsai", "images"): 2.4, ("train", "images_2"): 2.0}
METRICS = ("psnr", "ssim", "lpips")
COUNTS = ("10000", "100000", "1000000", "5000000")  # of Gaussians, as steps.json has them
NAMES = {
    "stock": "stock",
    "defaults": "the defaults",
    "harmonics": "with `Harmonics`",
    "x2": "rates times 2",
    "x3": "rates times 3",
    "averaged": "stock, averaged",
    "learn2splat": "Learn2Splat's tuned Adam",
}
PHOTOS = (
    ("bonsai", "220 photos, 800x532", WHOLE),
    ("lego", "87 photos, 800x800", WHOLE),
    ("train", "263 photos, 979x543", WHOLE),
    ("bonsai", "220 photos, 400x266", HALF),
    ("lego", "87 photos, 400x400", HALF),
    ("plush", "84 photos, 320x240", HALF),
    ("train", "263 photos, 489x271", HALF),
)
Run = tuple[str, int]  # an arm, and the iterations that it is planned for
lines = cache(evidence.read)


def of(run: Run, scene: str, **those: Any) -> list[Line]:
    """The lines of a run; what is not said is as usual. One a seed, in order."""
    wanted = evidence.USUAL | {"density": RELOCATION} | those
    wanted |= {"arm": run[0], "iterations": run[1], "scene": scene}
    found = [x for x in lines() if all(x.get(k) == v for k, v in wanted.items())]
    return sorted(found, key=lambda x: x["seed"])


def paired(*runs: list[Line]) -> list[list[Line]]:
    """Those of the seeds that all have."""
    common = set.intersection(*({x["seed"] for x in each} for each in runs))
    return [[x for x in each if x["seed"] in common] for each in runs]


def mean(found: Sequence[Line]) -> dict[str, float]:
    """PSNR, SSIM and LPIPS over the seeds, as far as they were measured."""
    return {m: fmean(x[m] for x in found) for m in METRICS if found[0][m] is not None}


def gain(ours: list[Line], control: list[Line]) -> dict[str, float]:
    """Mean difference over the seeds that both have; empty where there is none."""
    ours, control = paired(ours, control)
    return {m: mean(ours)[m] - mean(control)[m] for m in mean(ours)} if ours else {}


def numbers(values: Mapping[str, float], sign: str = "", digits: int = 4) -> str:
    """PSNR / SSIM / LPIPS; zero has no sign."""
    said = (f"{v:{sign}.{2 if m == 'psnr' else digits}f}" for m, v in values.items())
    return " / ".join(each if float(each) else each.lstrip("+-") for each in said)


def seeds(found: Sequence[Any]) -> str:
    """How many they are."""
    return f"({len(found)} seed{'s' * (len(found) > 1)})"


def shown(found: Sequence[Line]) -> str:
    """PSNR / SSIM / LPIPS and the number of seeds."""
    return f"{numbers(mean(found))} {seeds(found)}" if found else "not trained"


def gained(ours: list[Line], control: list[Line]) -> str:
    """The gain, from three seeds on with the standard error of PSNR's, and over how many seeds."""
    pairs = list(zip(*paired(ours, control), strict=True))
    if not pairs:
        return "not trained"
    said = numbers(gain(ours, control), "+")
    if len(pairs) > 2:
        error = stdev(a["psnr"] - b["psnr"] for a, b in pairs) / len(pairs) ** 0.5
        said = said.replace(" /", f" ± {error:.2f} /", 1)
    return f"{said} {seeds(pairs)}"


def beside(stock: Run, others: Iterable[Run], scene: str, **those: Any) -> list[str]:
    """Stock's result, and what others gain over it with as many Gaussians."""
    control = of(stock, scene, **those)
    those["points"] = control[0]["points"]
    return [shown(control), *(gained(of(run, scene, **those), control) for run in others)]


def name(run: Run) -> str:
    """An arm, and for how many iterations."""
    return f"{NAMES[run[0]]}, {run[1]:,}"


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, ["---"] * len(heads), *rows))


def read(path: Path) -> dict[str, Any]:
    """What steps were measured to cost."""
    return json.loads(path.read_text(encoding="utf-8"))


# -- the tables -----------------------------------------------------------------------------------

STOCK, SHORT, THIRD = ("stock", 30_000), ("stock", 10_000), ("defaults", 10_000)
MANY = ("harmonics", 10_000)  # for many photos, where colours have more than degree 0
OTHERS = (
    THIRD,
    ("defaults", 7_500),
    SHORT,
    *((arm, 10_000) for arm in ("x2", "x3", "averaged", "learn2splat")),
    *((arm, 30_000) for arm in ("x2", "averaged")),
)


def third(
    scene: str, density: str, those: Mapping[str, Any], ours: Run = THIRD
) -> list[list[Line]]:
    """Stock and a third of its iterations with the package, of the same seeds."""
    return paired(*(of(run, scene, density=density, **those) for run in (STOCK, ours)))


def with_split(scene: str, those: Mapping[str, Any]) -> dict[str, Any]:
    """The same with clone and split, which begins with the scene's points, at most 50,000."""
    return {**those, "points": 50_000, "threshold": THRESHOLDS.get((scene, those["size"]), 1.0)}


def front() -> str:
    """A third of stock's iterations against all of them."""
    ours, rows = "ours, 10,000", []
    for scene, photos, those in PHOTOS:
        relocated = third(scene, RELOCATION, those, MANY if those is WHOLE else THIRD)
        found = relocated + third(scene, SPLIT, with_split(scene, those))
        cells = (numbers(mean(each), digits=3) if each else "-" for each in found)
        rows.append((f"{scene}, {photos}", *cells))
    heads = ("photos", "relocation: stock, 30,000", ours, "clone and split: stock, 30,000", ours)
    return table(heads, rows)


def iterations() -> str:
    """A third of the iterations, and controls, less stock's 30,000 iterations, seed by seed."""
    columns = [beside(STOCK, OTHERS, scene, **HALF) for scene in MAIN]
    return table(("training", *MAIN), zip(map(name, (STOCK, *OTHERS)), *columns, strict=True))


def less_stock(scenes: Iterable[str], runs: Sequence[Run], **those: Any) -> str:
    """Stock's 30,000 iterations, and what other trainings of a size gain over them."""
    rows = [(scene, *beside(STOCK, runs, scene, **those)) for scene in scenes]
    return table(("scene", name(STOCK), *(f"{name(run)}, less that" for run in runs)), rows)


def whole() -> str:
    """A third and a half of stock's iterations against all of them, at whole size."""
    runs = [THIRD, MANY, ("defaults", 15_000)]
    return less_stock(["bonsai", "lego", "train"], runs, **WHOLE)


def outdoors() -> str:
    """A third of stock's iterations against all of them, outdoors, at half size."""
    return less_stock(["train"], [THIRD], **HALF)


def quarter() -> str:
    """A quarter of stock's iterations against all of them, at quarter size."""
    return less_stock(MAIN, [("defaults", 7_500)], **QUARTER)


def equal() -> str:
    """Both planned for as many iterations."""
    rows = []
    sizes = (("half", HALF, 10_000), ("half", HALF, 30_000), ("quarter", QUARTER, 30_000))
    for size, those, count in sizes:
        runs = [(arm, count) for arm in ("defaults", "x2")]
        rows += [
            (size, f"{count:,}", scene, *beside(("stock", count), runs, scene, **those))
            for scene in MAIN
        ]
    return table(("size", "iterations", "scene", "stock", "the defaults", NAMES["x2"]), rows)


def open_end() -> str:
    """One training without a planned end, ended at several lengths, less those planned for them."""
    rows = []
    for scene in MAIN:
        for count in (5_000, 7_500, 10_000, 15_000, 30_000):
            ours = of(("open-end", count), scene, **QUARTER)
            those = QUARTER | {"points": ours[0]["points"]}
            planned, ours = paired(of(("defaults", count), scene, **those), ours)
            rows.append((scene, f"{count:,}", shown(planned), gained(ours, planned)))
    heads = ("scene", "iterations", "planned", "without a planned end, less that")
    return table(heads, rows)


def few() -> str:
    """Scenes with 10 to 15 photos; all beside stock at 30,000."""
    runs = (("stock", 3_000), ("defaults", 3_000), ("defaults", 30_000))
    return less_stock(FEW, runs, **QUARTER)


def adaptive() -> str:
    """Clone, split, prune and reset: held out, on the photos trained on, and Gaussians."""
    rows = []
    half = [(scene, scene, HALF) for scene in (*MAIN, "train")]
    for title, scene, size in (*half, ("bonsai, whole size", "bonsai", WHOLE)):
        those = with_split(scene, size)
        stock, ours = third(scene, SPLIT, those)
        short = of(SHORT, scene, density=SPLIT, **those)
        found = [(name(STOCK), stock), (name(SHORT), short), (name(THIRD), ours)]
        for threshold in sorted({x["threshold"] for x in lines()} - {those["threshold"]}):
            other = of(THIRD, scene, density=SPLIT, **those | {"threshold": threshold})
            factor = threshold / those["threshold"]
            found.append((f"the same, threshold times {factor:.3g}", other))
        for label, each in found:
            if each:
                trained = f"{fmean(x['train_psnr'] for x in each):.2f}"
                count = f"{fmean(x['gaussians'] for x in each):,.0f}"
                rows.append((title * (each is stock), label, shown(each), trained, count))
    heads = ("scene", "training", "PSNR / SSIM / LPIPS", "training PSNR", "Gaussians")
    return table(heads, rows)


def gpu_step() -> str:
    """What a step costs on a GPU."""
    return steps.table(read(GPU)["steps"]["results"])


def gpu_iteration() -> str:
    """What a whole iteration of gsplat's training costs on a GPU."""
    found = read(GPU)["iterations"]["results"]
    rows = []
    for subject in found["1000000"]:
        cells = []
        for results in found.values():
            row = results[subject]
            spread = "" if subject == "stock" else f" ({row['low']:.2f} to {row['high']:.2f})"
            cells.append(f"{row['ms']:.1f} ms, x{row['ratio']:.2f}{spread}")
        rows.append((subject, *cells))
    return table(("", *(f"{int(n):,} Gaussians" for n in found)), rows)


def ratios() -> str:
    """What a step of the defaults costs, in short."""
    rows = []
    on_gpu, on_cpu = read(GPU)["steps"]["results"], read(steps.OUT)["results"]
    for device, found, other, subject in (
        ("one H200", on_gpu, "six fused Adams", "defaults"),
        ("", on_gpu, "the same, last thirtieth", "defaults, last thirtieth"),
        ("a CPU, one thread", on_cpu, "six Adams", "defaults"),
        ("", on_cpu, "the same, last thirtieth", "defaults, last thirtieth"),
        ("", on_cpu, "six fused Adams", "defaults, fused"),
    ):
        cells = (f"{found[n][subject]['ratio']:.2f}" if n in found else "-" for n in COUNTS)
        rows.append((device, other, *cells))
    return table(("", "beside", *(f"{int(n):,}" for n in COUNTS)), rows)


def cost() -> str:
    """What a step costs on a CPU."""
    made = read(steps.OUT)
    about = f"{made['machine']}, {made['date']}, medians of {made['rounds']} rounds."
    return f"{steps.table(made['results'])}\n\n{about}"


TABLES = {f.__name__: f for f in (
    front, iterations, quarter, equal, open_end, few, adaptive, whole, outdoors, gpu_step,
    gpu_iteration, ratios, cost,
)}  # fmt: skip

# -- the picture, and the pages -------------------------------------------------------------------

DRAWN = {
    STOCK: "#555555",
    SHORT: "#e69f00",
    THIRD: "#0072b2",
    ("defaults", 30_000): "#56b4e9",
}


def draw(path: Path) -> None:
    """Quality over iterations at half size, with the end of stock's training as a line.

    The curves of a scene are means over the seeds that all of them have.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.7), dpi=130, layout="constrained")
    axes = figure.subplots(1, len(MAIN))
    for axis, scene in zip(axes, MAIN, strict=True):
        found = paired(*(of(run, scene, **HALF) for run in DRAWN))
        for (run, colour), each in zip(DRAWN.items(), found, strict=True):
            curves = [
                dict(zip(x["curve"]["iteration"], x["curve"]["psnr"], strict=True)) for x in each
            ]
            # Some were evaluated twice as often as others.
            at = sorted(set.intersection(*map(set, curves)))
            curve = [fmean(one[n] for one in curves) for n in at]
            axis.plot([n / 1000 for n in at], curve, color=colour, lw=2, label=name(run))
            axis.plot(at[-1] / 1000, curve[-1], "o", color=colour, ms=6)
            if run == STOCK:
                axis.axhline(curve[-1], color=colour, lw=1, ls="--", zorder=0)
                axis.set_ylim(curve[-1] - 5, curve[-1] + 1.6)
        axis.set_title(f"{scene} {seeds(found[0])}", fontsize=13)
        axis.set_xlabel("thousand iterations", fontsize=12)
        axis.set_xlim(0, 31)
        axis.grid(color="#e4e4e4", lw=0.8)
    axes[0].set_ylabel("PSNR of held-out photos, dB", fontsize=12)
    entries, place = axes[0].get_legend_handles_labels(), "outside lower center"
    figure.legend(*entries, loc=place, ncols=4, frameon=False, fontsize=11)
    figure.savefig(path)


def filled(page: str) -> str:
    """The page with its tables made anew; ValueError where it names one that there is not."""

    def made(found: re.Match[str]) -> str:
        if found[1] not in TABLES:
            raise ValueError(f"evidence:{found[1]}, but there are {', '.join(TABLES)}")
        return f"<!-- evidence:{found[1]} -->\n{TABLES[found[1]]()}\n<!-- end -->"

    return re.sub(r"<!-- evidence:(\w+) -->.*?<!-- end -->", made, page, flags=re.DOTALL)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args(arguments)
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8")), encoding="utf-8")
    draw(PICTURE)
    print(*PAGES, PICTURE, sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
