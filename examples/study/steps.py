"""How long the steps really are: python examples/study/steps.py --scene DIR

Trains three arms and records, every fiftieth iteration, the root mean square of every parameter's
step over its learning rate (the trainer's, without any factor of ours). Fading and annealing are
compared by what they do to it. Writes docs/results/study/steps.json and steps.png; `--redraw`
draws the picture from the file.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import matplotlib as mpl
import torch
from splatting.fit import FitOptions
from splatting.scenes import Scene, load_scene
from tqdm import tqdm

from study.arms import find_study_arm
from study.fitting import StudyFit
from study.plots import COLOURS, DPI
from study.training import machine

mpl.use("Agg")

import matplotlib.pyplot as plt

ARMS = ("mcmc", "faded", "annealed-8-0.4")
EVERY = 50
FOLDER = Path(__file__).resolve().parents[2] / "docs" / "results" / "study"


def step_lengths(scene: Scene, arm: str, iterations: int, points: int) -> dict[str, Any]:
    """Root mean square of step / learning rate, by parameter, every `EVERY` iterations."""
    fit = StudyFit(scene, find_study_arm(arm), FitOptions(iterations, points, switch=1.0))
    rows: dict[str, list[float]] = {name: [] for name in ("iteration", *fit.gaussians)}
    for iteration in tqdm(range(iterations), desc=arm, unit="it"):
        sampled = iteration % EVERY == EVERY - 1
        before = {n: p.detach().clone() for n, p in fit.gaussians.items()} if sampled else {}
        rates = {n: float(o.param_groups[0]["lr"]) for n, o in fit.optimizers.items()}
        held, noise = fit.noise, fit.phases.noise if fit.phases is not None else None
        if sampled:  # the optimizer's own step: without the noise, this once
            _silence(fit)
        fit.step()
        fit.noise = held
        if noise is not None and fit.phases is not None:
            fit.phases._noise = noise  # pyright: ignore[reportPrivateUsage]
        same = all(before[n].shape == fit.gaussians[n].shape for n in before)
        if sampled and same:
            rows["iteration"].append(iteration + 1)
            for name, old in before.items():
                change = (fit.gaussians[name].detach() - old) / rates[name]
                rows[name].append(round(float(change.square().mean().sqrt()), 5))
    metrics = fit.evaluate()
    return {"psnr": round(metrics["psnr"], 3), "rows": rows}


def _silence(fit: StudyFit) -> None:
    fit.noise = None
    if fit.phases is not None:
        fit.phases._noise = None  # pyright: ignore[reportPrivateUsage]


def draw(data: dict[str, Any], path: Path) -> None:
    """One panel per parameter."""
    names = [n for n in next(iter(data["arms"].values()))["rows"] if n != "iteration"]
    figure, axes = plt.subplots(
        1, len(names), figsize=(3.0 * len(names), 3.0), sharey=True, layout="constrained"
    )
    for axis, name in zip(axes, names, strict=True):
        for arm, run in data["arms"].items():
            axis.plot(run["rows"]["iteration"], run["rows"][name], color=COLOURS[arm], label=arm)
        axis.set_title(name, fontsize=10)
        axis.set_yscale("log")
        axis.set_xlabel("iteration")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("rms step / learning rate")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, or 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--scene", default="embedded", metavar="DIR", help="scene folder, or 'embedded'")
    add("--iterations", type=int, default=3_000)
    add("--points", type=int, default=4_000)
    add("--redraw", action="store_true", help="only draw the picture, from the file")
    add("-o", "--out", type=Path, default=FOLDER, metavar="DIR")
    args = parser.parse_args(arguments)
    path = args.out / "steps.json"
    try:
        if not args.redraw:
            torch.set_num_threads(1)
            scene = load_scene(args.scene)
            runs = {arm: step_lengths(scene, arm, args.iterations, args.points) for arm in ARMS}
            about = {
                "machine": machine(),
                "date": date.today().isoformat(),
                "scene": scene.name,
                "iterations": args.iterations,
                "points": args.points,
            }
            args.out.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({**about, "arms": runs}) + "\n", encoding="utf-8")
        draw(json.loads(path.read_text(encoding="utf-8")), args.out / "steps.png")
    except (OSError, ValueError) as error:
        print(f"steps: {error}", file=sys.stderr)
        return 2
    print(path, args.out / "steps.png", sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
