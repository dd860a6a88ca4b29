"""Run pilots side by side, with one progress bar."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from advising.pilots import Pilot, PilotOptions, steps_of, train

POLL_SECONDS = 0.2
Job = tuple[Pilot, PilotOptions, Path, "float | None"]
_shared: list[Any] = []  # of a worker: the number of iterations of all workers


def train_all(jobs: Sequence[Job], workers: int, what: str) -> None:
    """Train every job; an interruption stops the workers, and what is finished stays."""
    if not jobs:
        return
    total = sum(steps_of(pilot, options) for pilot, options, *_ in jobs)
    with tqdm(total=total, unit="it", desc=what, smoothing=0.05) as bar:
        if workers == 1:
            for job in jobs:
                train(*job, count=bar.update)
        else:
            _train_side_by_side(jobs, min(workers, len(jobs)), bar)


def _train_side_by_side(jobs: Sequence[Job], workers: int, bar: Any) -> None:
    # One thread each: trainings side by side share the cores, and their times stay comparable.
    os.environ.update({"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"})
    context = multiprocessing.get_context("spawn")
    steps = context.Value("q", 0)
    # Ctrl-C reaches the workers too; what is ignored here they ignore from their very start.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        pool = context.Pool(workers, _start, (steps,))
    finally:
        signal.signal(signal.SIGINT, before)
    with pool:
        running = pool.map_async(_train, jobs, chunksize=1)
        while not running.ready():
            time.sleep(POLL_SECONDS)
            if steps.value > bar.n:
                bar.update(steps.value - bar.n)
        running.get()
    bar.update(bar.total - bar.n)


def _start(steps: Any) -> None:
    _shared.append(steps)


def _train(job: Job) -> None:
    train(*job, count=_count)


def _count(steps: int) -> None:
    with _shared[0].get_lock():
        _shared[0].value += steps
