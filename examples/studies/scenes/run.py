"""Train what the study compares: python examples/studies/scenes/run.py --scenes DIR --jobs 2

Resumable: Ctrl-C loses at most a twentieth of the trainings in progress, and the same command
goes on. `--stages quarter,half` trains a part of the plan, `--arms NAME,NAME` these arms in the
place of the plan's. `report.py` turns the records into tables, plots and the page.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from splatting.processes import side_by_side, start
from splatting.stopping import command, stop_at_once
from tqdm import tqdm

from studies.scenes.arms import find_study_arm
from studies.scenes.plan import Training, plan


def finished(folder: Path) -> dict[str, object] | None:
    """The record of a training that has run to its end."""
    path = folder / "record.json"
    record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return record if record.get("finished") else None


@command("study")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 1 where a training has failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add(
        "--scenes",
        type=Path,
        default=Path("scenes"),
        metavar="DIR",
        help="folder of the scenes' folders; the stage `embedded` needs none",
    )
    add("--stages", help="comma-separated; all where not given")
    add("--arms", help="comma-separated; those of the stages where not given")
    add("--seeds", type=int, default=3)
    add("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="trainings at a time")
    add("--lpips", nargs=2, metavar=("FILE.py", "WEIGHTS"), help="see perceptual.py")
    add("-o", "--out", type=Path, default=Path("runs/study"), metavar="DIR")
    args = parser.parse_args(arguments)
    stages, arms = (words.split(",") if words else () for words in (args.stages, args.arms))
    trainings = plan(args.scenes, args.out, stages, args.seeds, arms)
    stop_at_once()
    failed = _train_all(trainings, args.jobs, args.lpips)
    for folder in failed:
        print(f"failed: {folder} (see {folder / 'error.txt'})", file=sys.stderr)
    return 1 if failed else 0


def _train_all(trainings: list[Training], jobs: int, lpips: list[str] | None = None) -> list[Path]:
    """Train what is not finished; return the folders of what could not be."""
    done = {t.folder for t in trainings if finished(t.folder)}
    left = [t for t in trainings if t.folder not in done]

    def ended(batch: list[Training], _code: int) -> None:
        bar.update(sum(map(_iterations, batch)))
        done.update(t.folder for t in batch if finished(t.folder))

    total = sum(map(_iterations, left))
    with tqdm(total=total, unit="it", desc=f"{len(left)} trainings", smoothing=0.02) as bar:
        side_by_side(
            _batches(left),
            jobs,
            lambda batch: all(folder in done for t in batch for folder in t.needs),
            lambda batch: _start(batch, lpips),
            ended,
        )
    return [t.folder for t in left if t.folder not in done]


def _iterations(training: Training) -> int:
    """What a training costs: a branch runs from its switch on."""
    arm, total = find_study_arm(training.spec.arm), training.spec.iterations
    return total if arm.trunk is None else total - round(arm.switch * total)


def _batches(trainings: list[Training]) -> list[list[Training]]:
    """Branches of one trunk share a process, since starting one costs as much as they do."""
    batches: dict[tuple[Path, bool], list[Training]] = {}
    for training in trainings:
        key = (training.trunk or training.folder, training.trunk is None)
        batches.setdefault(key, []).append(training)
    return list(batches.values())


def _start(batch: list[Training], lpips: list[str] | None) -> subprocess.Popen[bytes]:
    calls = [str(_write_call(training, lpips)) for training in batch]
    with (batch[0].folder / "error.txt").open("wb") as errors:
        return start([str(Path(__file__).with_name("training.py")), *calls], stderr=errors)


def _write_call(training: Training, lpips: list[str] | None) -> Path:
    training.folder.mkdir(parents=True, exist_ok=True)
    nu = None
    if training.nu_from is not None:
        record = finished(training.nu_from)
        assert record is not None
        nu = record["mean_nu"]
    call = {
        "spec": asdict(training.spec),
        "folder": str(training.folder),
        "trunk": None if training.trunk is None else str(training.trunk),
        "mean_nu": nu,
        "lpips": lpips,
    }
    path = training.folder / "call.json"
    path.write_text(json.dumps(call), encoding="utf-8")
    return path


if __name__ == "__main__":
    raise SystemExit(main())
