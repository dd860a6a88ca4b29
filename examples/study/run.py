"""Train everything that the study compares: python examples/study/run.py --scenes DIR --jobs 2

Resumable: Ctrl-C loses at most a twentieth of the trainings in progress, and the same command
goes on. `--stages core,tails` trains a part. `examples/study/report.py` turns the records into
tables, plots and the page.
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
from dataclasses import asdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tqdm import tqdm

from study.plan import Training, plan

POLL_SECONDS = 0.2
BRANCH_FILES = "at-*.pt"


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
    add("-o", "--out", type=Path, default=Path("runs/study"), metavar="DIR")
    args = parser.parse_args(arguments)
    try:
        stages = args.stages.split(",") if args.stages else None
        trainings = plan(args.scenes, args.out, stages, args.seeds)
        for kind in (signal.SIGINT, signal.SIGTERM):
            signal.signal(kind, signal.default_int_handler)
        failed = _train_all(trainings, args.jobs)
    except (OSError, ValueError) as error:
        print(f"study: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from the checkpoints", file=sys.stderr)
        return 130
    for folder in failed:
        print(f"failed: {folder} (see {folder / 'error.txt'})", file=sys.stderr)
    return 1 if failed else 0


def _train_all(trainings: list[Training], jobs: int) -> list[Path]:
    done = {t.folder for t in trainings if finished(t.folder)}
    waiting = [t for t in trainings if t.folder not in done]
    running: dict[Path, subprocess.Popen[bytes]] = {}
    failed: list[Path] = []
    total = sum(t.spec.iterations for t in waiting)
    bar = tqdm(total=total, unit="it", desc=f"{len(waiting)} trainings", smoothing=0.02)
    length = {t.folder: t.spec.iterations for t in trainings}
    try:
        while waiting or running:
            ready = [t for t in waiting if all(n in done for n in t.needs)]
            for training in ready[: max(jobs - len(running), 0)]:
                waiting.remove(training)
                running[training.folder] = _start(training)
            if not running and not ready:  # what they need has failed
                failed += [t.folder for t in waiting]
                break
            time.sleep(POLL_SECONDS)
            for folder, process in list(running.items()):
                code = process.poll()
                if code is None:
                    continue
                del running[folder]
                bar.update(length[folder])
                if code == 0:
                    done.add(folder)
                else:
                    failed.append(folder)
    except BaseException:
        for process in running.values():
            process.terminate()
        raise
    finally:
        bar.close()
    return failed


def _start(training: Training) -> subprocess.Popen[bytes]:
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
    }
    path = training.folder / "call.json"
    path.write_text(json.dumps(call), encoding="utf-8")
    words = [sys.executable, str(Path(__file__).with_name("training.py")), str(path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    with (training.folder / "error.txt").open("wb") as errors:
        return subprocess.Popen(words, env=environment, stderr=errors, start_new_session=True)


if __name__ == "__main__":
    raise SystemExit(main())
