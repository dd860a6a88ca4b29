"""Whether a training falls while nu is on: before and after the histogram followed the energy.

    python examples/studies/collapse.py

Draws table and picture of the trainings in `docs/results/histogram/collapse.json`. An arm was stock
3DGS-MCMC with nu and nothing else, a twelfth of the run as warm-up. `default` is
`EnergyHistogram()`; `frozen` what was the default until 2026-11-22: the paper's update, range and
temperature measured once, in the first twenty-fourth of the run; `stock` has no nu. The training
PSNR was looked at 60 times; a fall is how far it was below its best so far. The question is
decided: the code that trained the arms is in the history of this file.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib.pyplot as plt
import numpy as np

from studies import pages

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


def main() -> int:
    """Write table and picture."""
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    records = json.loads((OUT / "collapse.json").read_text(encoding="utf-8"))
    (OUT / "collapse.md").write_text(table(records), encoding="utf-8")
    draw(records, OUT / "collapse.png")
    print(OUT / "collapse.md", OUT / "collapse.png", sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
