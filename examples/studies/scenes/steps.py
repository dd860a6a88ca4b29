"""How long the steps really are: python examples/studies/scenes/steps.py --scene DIR

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
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import matplotlib.pyplot as plt
import torch
from splatting.arms import fixed
from splatting.fit import Fit, FitOptions
from splatting.scenes import Scene, load_scene
from splatting.stopping import command
from tqdm import tqdm

from studies.scenes.arms import find_study_arm
from studies.scenes.parts.step_lengths import StepLengths
from studies.scenes.plots import COLOURS, DPI
from studies.scenes.records import FOLDER
from studies.scenes.training import machine

ARMS = ("mcmc", "faded", "annealed-8-0.4")
EVERY = 50


def step_lengths(scene: Scene, name: str, iterations: int, points: int) -> dict[str, Any]:
    """Root mean square of step / learning rate, by parameter, every `EVERY` iterations."""
    arm, lengths = find_study_arm(name), StepLengths(EVERY)
    made = arm.parts or fixed()
    watched = replace(arm, parts=lambda count, nu: [*made(count, nu), lengths])
    fit = Fit(scene, watched, FitOptions(iterations, points, switch=1.0))
    for _ in tqdm(range(iterations), desc=name, unit="it"):
        fit.step()
    looked = [*range(EVERY, iterations + 1, EVERY)]
    psnr = round(fit.evaluate()["psnr"], 3)
    return {"psnr": psnr, "rows": {"iteration": looked, **lengths.rows}}


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


@command("steps")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--scene", default="embedded", metavar="DIR", help="scene folder, or 'embedded'")
    add("--iterations", type=int, default=3_000)
    add("--points", type=int, default=4_000)
    add("--redraw", action="store_true", help="only draw the picture, from the file")
    add("-o", "--out", type=Path, default=FOLDER, metavar="DIR")
    args = parser.parse_args(arguments)
    path = args.out / "steps.json"
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
    print(path, args.out / "steps.png", sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
