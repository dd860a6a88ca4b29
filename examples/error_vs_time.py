"""Compare arms on one scene: error against run time, as a table and a plot.

python examples/error_vs_time.py                      (the embedded scene; nothing to download)
python examples/error_vs_time.py --scene DIR --points 4000 --iterations 3000 -o runs/mine

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

from splatting.arms import ARMS, Arm, in_order
from splatting.gallery import draw_gallery
from splatting.processes import side_by_side, start
from splatting.scenes import load_scene
from splatting.stopping import command, stop_at_once
from splatting.writable import check_folder
from tqdm import tqdm
from train import SHARED_OPTIONS, add_fit_options, fit_options, recorded_command

from opt3dgs_optim.runs import Run, read_run
from opt3dgs_optim.runs.report import write_report

DEFAULT_ARMS = "adam,mcmc,mcmc+awsgld,mcmc+constant-multiplier,mcmc+l2+reset,opt3dgs,defaults"


@dataclass
class Training:
    """One arm and seed, in a folder of its own."""

    arm: Arm
    seed: int
    folder: Path

    @property
    def log(self) -> Path:
        return self.folder / "log.jsonl"

    def finished(self) -> Run | None:
        """Its log if it has run to the end."""
        run = read_run(self.log) if self.log.exists() else None
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
    written = write_report(runs, out)
    fitted = {t.arm.name: t.folder / "view.npy" for t in trainings if t.seed == 0}
    draw_gallery(scene.test[0], fitted, out / "renders.png")
    print((out / "report.md").read_text(encoding="utf-8"))
    print(*written, out / "renders.png", sep="\n")
    return 0


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

    with tqdm(total=total, unit="it", desc=f"{len(waiting)} trainings", smoothing=0.05) as bar:
        side_by_side(waiting, args.jobs, may_start, begin, ended, look)


if __name__ == "__main__":
    raise SystemExit(main())
