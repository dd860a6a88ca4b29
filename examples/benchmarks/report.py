"""Make the tables and the picture of docs/evidence.md anew: python examples/benchmarks/report.py

So it does with the tables of README and of docs/trials.md. All comes from
docs/results/evidence.jsonl, and the cost of a step, which docs/performance.md has, from steps.json
and gpu.json beside it. In a page a table stands between `<!-- evidence:NAME -->` and
`<!-- end -->`, where NAME is a function of `TABLES`.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks import evidence, steps

ROOT = Path(__file__).resolve().parents[2]
PAGES = tuple(
    ROOT / page
    for page in ("README.md", "docs/evidence.md", "docs/trials.md", "docs/performance.md")
)
GPU = evidence.FILE.with_name("gpu.json")
PICTURE = evidence.FILE.with_name("iterations.png")
MAIN = ("bonsai", "lego", "plush")
FEW = ("banana", "brighton_beach", "lund_door")
HALF: dict[str, Any] = {"size": "images_2", "points": 50_000, "sh_degree": 0}
WHOLE: dict[str, Any] = {"size": "images", "points": 200_000, "sh_degree": 3}
QUARTER: dict[str, Any] = {"size": "images_4", "sh_degree": 0}
SIZES = {"half": HALF, "quarter": QUARTER}
METRICS = ("psnr", "ssim", "lpips")
COUNTS = ("10000", "100000", "1000000", "5000000")  # of Gaussians, as steps.json has them
FORMS = {"psnr": "{:.2f}", "ssim": "{:.4f}", "lpips": "{:.4f}"}
GAINS = {"psnr": "{:+.2f}", "ssim": "{:+.4f}", "lpips": "{:+.4f}"}
Line = dict[str, Any]


class Evidence:
    """All lines, to choose from."""

    def __init__(self, path: Path = evidence.FILE) -> None:
        self.lines = evidence.read(path)

    def of(self, arm: str, scene: str, *, gpu: bool = False, **those: Any) -> list[Line]:
        """The lines of an arm; what is not said is as usual. One a seed, in order."""
        wanted = evidence.USUAL | {"density": "relocation"} | those | {"arm": arm, "scene": scene}
        found = [x for x in self.lines if all(x.get(k) == v for k, v in wanted.items())]
        found = [x for x in found if ("NVIDIA" in x["device"]) is gpu]
        return sorted(found, key=lambda x: str(x["seed"]))


def seeds_of(lines: Iterable[Line]) -> list[int]:
    """All seeds of the lines."""
    return sorted(
        s for x in lines for s in (x["seed"] if isinstance(x["seed"], list) else [x["seed"]])
    )


def mean(lines: Sequence[Line], metric: str) -> float:
    """Over the seeds."""
    weights = [len(seeds_of([x])) for x in lines]
    return sum(w * x[metric] for w, x in zip(weights, lines, strict=True)) / sum(weights)


def shown(lines: Sequence[Line]) -> str:
    """PSNR / SSIM / LPIPS and the number of seeds."""
    if not lines:
        return "not trained"
    values = (FORMS[m].format(mean(lines, m)) for m in METRICS if lines[0][m] is not None)
    count = len(seeds_of(lines))
    return f"{' / '.join(values)} ({count} seed{'s' * (count > 1)})"


def one_seed(cell: str) -> str:
    """A cell of a table whose text says that all have one seed."""
    return cell.removesuffix(" (1 seed)")


def gain(lines: Sequence[Line], control: Sequence[Line]) -> dict[str, float] | None:
    """Mean difference over the seeds that both have; None where there is none."""
    common = set(seeds_of(lines)) & set(seeds_of(control))
    if not common or any(isinstance(x["seed"], list) for x in (*lines, *control)):
        same = lines and control and seeds_of(lines) == seeds_of(control)
        return {m: mean(lines, m) - mean(control, m) for m in METRICS} if same else None
    ours, theirs = ([x for x in each if x["seed"] in common] for each in (lines, control))
    return {m: mean(ours, m) - mean(theirs, m) for m in METRICS if ours[0][m] is not None}


def gained(lines: Sequence[Line], control: Sequence[Line]) -> str:
    """The gain, and over how many seeds."""
    found = gain(lines, control)
    if found is None:
        return "not trained" if not lines else "-"
    count = len(set(seeds_of(lines)) & set(seeds_of(control)))
    return f"{all_signed(found)} ({count} seed{'s' * (count > 1)})"


def all_signed(found: Mapping[str, float]) -> str:
    """Differences of all metrics."""
    return " / ".join(signed(value, metric) for metric, value in found.items())


def signed(value: float, metric: str) -> str:
    """With its sign, but for zero."""
    form = GAINS[metric].format(value)
    return form if float(form) else form[1:]


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


# -- the tables -----------------------------------------------------------------------------------


DENSITIES = ("relocation", "clone-and-split")
PHOTOS = {
    "bonsai": "220 of 400x266",
    "lego": "87 of 400x400",
    "plush": "84 of 320x240",
    "train": "263 of 489x271",
}


def front(all_: Evidence) -> str:
    """A third of stock's iterations against all of them, of the same seeds."""
    forms, rows = {"psnr": "{:.2f}", "ssim": "{:.3f}", "lpips": "{:.3f}"}, []
    for scene, photos in PHOTOS.items():
        pairs = [third(all_, scene, density) for density in DENSITIES]
        cells = [
            " / ".join(form.format(mean(x, m)) for m, form in forms.items()) if x else "-"
            for pair in pairs
            for x in pair
        ]
        if any(ours for _, ours in pairs):
            rows.append((f"{scene}, {photos}", *cells))
    heads = [
        h for d in DENSITIES for h in (f"{d.replace('-', ' ')}: stock, 30,000", "ours, 10,000")
    ]
    return table(("photos", *heads), rows)


def third(all_: Evidence, scene: str, density: str) -> tuple[list[Line], list[Line]]:
    """Stock's 30,000 iterations and a third of them with the package, of the same seeds."""
    those = {"density": density, **HALF}
    stock = all_.of("stock", scene, iterations=30_000, **those)
    ours = all_.of("defaults", scene, iterations=10_000, **those)
    both = set(seeds_of(stock)) & set(seeds_of(ours))
    return [x for x in stock if x["seed"] in both], [x for x in ours if x["seed"] in both]


SHORTER = (
    *(("defaults", count) for count in (15_000, 10_000, 7_500)),
    *((arm, 10_000) for arm in ("stock", "x2", "x3", "averaged", "learn2splat")),
)


def iterations(all_: Evidence) -> str:
    """Shorter trainings less stock's 30,000 iterations, seed by seed."""
    stock = {scene: all_.of("stock", scene, iterations=30_000, **HALF) for scene in MAIN}
    rows = [("stock, 30,000", *map(shown, stock.values()))]
    for arm, count in SHORTER:
        cells = (
            gained(all_.of(arm, scene, iterations=count, **HALF), lines)
            for scene, lines in stock.items()
        )
        rows.append((f"{NAMES[arm]}, {count:,}", *cells))
    return table(("training", *MAIN), rows)


def quarter(all_: Evidence) -> str:
    """A quarter of stock's iterations against all of them, at quarter size."""
    rows = []
    for scene in MAIN:
        stock = all_.of("stock", scene, iterations=30_000, **QUARTER)
        points = stock[0]["points"]
        ours = all_.of("defaults", scene, iterations=7_500, points=points, **QUARTER)
        rows.append((scene, f"{points:,}", shown(stock), gained(ours, stock)))
    return table(("scene", "Gaussians", "stock, 30,000", "the defaults, 7,500, less stock"), rows)


def gpu(all_: Evidence) -> str:
    """Half of the iterations at whole size, on a GPU."""
    rows = []
    for scene in ("bonsai", "lego"):
        stock = all_.of("stock", scene, gpu=True, iterations=15_000, **WHOLE)
        ours = all_.of("0.1.0", scene, gpu=True, iterations=7_500, **WHOLE)
        for lines in (stock, ours):
            name = f"{NAMES[lines[0]['arm']]}, {lines[0]['iterations']:,}"
            first, less = (scene, "") if lines is stock else ("", one_seed(gained(lines, stock)))
            took = f"{mean(lines, 'seconds'):.0f} s"
            rows.append((first, name, one_seed(shown(lines)), less, took))
    return table(("scene", "training", "PSNR / SSIM / LPIPS", "less stock", "took"), rows)


def whole(all_: Evidence) -> str:
    """Half of the iterations at whole size, on a CPU, less stock's trainings on the GPU."""
    rows = []
    for scene in ("bonsai", "lego"):
        stock = all_.of("stock", scene, gpu=True, iterations=15_000, **WHOLE)
        ours = all_.of("defaults", scene, iterations=7_500, **WHOLE)
        rows.append((scene, one_seed(shown(ours)), one_seed(gained(ours, stock))))
    return table(("scene", "the defaults, 7,500, on a CPU", "less stock, 15,000, on the GPU"), rows)


def gpu_step(_: Evidence) -> str:
    """What a step costs on a GPU."""
    return steps.table(json.loads(GPU.read_text(encoding="utf-8"))["steps"]["results"])


def gpu_iteration(_: Evidence) -> str:
    """What a whole iteration of gsplat's training costs on a GPU."""
    made = json.loads(GPU.read_text(encoding="utf-8"))
    found, before = made["iterations"]["results"], made["before"]["iterations"]
    names = {  # of the step before: its defaults had no own frame
        "defaults": "the same with OwnFrame",
        "defaults, last thirtieth": "the same in the last thirtieth",
    }
    rows = []
    for name in found["1000000"]:
        cells = []
        for points, results in found.items():
            row = results[name]
            spread = "" if name == "stock" else f" ({row['low']:.2f} to {row['high']:.2f})"
            cells.append(f"{row['ms']:.1f} ms, x{row['ratio']:.2f}{spread}")
            old = before[points].get(names.get(name, ""))
            cells.append("" if old is None else f"x{old:.2f}")
        rows.append((name, *cells))
    heads = [h for n in found for h in (f"{int(n):,} Gaussians", "the step before")]
    return table(("", *heads), rows)


def equal(all_: Evidence) -> str:
    """All of 30,000 iterations."""
    rows, arms = [], ("defaults", "0.1.0", "x2")
    for size in ("half", "quarter"):
        for scene in MAIN:
            stock = all_.of("stock", scene, iterations=30_000, **SIZES[size])
            those = {"iterations": 30_000, **SIZES[size], "points": stock[0]["points"]}
            lines = (all_.of(arm, scene, **those) for arm in arms)
            rows.append((scene, size, shown(stock), *(gained(x, stock) for x in lines)))
    heads = ("scene", "size", "stock", *(NAMES[arm] for arm in arms))
    return table(heads, rows)


def short(all_: Evidence) -> str:
    """Both with schedules as short."""
    rows = []
    for count in (15_000, 10_000, 7_500):
        gains = []
        for scene in MAIN:
            stock, ours = (
                all_.of(arm, scene, iterations=count, **HALF) for arm in ("stock", "defaults")
            )
            found = gain(ours, stock)
            gains.append(found)
            less = "not trained" if found is None else all_signed(found)
            rows.append((f"{count:,}", scene, one_seed(shown(stock)), less))
        rows.append((f"{count:,}", "*mean*", "", mean_gain(gains)))
    return table(("iterations", "scene", "stock", "the defaults gain"), rows)


def mean_gain(gains: Sequence[dict[str, float] | None]) -> str:
    """Over the scenes; empty where one was not trained."""
    found = [each for each in gains if each is not None]
    if len(found) < len(gains):
        return ""
    return all_signed({m: statistics.mean(each[m] for each in found) for m in METRICS})


def ratios(_: Evidence) -> str:
    """What a step of the defaults costs, in short."""
    gpu_made, cpu_made = (json.loads(p.read_text(encoding="utf-8")) for p in (GPU, steps.OUT))
    rows = []
    for device, made, beside, name in (
        ("one H200", gpu_made["steps"], "six fused Adams", "defaults"),
        ("", gpu_made["steps"], "the same, last thirtieth", "defaults, last thirtieth"),
        ("a CPU, one thread", cpu_made, "six Adams", "defaults"),
        ("", cpu_made, "the same, last thirtieth", "defaults, last thirtieth"),
        ("", cpu_made, "six fused Adams", "defaults, fused"),
    ):
        found = made["results"]
        cells = (f"{found[n][name]['ratio']:.2f}" if n in found else "-" for n in COUNTS)
        rows.append((device, beside, *cells))
    return table(("", "beside", *(f"{int(n):,}" for n in COUNTS)), rows)


def cost(_: Evidence) -> str:
    """What a step costs on a CPU."""
    made = json.loads(steps.OUT.read_text(encoding="utf-8"))
    about = f"{made['machine']}, {made['date']}, medians of {made['rounds']} rounds."
    return f"{steps.table(made['results'])}\n\n{about}"


def few(all_: Evidence) -> str:
    """Scenes with 10 to 15 photos; all beside stock at 30,000."""
    rows = []
    others = (("stock", 3_000), ("defaults", 3_000), ("0.1.0", 10_000), ("0.1.0", 30_000))
    for scene in FEW:
        stock = all_.of("stock", scene, iterations=30_000, **QUARTER)
        lines = (all_.of(arm, scene, iterations=n, **QUARTER) for arm, n in others)
        rows.append((scene, shown(stock), *(gained(x, stock) for x in lines)))
    return table(("scene", "stock, 30,000", *(f"{NAMES[a]}, {n:,}" for a, n in others)), rows)


def adaptive(all_: Evidence) -> str:
    """Clone, split, prune and reset: held out, on the photos trained on, and Gaussians."""
    rows = []
    for scene in PHOTOS:
        pair = third(all_, scene, "clone-and-split")
        for name, lines in zip(("stock, 30,000", "the defaults, 10,000"), pair, strict=True):
            if lines:
                first = scene if lines is pair[0] else ""
                trained = f"{mean(lines, 'train_psnr'):.2f}"
                rows.append((first, name, shown(lines), trained, of_gaussians(lines)))
    heads = ("scene", "training", "PSNR / SSIM / LPIPS", "PSNR trained on", "Gaussians")
    return table(heads, rows)


def of_gaussians(lines: Sequence[Line]) -> str:
    """Their number at the end."""
    return f"{mean(lines, 'gaussians'):,.0f}"


NAMES = {
    "stock": "stock",
    "defaults": "the defaults",
    "0.1.0": "version 0.1.0",
    "x2": "rates times 2",
    "x3": "rates times 3",
    "averaged": "stock, averaged",
    "learn2splat": "Learn2Splat's tuned Adam",
}
TABLES: dict[str, Callable[[Evidence], str]] = {
    f.__name__: f
    for f in (
        front, iterations, quarter, gpu, whole, gpu_step, gpu_iteration, equal, short, ratios, cost,
        few, adaptive,
    )
}  # fmt: skip


DRAWN = (
    ("stock", 30_000, "#555555"),
    ("defaults", 15_000, "#7fc4ea"),
    ("defaults", 10_000, "#0072b2"),
    ("defaults", 7_500, "#08306b"),
)


def draw(all_: Evidence, path: Path) -> None:
    """Quality over iterations at half size, with the end of stock's training as a line.

    The curves of a scene are means over the seeds that all of them have.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.7), dpi=130, layout="constrained")
    axes, entries = figure.subplots(1, len(MAIN)), {}
    for axis, scene in zip(axes, MAIN, strict=True):
        found = {
            (arm, count, colour): {x["seed"]: x["curve"] for x in lines if x.get("curve")}
            for arm, count, colour in DRAWN
            if (lines := all_.of(arm, scene, iterations=count, **HALF))
        }
        seeds = sorted(set.intersection(*map(set, found.values())))
        for (arm, count, colour), curves in found.items():
            # Some were evaluated twice as often as others.
            pairs = [
                dict(zip(c["iteration"], c["psnr"], strict=True))
                for c in map(curves.get, seeds)
                if c
            ]
            at = sorted(set.intersection(*map(set, pairs)))
            curve = [statistics.mean(each[n] for each in pairs) for n in at]
            label = "stock" if arm == "stock" else f"{NAMES[arm]}, planned for {count:,}"
            (entries[label],) = axis.plot([n / 1000 for n in at], curve, color=colour, lw=2)
            axis.plot(at[-1] / 1000, curve[-1], "o", color=colour, ms=6)
            if arm == "stock":
                axis.axhline(end := curve[-1], color=colour, lw=1, ls="--", zorder=0)
                axis.set_ylim(end - 5, end + 1.6)
        count = len(seeds)
        axis.set_title(f"{scene} ({count} seed{'s' * (count > 1)})", fontsize=13)
        axis.set_xlabel("thousand iterations", fontsize=12)
        axis.set_xlim(0, 31)
        axis.grid(color="#e4e4e4", lw=0.8)
    axes[0].set_ylabel("PSNR of held-out photos, dB", fontsize=12)
    order = ["stock", *(f"{NAMES[arm]}, planned for {n:,}" for arm, n, _ in DRAWN[1:])]
    names = [name for name in order if name in entries]
    handles = [entries[name] for name in names]
    place = "outside lower center"
    figure.legend(handles, names, loc=place, ncols=2, frameon=False, fontsize=11)
    figure.savefig(path)


def filled(page: str, all_: Evidence) -> str:
    """The page with its tables made anew; ValueError where it names one that there is not."""

    def made(found: re.Match[str]) -> str:
        if found[1] not in TABLES:
            raise ValueError(f"evidence:{found[1]}, but there are {', '.join(TABLES)}")
        return f"<!-- evidence:{found[1]} -->\n{TABLES[found[1]](all_)}\n<!-- end -->"

    return re.sub(r"<!-- evidence:(\w+) -->.*?<!-- end -->", made, page, flags=re.DOTALL)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args(arguments)
    all_ = Evidence()
    for page in PAGES:
        page.write_text(filled(page.read_text(encoding="utf-8"), all_), encoding="utf-8")
    draw(all_, PICTURE)
    print(*PAGES, PICTURE, sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
