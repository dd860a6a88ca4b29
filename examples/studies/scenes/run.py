"""Train what the study compares: python examples/studies/scenes/run.py --scenes DIR --jobs 2

Resumable: Ctrl-C loses at most a twentieth of the trainings in progress, and the same command
goes on. `--stages core,tails` trains a part. `report.py` turns the records into tables, plots and
the page.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from splatting.stopping import stop_at_once
from tqdm import tqdm

from studies.scenes.arms import STUDY_ARMS
from studies.scenes.plan import Training, plan

POLL_SECONDS = 0.2


def finished(folder: Path) -> dict[str, object] | None:
    """The record of a training that has run to its end."""
    path = folder / "record.json"
    record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return record if record.get("finished") else None


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, 2 after one line that says what is wrong, 130 when interrupted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--scenes", type=Path, required=True, metavar="DIR", help="folder of the scenes' folders")
    add("--stages", help="comma-separated; all where not given")
    add("--seeds", type=int, default=3)
    add("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="trainings at a time")
    add("--lpips", nargs=2, metavar=("FILE.py", "WEIGHTS"), help="see perceptual.py")
    add("-o", "--out", type=Path, default=Path("runs/study"), metavar="DIR")
    args = parser.parse_args(arguments)
    try:
        stages = args.stages.split(",") if args.stages else None
        trainings = plan(args.scenes, args.out, stages, args.seeds)
        stop_at_once()
        failed = _train_all(trainings, args.jobs, args.lpips)
    except (OSError, ValueError) as error:
        print(f"study: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from the checkpoints", file=sys.stderr)
        return 130
    for folder in failed:
        print(f"failed: {folder} (see {folder / 'error.txt'})", file=sys.stderr)
    return 1 if failed else 0


def _train_all(trainings: list[Training], jobs: int, lpips: list[str] | None = None) -> list[Path]:
    done = {t.folder for t in trainings if finished(t.folder)}
    waiting = _batches([t for t in trainings if t.folder not in done])
    running: dict[Path, tuple[list[Training], subprocess.Popen[bytes]]] = {}
    failed: list[Path] = []
    total = sum(_iterations(t) for batch in waiting for t in batch)
    count = sum(map(len, waiting))
    bar = tqdm(total=total, unit="it", desc=f"{count} trainings", smoothing=0.02)
    try:
        while waiting or running:
            ready = [b for b in waiting if all(n in done for t in b for n in t.needs)]
            for batch in ready[: max(jobs - len(running), 0)]:
                waiting.remove(batch)
                running[batch[0].folder] = (batch, _start(batch, lpips))
            if not running:  # what the others need has failed
                failed += [t.folder for batch in waiting for t in batch]
                break
            time.sleep(POLL_SECONDS)
            for folder, (batch, process) in list(running.items()):
                if process.poll() is None:
                    continue
                del running[folder]
                bar.update(sum(map(_iterations, batch)))
                done |= {t.folder for t in batch if finished(t.folder)}
                failed += [t.folder for t in batch if t.folder not in done]
    except BaseException:
        for _, process in running.values():
            process.terminate()
        raise
    finally:
        bar.close()
    return failed


def _iterations(training: Training) -> int:
    """What a training costs: a branch runs from its switch on."""
    arm, total = STUDY_ARMS[training.spec.arm], training.spec.iterations
    return total if arm.trunk is None else total - round(arm.switch * total)


def _batches(trainings: list[Training]) -> list[list[Training]]:
    """Branches of one trunk share a process, since starting one costs as much as they do."""
    batches: dict[Path, list[Training]] = {}
    for training in trainings:
        batches.setdefault(training.trunk or training.folder, []).append(training)
    # A trunk's own training is not among its branches: it comes first.
    apart = []
    for key, batch in batches.items():
        own = [t for t in batch if t.folder == key]
        branches = [t for t in batch if t.folder != key]
        apart += [group for group in (own, branches) if group]
    return apart


def _start(batch: list[Training], lpips: list[str] | None) -> subprocess.Popen[bytes]:
    calls = [str(_write_call(training, lpips)) for training in batch]
    words = [sys.executable, str(Path(__file__).with_name("training.py")), *calls]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    with (batch[0].folder / "error.txt").open("wb") as errors:
        return subprocess.Popen(words, env=environment, stderr=errors, start_new_session=True)


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
