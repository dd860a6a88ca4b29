"""How far nu is from what it is designed to be, on an energy whose density is known.

    python examples/studies/histogram_error.py

The energy is stationary and Gaussian, so that nu should be 1 - z / 2 for an energy z deviations
above the mean, and its deviation 1/2. Both updates are told 10,000 such energies, without a clamp:
the paper's, in a fixed range of 6 deviations on either side with its temperature at (1 - zeta) /
(2 zeta) deviations, and the default. Writes `docs/results/histogram/error.json` and `error.png`.
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

from opt3dgs_optim import EnergyHistogram

MEAN, DEVIATION = 0.1, 0.01
ZETAS = (0.25, 0.5, 0.75)
WINDOWS = ((250, 1_000), (1_000, 3_000), (3_000, 10_000))
OUT = Path(__file__).resolve().parents[2] / "docs" / "results" / "histogram"
COLORS = {"0.25": "#d55e00", "0.5": "#0072b2", "0.75": "#009e73", "default": "black"}


def histogram_of(update: str, zeta: float) -> EnergyHistogram:
    """A histogram without bounds on nu."""
    if update == "default":
        return EnergyHistogram(zeta=zeta, warmup=250, clamp=None)
    reach = 6 * DEVIATION
    tau = (1 - zeta) / (2 * zeta) * DEVIATION
    ends = (MEAN - reach, MEAN + reach)
    return EnergyHistogram(200, ends, zeta=zeta, temperature=tau, warmup=250, clamp=None)


def measured(update: str, zeta: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """z and nu of every energy."""
    z = np.random.default_rng(seed).normal(size=WINDOWS[-1][1])
    histogram = histogram_of(update, zeta)
    nus = [float(histogram.observe(energy)) for energy in (MEAN + DEVIATION * z).tolist()]
    return z, np.array(nus)


def row(update: str, zeta: float, window: tuple[int, int], runs: list) -> dict[str, Any]:
    """What one window of the energies shows, over all seeds."""
    z = np.concatenate([z[slice(*window)] for z, _ in runs])
    nu = np.concatenate([nu[slice(*window)] for _, nu in runs])
    slope, at_mean = np.polyfit(z, nu, 1)
    return {
        "update": update,
        "zeta": zeta,
        "energies": list(window),
        "mean": round(float(nu.mean()), 4),
        "deviation": round(float(nu.std()), 4),
        "slope": round(float(slope), 4),
        "noise": round(float((nu - at_mean - slope * z).std()), 4),
    }


def study(seeds: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """All rows, and z against nu of the first seed's energies from the 2,000th to the 3,000th."""
    rows, points = [], {}
    for update in ("paper", "default"):
        # zeta does not enter the default's nu: tests/parts/test_histogram.py
        for zeta in ZETAS if update == "paper" else (0.75,):
            runs = [measured(update, zeta, seed) for seed in range(seeds)]
            rows += [row(update, zeta, window, runs) for window in WINDOWS]
            name = "default" if update == "default" else str(zeta)
            z, nu = runs[0]
            points[name] = [z[2_000:3_000].round(3).tolist(), nu[2_000:3_000].round(3).tolist()]
            print(f"{update} zeta={zeta}: {rows[-2]}", flush=True)
    return rows, points


def draw(record: dict[str, Any], path: Path) -> None:
    """nu against z above nu's deviation and slope against the number of energies, for a phone."""
    fig, (scatter, spread, bias) = plt.subplots(3, 1, figsize=(5.2, 8.6), layout="constrained")
    label = {name: f"paper's update, ζ = {name}" for name in COLORS} | {"default": "default, any ζ"}
    for name, (z, nu) in record["points"].items():
        scatter.plot(z, nu, ".", ms=2, color=COLORS[name], label=label[name])
    line = np.array([-3.0, 3.0])
    scatter.plot(line, 1 - line / 2, color="0.6", lw=1, label="design, 1 − z / 2")
    scatter.set(xlabel="z, deviations of the energy", ylabel="ν", ylim=(-4, 6), xlim=(-3, 3))
    for name, color in COLORS.items():
        update, zeta = ("default", 0.75) if name == "default" else ("paper", float(name))
        rows = [r for r in record["rows"] if (r["update"], r["zeta"]) == (update, zeta)]
        ends = [r["energies"][1] for r in rows]
        spread.plot(ends, [r["deviation"] for r in rows], "o-", ms=4, color=color)
        bias.plot(ends, [r["slope"] for r in rows], "o-", ms=4, color=color)
    spread.axhspan(0.4, 0.6, color="0.9")
    spread.axhline(0.5, color="0.6", lw=1)
    spread.set(xscale="log", yscale="log", xlabel="energies", ylabel="deviation of ν")
    bias.axhspan(-0.6, -0.4, color="0.9")
    bias.axhline(-0.5, color="0.6", lw=1)
    bias.set(xscale="log", xlabel="energies", ylabel="slope of ν in z")
    spread.set_yticks([0.3, 0.5, 1, 2, 5], ["0.3", "0.5", "1", "2", "5"])
    for axes in (spread, bias):
        axes.set_xticks([1_000, 3_000, 10_000], ["1,000", "3,000", "10,000"])
        axes.minorticks_off()
    fig.legend(*scatter.get_legend_handles_labels(), loc="outside upper center", ncols=2,
               frameon=False, markerscale=4)  # fmt: skip
    fig.supxlabel(f"{record['machine']}, {record['date']}", fontsize=8, color="0.4")
    fig.savefig(path, dpi=130, bbox_inches="tight")


def main() -> None:
    """Measure, or draw again what has been measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--draw", action="store_true", help="only draw error.json again")
    args = parser.parse_args()
    torch.set_num_threads(1)
    path = OUT / "error.json"
    if args.draw:
        record = json.loads(path.read_text(encoding="utf-8"))
    else:
        rows, points = study(args.seeds)
        record = {
            "command": f"python examples/studies/histogram_error.py --seeds {args.seeds}",
            "machine": f"{platform.system()} {platform.machine()}, torch {torch.__version__}",
            "date": time.strftime("%Y-%m-%d", time.gmtime()),
            "rows": rows,
            "points": points,
        }
        OUT.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record) + "\n", encoding="utf-8")
    draw(record, OUT / "error.png")


if __name__ == "__main__":
    main()
