"""Error against run time, ways of training side by side: python examples/error_vs_time.py

Trains a small scene that it draws itself, so nothing is downloaded: 3DGS-MCMC as its authors
publish it (`stock`), the same with this package's defaults (`defaults`), and with all steps three
times as long (`x3`, the best of the constant factors that were tried at this length). They take
turns, so that what else the machine does slows all of them alike, and are compared at equal
seconds. Under a minute on a free core, two on a busy one; the first start compiles the renderer.

    python examples/error_vs_time.py --seeds 3 --iterations 7500           (half an hour)
    python examples/error_vs_time.py --scene DIR --size images_4 --points 10000 --arms stock,x2

Longer trainings, which are resumed after a stop: examples/benchmarks/train.py.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import torch
from splatting.arms import ARMS, BASELINE, find_arm
from splatting.fit import Fit, FitOptions
from splatting.gallery import draw_comparison
from splatting.scenes import Background, Size, load_scene
from splatting.stopping import check_folder, command
from tqdm import tqdm

from opt3dgs_optim.runs import Run, RunLog, read_run
from opt3dgs_optim.runs.report import write_report
from opt3dgs_optim.runs.stats import compare

DEFAULT_ARMS = f"{BASELINE},defaults,x3"
TURN = 50  # iterations of one training before the next one's


class Training:
    """One arm and seed, its log, and a clock that runs while it trains."""

    def __init__(self, fit: Fit, folder: Path, looks: int) -> None:
        self.fit, self.seconds = fit, 0.0
        self.path = folder / fit.arm.name / f"seed-{fit.options.seed}.jsonl"
        self.looks = looks
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.unlink(missing_ok=True)
        about = {"arm": fit.arm.name, "scene": fit.scene.name, "seed": fit.options.seed}
        self.log = RunLog(self.path, metadata=about, clock=lambda: self.seconds)

    def look(self) -> float:
        """Log the held-out views as they are now; their mean PSNR."""
        found = self.fit.evaluate()
        self.log.evaluation(self.fit.iteration, **found)
        return found["psnr"]

    def go_on(self, bar: tqdm) -> bool:
        """Train for a turn; whether there is more to do."""
        fit = self.fit
        for _ in range(min(TURN, fit.options.iterations - fit.iteration)):
            begin = time.process_time()
            fit.step()
            self.seconds += time.process_time() - begin
            bar.update()
            if fit.iteration * self.looks % fit.options.iterations < self.looks:
                psnr = self.look()
                bar.set_postfix_str(f"{fit.arm.name} #{fit.options.seed}: {psnr:.2f} dB")
        return fit.iteration < fit.options.iterations


def train(trainings: Sequence[Training]) -> None:
    """All of them, in turns."""
    with tqdm(total=1, desc="compiling the renderer", bar_format="{desc} {elapsed}") as bar:
        trainings[0].fit.compile_kernels()
        bar.update()
    for training in trainings:
        training.look()
    total = sum(training.fit.options.iterations for training in trainings)
    with tqdm(total=total, unit="it", desc=f"{len(trainings)} trainings") as bar:
        left = list(trainings)
        while left:
            left = [training for training in left if training.go_on(bar)]
    for training in trainings:
        training.log.close()


def summary(runs: Sequence[Run], baseline: str) -> str:
    """What the terminal shows: one line an arm."""
    (comparison,) = compare(runs, "psnr", baseline)
    columns = {
        "PSNR": ("final psnr", "{:.2f} dB"),
        "SSIM": ("final ssim", "{:.3f}"),
        "seconds": ("seconds", "{:.0f}"),
        f"to {baseline}'s PSNR": ("seconds to baseline psnr", "{:.0f} s"),
        "gain at equal seconds": ("psnr gain at equal seconds", "{:+.2f} dB"),
    }
    rows = [["", *columns]]
    for arm in comparison.arms:
        found = [(arm.numbers.get(key), form) for key, form in columns.values()]
        rows.append([arm.name, *(form.format(s.mean) if s else "-" for s, form in found)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(c.rjust(w) for c, w in zip(row, widths, strict=True)) for row in rows]
    seeds = max(len(arm.runs) for arm in comparison.arms)
    return "\n".join([*lines, f"Means over {seeds} seeds." if seeds > 1 else "One seed."])


def won(runs: Sequence[Run], baseline: str, picture: Path) -> str:
    """What the last line says of the first arm beside the baseline."""
    (comparison,) = compare(runs, "psnr", baseline)
    first, *others = comparison.arms
    ours = others[0] if others else first
    psnr, theirs = (arm.numbers["final psnr"] for arm in (ours, first))
    reached = ours.numbers["seconds to baseline psnr"]
    assert psnr is not None
    assert theirs is not None
    if not others or reached is None:
        return f"{ours.name} ends at {psnr.mean:.2f} dB: {picture}"
    gain = psnr.mean - theirs.mean
    return (
        f"{ours.name} ends {abs(gain):.2f} dB {'above' if gain > 0 else 'below'} {baseline}, whose "
        f"PSNR it has after {reached.mean:.0f} seconds: {picture}"
    )


@command("error_vs_time")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    said = "; ".join(f"{arm.name}: {arm.what}" for arm in ARMS.values())
    add("--scene", default="embedded", metavar="DIR", help="scene folder, or 'embedded'")
    add("--size", default="images_2", choices=get_args(Size), help="folder of the photos")
    add("--background", default="black", choices=get_args(Background), help="behind the scene")
    add("--points", type=int, default=4_000, help="the most Gaussians")
    add("--iterations", type=int, default=1_200, help="length of a training")
    add("--sh-degree", type=int, default=0, choices=range(4), help="of the colours")
    add("--arms", default=DEFAULT_ARMS, help=f"comma-separated; {said}")
    add("--seeds", type=int, default=1, help="seeds per arm")
    add("--looks", type=int, default=12, help="evaluations of a training")
    add("-o", "--out", type=Path, default=Path("runs/error_vs_time"), metavar="DIR", help="folder")
    args = parser.parse_args(arguments)
    arms = [find_arm(name.strip()) for name in args.arms.split(",")]
    for name in ("seeds", "looks"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name} {getattr(args, name)}: must be at least 1")
    options = [
        FitOptions(args.iterations, args.points, seed, sh_degree=args.sh_degree)
        for seed in range(args.seeds)
    ]
    check_folder(args.out)
    names = ", ".join(arm.name for arm in arms)
    took = "" if vars(args) != vars(parser.parse_args([])) else ": one to two minutes"
    print(
        f"{len(arms) * args.seeds} trainings of {args.iterations:,} iterations on {args.scene} in "
        f"turns ({names}), then pictures in {args.out}{took}."
    )
    torch.set_num_threads(1)
    scene = load_scene(args.scene, args.size, background=args.background)
    fits = [Fit(scene, arm, each) for each in options for arm in arms]
    trainings = [Training(fit, args.out, args.looks) for fit in fits]
    train(trainings)
    runs, baseline = [read_run(each.path) for each in trainings], arms[0].name
    written = write_report(runs, args.out, baseline=baseline)
    view = scene.test[0]
    shown = [(fit.arm.name, fit.image(view)) for fit in fits if fit.options.seed == 0]
    picture = args.out / "comparison.png"
    draw_comparison(compare(runs, "psnr", baseline)[0].arms, view, shown, picture)
    print(summary(runs, baseline), *written, won(runs, baseline, picture), sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
