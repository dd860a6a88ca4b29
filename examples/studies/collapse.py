"""Whether a training falls while nu is on: before and after the histogram followed the energy.

    python examples/studies/collapse.py SCENE-FOLDER --arm default --seed 0   (train and record)
    python examples/studies/collapse.py                                       (table and picture)

An arm is stock 3DGS-MCMC with nu and nothing else, a twelfth of the run as warm-up. `default` is
`EnergyHistogram()`; `frozen` what was the default until 2026-11-22: the paper's update, range and
temperature measured once, in the first twenty-fourth of the run; `stock` has no nu. The training
PSNR is looked at 60 times; a fall is how far it is below its best so far.

Writes `docs/results/histogram/collapse.json`, `collapse.md` and `collapse.png`.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np
import torch
from splatting.arms import Arm
from splatting.fit import Fit, FitOptions
from splatting.scenes import load_scene

from opt3dgs_optim import EnergyHistogram, Part
from studies import pages
from studies.scenes.training import BACKGROUNDS

OUT = Path(__file__).resolve().parents[2] / "docs" / "results" / "histogram"
ARMS = ("stock", "frozen", "default")
LABELS = {
    "stock": "stock, no ν",
    "frozen": "before: measured once",
    "default": "after: follows the energy",
}
COLORS = {"stock": "0.6", "frozen": "#d55e00", "default": "#0072b2"}
LOOKS = 60
WARMUP = 1 / 12
EVERY = 4  # iterations between two that the picture shows
SHOWN = ("lund_door", 0, 3_000)  # scene, seed and iterations of the picture


class Frozen(Part):
    """The default of old: range and temperature measured once, then the paper's update."""

    def __init__(self, warmup: int) -> None:
        self.warmup, self.histogram = warmup, EnergyHistogram.paper(warmup=warmup)
        self._first: list[float] = []

    def observe(self, energy: Any, valid: Any, course: Any) -> None:
        """Measure for half of the warm-up, over the last eighth of it."""
        if len(self._first) < self.warmup // 2:
            self._first.append(float(energy))
            if len(self._first) < self.warmup // 2:
                return
            weights = (1 - 8 / (self.warmup // 2)) ** np.arange(len(self._first))[::-1]
            mean = np.average(self._first, weights=weights)
            deviation = np.sqrt(np.average((np.array(self._first) - mean) ** 2, weights=weights))
            self.histogram = EnergyHistogram.paper(
                energy_range=(max(mean - 30 * deviation, 0.0), mean + 4 * deviation),
                temperature=deviation / 6,
                warmup=self.warmup - len(self._first),
            )
            return
        self.histogram.observe(energy)

    def factor(self, group: Any, course: Any) -> Any:
        """Nu."""
        return self.histogram.factor(group, course)


def train(folder: str, arm: str, seed: int, iterations: int, points: int) -> dict[str, Any]:
    """Train; return what is recorded, the curve and the trace included."""
    torch.set_num_threads(1)
    warmup = round(iterations * WARMUP)
    part = {"stock": None, "frozen": Frozen(warmup), "default": EnergyHistogram(warmup=warmup)}[arm]
    made = Arm(arm, parts=lambda *_: [] if part is None else [part])
    name = Path(folder).name
    scene = load_scene(folder, background=BACKGROUNDS.get(name, "black"))
    fit = Fit(scene, made, FitOptions(iterations, points, seed, switch=1.0))
    curve, trace, low, high = [], [], -np.inf, np.inf
    while fit.iteration < iterations:
        loss = fit.step()
        histogram = part.histogram if isinstance(part, Frozen) else part
        if histogram is not None:
            low, high = histogram.clamp or (-np.inf, np.inf)
            trace.append([float(loss), float(histogram.multiplier), *histogram.coordinates[:2]])
        if fit.iteration % (iterations // LOOKS) == 0:
            curve.append(fit.evaluate())
    psnr = np.array([look["train_psnr"] for look in curve])
    fallen = np.maximum.accumulate(psnr) - psnr  # below the best so far
    record: dict[str, Any] = {
        "scene": name,
        "arm": arm,
        "seed": seed,
        "iterations": iterations,
        "largest_fall": round(float(fallen.max()), 3),
        "looks_below_1_db": int((fallen > 1).sum()),
        "psnr": round(curve[-1]["psnr"], 3),
        "train_psnr": round(curve[-1]["train_psnr"], 3),
        "machine": f"{platform.system()} {platform.machine()}, torch {torch.__version__}",
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "curve": [round(value, 3) for value in psnr.tolist()],
    }
    if trace:
        nu = np.array(trace)[warmup:, 1]
        record["nu_mean"] = round(float(nu.mean()), 3)
        record["nu_deviation"] = round(float(nu.std()), 3)
        record["at_clamp"] = round(float(((nu <= low) | (nu >= high)).mean()), 5)
        if (name, seed, iterations) == SHOWN:  # loss, nu, low and high end of the partitions
            shown = [[float(f"{value:.4g}") for value in line] for line in trace[::EVERY]]
            record["trace"] = shown
    return record


def table(records: list[dict[str, Any]]) -> str:
    """Markdown: a row per scene and length, the worst of an arm's seeds in its cell."""
    rows = []
    for scene, length in sorted({(r["scene"], r["iterations"]) for r in records}):
        here = [r for r in records if (r["scene"], r["iterations"]) == (scene, length)]
        by_arm = [[r for r in here if r["arm"] == arm] for arm in ARMS]
        psnr = [next((f"{r['psnr']:.2f}" for r in own if r["seed"] == 0), "-") for own in by_arm]
        rows.append((f"{scene}, {length:,}", *map(_cell, by_arm), " / ".join(psnr)))
    heads = ("scene, iterations", *(LABELS[arm] for arm in ARMS), "test PSNR, seed 0")
    return pages.table(heads, "l", rows) + "\n"


def _cell(records: list[dict[str, Any]]) -> str:
    """The largest fall; looks more than 1 dB below the best; share of nu at the clamp; seeds."""
    if not records:
        return "-"
    fall, looks = (max(r[name] for r in records) for name in ("largest_fall", "looks_below_1_db"))
    said = f"{fall:.2f} dB, {looks} of {LOOKS}"
    if all("at_clamp" in r for r in records):
        said += f", {max(r['at_clamp'] for r in records):.1%}"
    return said + (f" ({len(records)} seeds)" if len(records) > 1 else "")


def draw(records: list[dict[str, Any]], path: Path) -> None:
    """Training PSNR, and energy, range and nu of one training before and after."""
    one = {r["arm"]: r for r in records if (r["scene"], r["seed"], r["iterations"]) == SHOWN}
    fig, axes = plt.subplots(3, 2, figsize=(10, 7), sharex=True, layout="constrained")
    for column, arm in enumerate(("frozen", "default")):
        top, middle, bottom = axes[:, column]
        record = one[arm]
        looks = np.arange(1, LOOKS + 1) * record["iterations"] / LOOKS
        if "stock" in one:
            top.plot(looks, one["stock"]["curve"], color=COLORS["stock"], label=LABELS["stock"])
        top.plot(looks, record["curve"], color=COLORS[arm], label=LABELS[arm])
        top.set(title=LABELS[arm], ylim=(15, 36))
        top.legend(loc="lower right", frameon=False)
        loss, nu, low, high = np.array(record["trace"]).T
        k = np.arange(len(loss)) * EVERY
        started = k >= record["iterations"] * WARMUP / 2
        middle.fill_between(k[started], low[started], high[started], color=COLORS[arm], alpha=0.15,
                            lw=0, label="range of the partitions")  # fmt: skip
        middle.plot(k, loss, ".", ms=1.5, color=COLORS[arm], label="energy")
        middle.set(ylim=(0, 0.2))
        middle.legend(loc="upper right", frameon=False)
        bottom.plot(k, nu, ".", ms=1.5, color=COLORS[arm])
        bottom.axhline(1, color="0.6", lw=0.8)
        bottom.set(ylim=(-5.5, 5.5))
    axes[0, 0].set_ylabel("training PSNR, dB")
    axes[1, 0].set_ylabel("energy")
    axes[2, 0].set_ylabel("ν")
    fig.supxlabel("iteration", fontsize=10)
    where = f"lund_door, seed 0; {one['default']['machine']}, {one['default']['date']}"
    fig.text(1.005, 0.5, where, rotation=90, va="center", fontsize=6, color="0.5")
    fig.savefig(path, dpi=130, bbox_inches="tight")


def main() -> None:
    """Train and record, or write table and picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", nargs="?", help="folder, or 'embedded'; none: table only")
    parser.add_argument("--arm", choices=ARMS, default="default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--iterations", type=int, default=3_000)
    parser.add_argument("--points", type=int, default=4_000)
    args = parser.parse_args()
    path = OUT / "collapse.json"
    records = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    if args.scene is not None:
        new = train(args.scene, args.arm, args.seed, args.iterations, args.points)
        key = ("scene", "arm", "seed", "iterations")
        records = [r for r in records if any(r[k] != new[k] for k in key)] + [new]
        OUT.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(records) + "\n", encoding="utf-8")
    (OUT / "collapse.md").write_text(table(records), encoding="utf-8")
    draw(records, OUT / "collapse.png")


if __name__ == "__main__":
    main()
