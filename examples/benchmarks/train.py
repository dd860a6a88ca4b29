"""Train one line of the evidence, from where an earlier start was stopped.

    python examples/benchmarks/train.py --scene scenes/lego --arm defaults --size images_2 \\
        --iterations 10000 --points 50000 --seed 0 --background white

Writes `--out` (JSON: the training and its curve) and a checkpoint beside it at each of ten
evaluations; `python examples/benchmarks/evidence.py FILE.json` adds it to the evidence. One thread:
start as many as there are cores. The seed also says which views are held out. Half size with 50,000
Gaussians takes an hour of a core for 30,000 iterations, a quarter of the size a few minutes. On
Linux `MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=1000000000000` before the command takes a fifth off
the time at whole size: memory is kept, and not fetched anew in each iteration.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from splatting.arms import ARMS, Arm, find_arm
from splatting.fit import Fit, FitOptions
from splatting.scenes import Background, Scene, Size, load_scene
from splatting.stopping import check_folder, command
from torch import Tensor
from tqdm import tqdm

from benchmarks.evidence import DENSITIES, RELOCATION

EVALUATIONS = 10
KEPT = ("size", "density", "arm", "iterations", "points", "sh_degree", "seed", "views", "threshold")
Lpips = Callable[[Tensor, Tensor], float]  # of images [H, W, 3] in 0..1


def scene_of(args: argparse.Namespace) -> Scene:
    """The scene with the views that this training holds out, and as many others as it has."""
    scene = load_scene(args.scene, args.size, background=args.background, held_out=args.seed % 8)
    count = len(scene.train)
    if args.views and not 2 <= args.views <= count:
        raise ValueError(f"--views {args.views}: 2 to {count} are allowed, or 0 for all")
    kept = range(count) if not args.views else [i * count // args.views for i in range(args.views)]
    return replace(scene, train=[scene.train[i] for i in kept])


def fit_of(scene: Scene, arm: Arm, options: FitOptions, density: str = RELOCATION) -> Fit:
    """The trainer of an arm, with that kind of density control."""
    if density == RELOCATION:
        return Fit(scene, arm, options)
    from benchmarks.adaptive import AdaptiveFit  # needs gsplat, which is optional

    return AdaptiveFit(scene, arm, options)


def lpips_of(tool: Path, weights: Path) -> Lpips:
    """LPIPS by a Python file of yours.

    It has `load(weights_dir, net)` and `lpips(model, a, b)` for images [B, 3, H, W] in -1..1: a
    thin wrapper of any implementation (the `lpips` package needs torchvision and a download).
    """
    spec = importlib.util.spec_from_file_location("lpips_tool", tool)
    if spec is None or spec.loader is None:
        raise ValueError(f"--lpips {tool}: not a Python file")
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    model = module.load(weights, "alex")

    def distance(a: Tensor, b: Tensor) -> float:
        return float(module.lpips(model, *(x.permute(2, 0, 1)[None] * 2 - 1 for x in (a, b))))

    return distance


def look(fit: Fit, seconds: float, lpips: Lpips | None) -> dict[str, float]:
    """A row of the curve: the held-out views as they are now."""
    row = {"iteration": fit.iteration, "seconds": seconds, **fit.evaluate()}
    row["relocated"] = fit.relocated
    if lpips is not None:
        test = fit.scene.test  # of the image as a file would have it
        values = [lpips((255 * fit.image(v)).round() / 255, v.image) for v in test]
        row["lpips"] = sum(values) / len(values)
    return {name: round(value, 4) for name, value in row.items()}


def train(fit: Fit, record: dict[str, Any], out: Path, lpips: Lpips | None = None) -> None:
    """Train to the end; the record and a checkpoint are written at each evaluation."""
    checkpoint, total = out.with_suffix(".pt"), fit.options.iterations
    record["curve"] = []
    if out.exists() and checkpoint.exists():
        fit.load(checkpoint)
        curve = json.loads(out.read_text(encoding="utf-8"))["curve"]
        record["curve"] = [row for row in curve if row["iteration"] <= fit.iteration]
    fit.compile_kernels()
    if not record["curve"]:
        record["curve"].append(look(fit, 0.0, lpips))
    marks = {*range(total // EVALUATIONS or 1, total, total // EVALUATIONS or 1), total}
    name = f"{fit.scene.name} {fit.arm.name} #{fit.options.seed}"
    with tqdm(total=total, initial=fit.iteration, desc=name, unit="it") as bar:
        while fit.iteration < total:
            begin = time.process_time()
            fit.step()
            while fit.iteration not in marks:
                fit.step()
                bar.update()
            seconds = record["curve"][-1]["seconds"] + time.process_time() - begin
            bar.update()
            record["curve"].append(look(fit, seconds, lpips))
            bar.set_postfix_str(f"{record['curve'][-1]['psnr']:.2f} dB")
            record["finished"] = fit.iteration == total
            partial = out.with_suffix(".partial")
            partial.write_text(json.dumps(record), encoding="utf-8")
            os.replace(partial, out)
            fit.save(checkpoint)


def shared() -> argparse.ArgumentParser:
    """The options that `open_end.py` has, too."""
    made = argparse.ArgumentParser(add_help=False)
    add = made.add_argument
    add("--scene", default="embedded", metavar="DIR", help="scene folder, or 'embedded'")
    add("--size", default="images_4", choices=get_args(Size), help="folder of the photos")
    add("--background", default="black", choices=get_args(Background))
    add("--points", type=int, default=10_000, help="the most Gaussians")
    add("--seed", type=int, default=0)
    add("--views", type=int, default=0, metavar="N", help="evenly spaced ones to train on; 0: all")
    add("--lpips", nargs=2, type=Path, metavar=("FILE.py", "WEIGHTS"), help="see `lpips_of`")
    add("-o", "--out", type=Path, metavar="FILE", help="default: in runs/benchmarks")
    return made


def parser() -> argparse.ArgumentParser:
    """The options."""
    about, planned = (__doc__ or "").splitlines()[0], [x for x in ARMS if not ARMS[x].open_end]
    made = argparse.ArgumentParser(description=about, parents=[shared()])
    add = made.add_argument
    add("--arm", default="defaults", choices=planned, metavar="ARM", help=", ".join(planned))
    add("--iterations", type=int, default=7_500)
    add("--sh-degree", type=int, default=0, choices=range(4))
    add("--density", default=RELOCATION, choices=DENSITIES)
    add("--threshold", type=float, default=1.0, help="factor on that of clone and split")
    return made


def options_of(args: argparse.Namespace) -> FitOptions:
    """How to fit."""
    return FitOptions(
        args.iterations,
        args.points,
        args.seed,
        sh_degree=args.sh_degree,
        threshold=args.threshold,
    )


def record_of(args: argparse.Namespace, scene: Scene) -> dict[str, Any]:
    """What is trained, where and when."""
    record = {"scene": scene.name, **{name: vars(args)[name] for name in KEPT}}
    record |= {"machine": f"{platform.system()} {platform.machine()}, torch {torch.__version__}"}
    return record | {"date": time.strftime("%Y-%m-%d", time.gmtime())}


@command("train")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    args = parser().parse_args(arguments)
    torch.set_num_threads(1)
    scene, arm = scene_of(args), find_arm(args.arm)
    record = record_of(args, scene)
    name = "-".join(str(record[key]) for key in ("scene", *KEPT))
    out = args.out or Path("runs/benchmarks", f"{name}.json")
    check_folder(out.parent)
    lpips = args.lpips and lpips_of(*args.lpips)
    # gsplat's split draws from torch's global generator; `lpips_of` may have drawn from it, too.
    torch.manual_seed(args.seed)
    train(fit_of(scene, arm, options_of(args), args.density), record, out, lpips)
    print(out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
