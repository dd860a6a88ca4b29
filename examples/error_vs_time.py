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
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from splatting.arms import ARMS, Arm, in_order
from splatting.gallery import draw_gallery
from splatting.scenes import load_scene
from splatting.stopping import stop_at_once
from splatting.writable import check_folder
from tqdm import tqdm
from train import SHARED_OPTIONS, add_fit_options, fit_options, recorded_command

from opt3dgs_optim.runs import Run, read_run
from opt3dgs_optim.runs.report import write_report

DEFAULT_ARMS = "adam,mcmc,mcmc+awsgld,mcmc+constant-multiplier,mcmc+l2+reset,opt3dgs,defaults"
POLL_SECONDS = 0.2


@dataclass
class Training:
    """One arm and seed, in a folder of its own."""

    arm: Arm
    seed: int
    folder: Path
    process: subprocess.Popen[bytes] | None = field(default=None, repr=False)

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


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, 2 after one line that says what is wrong, 130 when interrupted."""
    parser = _parser()
    args = parser.parse_args(arguments)
    try:
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
        command = recorded_command("error_vs_time.py", parser, args)
        stop_at_once()
        _train_all(trainings, args, command)
    except (OSError, ValueError) as error:
        print(f"error_vs_time: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from the checkpoints", file=sys.stderr)
        return 130
    runs = [run for training in trainings if (run := training.finished())]
    written = write_report(runs, out)
    fitted = {t.arm.name: t.folder / "gaussians.ply" for t in trainings if t.seed == 0}
    draw_gallery(scene.test[0], fitted, out / "renders.png")
    print((out / "report.md").read_text(encoding="utf-8"))
    for path in [*written, out / "renders.png"]:
        print(path)
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


def _train_all(trainings: list[Training], args: argparse.Namespace, command: str) -> None:
    waiting = [training for training in trainings if training.finished() is None]
    running: list[Training] = []
    total = args.iterations * len(waiting)
    bar = tqdm(total=total, unit="it", desc=f"{len(waiting)} trainings", smoothing=0.05)
    try:
        while waiting or running:
            for training in list(waiting):
                if len(running) < args.jobs and _may_start(training, trainings):
                    waiting.remove(training)
                    running.append(training)
                    _start(training, trainings, args, command)
            time.sleep(POLL_SECONDS)
            _reap(running)
            left = sum(args.iterations - training.iteration() for training in running)
            bar.update(total - left - args.iterations * len(waiting) - bar.n)
            bar.set_postfix_str(", ".join(f"{t.arm.name} #{t.seed}" for t in running))
    except BaseException:
        _stop(running)
        raise
    finally:
        bar.close()


def _may_start(training: Training, trainings: list[Training]) -> bool:
    return training.arm.needs is None or _source(training, trainings).finished() is not None


def _source(training: Training, trainings: list[Training]) -> Training:
    """The run whose mean nu a control takes: same seed, the arm that it is the control of."""
    return next(t for t in trainings if (t.arm.name, t.seed) == (training.arm.needs, training.seed))


def _start(
    training: Training, trainings: list[Training], args: argparse.Namespace, command: str
) -> None:
    words = [sys.executable, str(Path(__file__).with_name("train.py")), "--quiet"]
    for name in SHARED_OPTIONS:
        words += [f"--{name.replace('_', '-')}", str(getattr(args, name))]
    words += ["--arm", training.arm.name, "--seed", str(training.seed)]
    words += ["-o", str(training.folder), "--command", command]
    if training.arm.needs is not None:
        words += ["--mean-nu", repr(_source(training, trainings).mean_nu())]
    # One thread each: trainings side by side share the cores, and the figures stay comparable.
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    # A session of its own: Ctrl-C reaches this process alone, which passes it on once.
    training.process = subprocess.Popen(words, env=environment, start_new_session=True)


def _reap(running: list[Training]) -> None:
    for training in list(running):
        assert training.process is not None
        code = training.process.poll()
        if code is None:
            continue
        running.remove(training)
        if code in (130, -2):
            raise KeyboardInterrupt
        if code != 0:
            raise ValueError(f"{training.folder}: the training ended with code {code}")


def _stop(running: list[Training]) -> None:
    """Ask each for a checkpoint, and wait for it."""
    for training in running:
        if training.process is not None and training.process.poll() is None:
            training.process.send_signal(signal.SIGINT)
    for training in running:
        if training.process is not None:
            training.process.wait()


if __name__ == "__main__":
    raise SystemExit(main())
