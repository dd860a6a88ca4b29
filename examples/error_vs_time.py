"""Compare ways of training on one scene: error against run time, as a table and a picture.

python examples/error_vs_time.py                      (the embedded scene; nothing to download)
python examples/error_vs_time.py --scene DIR --points 20000 --iterations 7500 -o runs/mine

The ways of training are called arms here. `mcmc` is 3DGS-MCMC as its authors publish it, with which
all others are compared; in `rates-x3` all of its steps are three times as long. `adam` is torch's
Adam from the start of INRIA's trainer, without density control, noise and penalties. `awsgld` adds
AW-SGLD's multiplier to 3DGS-MCMC, and `constant`, its control, a constant of that multiplier's
mean. `paper` is the paper's preset, `defaults` are the package's. Seconds are those of its own
process.

The embedded scene gives 2,000 points to start from, and the trainings grow to 4,000 Gaussians in
3,000 iterations. Both matter. 3DGS-MCMC starts from Gaussians a tenth as wide as INRIA's trainer,
which a short training does not make up for; and what it does better, to grow and to relocate what
has become transparent, shows only where there is something to grow.

Every arm and seed is a training of its own process and folder. Ctrl-C stops them all with a
checkpoint each; the same command goes on from there, and repeats nothing that is finished.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from splatting.arms import ARMS, BASELINE, Arm, in_order
from splatting.gallery import draw_gallery
from splatting.processes import side_by_side, start
from splatting.scenes import load_scene
from splatting.stopping import command, stop_at_once
from splatting.writable import check_folder
from tqdm import tqdm
from train import SHARED_OPTIONS, add_fit_options, fit_options, recorded_command

from opt3dgs_optim.runs import Run, read_run
from opt3dgs_optim.runs.report import write_report
from opt3dgs_optim.runs.stats import compare

DEFAULT_ARMS = "mcmc,rates-x3,adam,awsgld,constant,paper,defaults"


@dataclass
class Training:
    """One arm and seed, in a folder of its own."""

    arm: Arm
    seed: int
    folder: Path

    @property
    def log(self) -> Path:
        return self.folder / "log.jsonl"

    @property
    def view(self) -> Path:
        return self.folder / "view.npy"

    def finished(self) -> Run | None:
        """Its log if it has run to the end, and has left its picture."""
        run = read_run(self.log) if self.log.exists() and self.view.exists() else None
        done = run is not None and any(event["event"] == "finished" for event in run.events)
        return run if done else None

    def iteration(self) -> int:
        """How far it is, from the last whole line of its log."""
        if not self.log.exists():
            return 0
        with self.log.open("rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - 4096, 0))
            lines = file.read().split(b"\n")[:-1]
        return json.loads(lines[-1])["iteration"] if len(lines) > 1 else 0

    def mean_nu(self) -> float:
        """Mean of nu of a finished run of the histogram arm."""
        run = self.finished()
        assert run is not None
        return next(e["mean_nu"] for e in run.events if e["event"] == "finished")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").splitlines()[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add_fit_options(parser)
    add = parser.add_argument
    add("--arms", default=DEFAULT_ARMS, help="comma-separated")
    add("--seeds", type=int, default=2, help="seeds per arm")
    add("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="trainings at a time")
    add("-o", "--out", type=Path, metavar="DIR", help="folder; None: runs/SCENE-SIZE")
    return parser


@command("error_vs_time")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = _parser()
    args = parser.parse_args(arguments)
    arms = in_order([name.strip() for name in args.arms.split(",") if name.strip()])
    if not arms:
        raise ValueError(f"--arms {args.arms!r}: names no arm; there are {', '.join(ARMS)}")
    options = asdict(fit_options(args))
    for name in ("seeds", "jobs"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name} {getattr(args, name)}: must be at least 1")
    if args.out is not None:
        check_folder(args.out)  # before the scene is read
    scene = load_scene(args.scene, args.size, background=args.background)
    out = args.out or Path("runs") / f"{scene.name}-{args.size}"
    check_folder(out)
    trainings = [
        Training(arm, seed, out / arm.name / f"seed-{seed}")
        for seed in range(args.seeds)
        for arm in arms
    ]
    del options["seed"]
    about = {"scene": scene.name, "size": args.size, "background": args.background}
    _refuse_other_options(trainings, options | about)
    stop_at_once()
    _train_all(trainings, args, recorded_command("error_vs_time.py", parser, args))
    runs = [run for training in trainings if (run := training.finished())]
    written = write_report(runs, out, baseline=reference(runs))
    fitted = {t.arm.name: t.view for t in trainings if t.seed == 0}
    draw_gallery(scene.test[0], fitted, out / "renders.png")
    print(summary(runs))
    print(*written, out / "renders.png", sep="\n")
    return 0


def reference(runs: Sequence[Run]) -> str:
    """The arm that all are compared with: 3DGS-MCMC, or the first where it was not trained."""
    names = [str(run.metadata["arm"]) for run in runs]
    return BASELINE if BASELINE in names else names[0]


def summary(runs: Sequence[Run]) -> str:
    """What the terminal shows: one line per arm, as wide as a terminal."""
    (comparison,) = compare(runs, "psnr", reference(runs))
    columns = {
        "PSNR": ("final psnr", "{:.2f} dB"),
        "SSIM": ("final ssim", "{:.3f}"),
        "seconds": ("seconds", "{:.0f}"),
        f"to {reference(runs)}'s PSNR": ("seconds to baseline psnr", "{:.0f} s"),
        "gain at equal seconds": ("psnr gain at equal seconds", "{:+.2f} dB"),
    }
    rows = [["", *columns]]
    for arm in comparison.arms:
        found = [(arm.numbers.get(key), form) for key, form in columns.values()]
        rows.append([arm.name, *(form.format(s.mean) if s else "-" for s, form in found)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for name, *cells in rows:
        right = (cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True))
        lines.append("  ".join([name.ljust(widths[0]), *right]))
    seeds = max(len(arm.runs) for arm in comparison.arms)
    lines.append(f"Means over {seeds} seeds." if seeds > 1 else "One seed.")
    return "\n".join(lines)


def _refuse_other_options(trainings: list[Training], asked: dict[str, Any]) -> None:
    """A folder that holds runs with other options would mix what is not comparable."""
    for training in trainings:
        its = read_run(training.log).metadata if training.log.exists() else asked
        differing = {key: its.get(key) for key in asked if its.get(key) != asked[key]}
        if differing:
            raise ValueError(
                f"{training.folder}: holds a run with {differing}, asked for are "
                f"{ {key: asked[key] for key in differing} }; use another -o"
            )


def _train_all(trainings: list[Training], args: argparse.Namespace, said: str) -> None:
    waiting = [training for training in trainings if training.finished() is None]
    total = args.iterations * len(waiting)
    named = {(training.arm.name, training.seed): training for training in trainings}

    def source(training: Training) -> Training:
        """The run whose mean nu a control takes: same seed, the arm that it is the control of."""
        return named[training.arm.needs or "", training.seed]

    def may_start(training: Training) -> bool:
        return training.arm.needs is None or source(training).finished() is not None

    def begin(training: Training) -> subprocess.Popen[bytes]:
        words = [str(Path(__file__).with_name("train.py")), "--quiet"]
        for name in SHARED_OPTIONS:
            words += [f"--{name.replace('_', '-')}", str(getattr(args, name))]
        words += ["--arm", training.arm.name, "--seed", str(training.seed)]
        words += ["-o", str(training.folder), "--command", said]
        if training.arm.needs is not None:
            words += ["--mean-nu", repr(source(training).mean_nu())]
        return start(words)

    def ended(training: Training, code: int) -> None:
        if code in (130, -2):
            raise KeyboardInterrupt
        if code != 0:
            raise ValueError(f"{training.folder}: the training ended with code {code}")

    def look(running: list[Training]) -> None:
        left = sum(args.iterations - training.iteration() for training in running)
        bar.update(total - left - args.iterations * len(waiting) - bar.n)
        bar.set_postfix_str(", ".join(f"{t.arm.name} #{t.seed}" for t in running))

    what = f"{len(waiting)} trainings"
    # Without a terminal a bar would be a line for each of its states.
    with tqdm(total=total, unit="it", desc=what, smoothing=0.05, disable=None) as bar:
        side_by_side(waiting, args.jobs, may_start, begin, ended, look)


if __name__ == "__main__":
    raise SystemExit(main())
