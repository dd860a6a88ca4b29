"""Trainings side by side, each a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from signal import SIGINT
from typing import BinaryIO, TypeVar

POLL_SECONDS = 0.2
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
# glibc keeps what is freed. By default it gives the buffers of an iteration back to the system, and
# with 200,000 Gaussians a fifth of the time goes into getting them again, page by page.
KEPT_MEMORY = {
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "4000000000",
    "MALLOC_TOP_PAD_": "500000000",
}
Job = TypeVar("Job")


def start(words: list[str], stderr: BinaryIO | None = None) -> subprocess.Popen[bytes]:
    """A Python process with one thread: side by side they share the cores, and stay comparable.

    A session of its own: Ctrl-C reaches this process alone, which passes it on once.
    """
    environment = {**os.environ, **ONE_THREAD, **KEPT_MEMORY}
    command = [sys.executable, *words]
    return subprocess.Popen(command, env=environment, stderr=stderr, start_new_session=True)


def side_by_side(
    waiting: list[Job],
    count: int,
    may_start: Callable[[Job], bool],
    begin: Callable[[Job], subprocess.Popen[bytes]],
    ended: Callable[[Job, int], None],
    look: Callable[[list[Job]], None] = lambda _running: None,
) -> None:
    """Begin what may start, `count` at a time; return when nothing runs and nothing may start.

    Args:
        waiting: what has begun is taken out of it.
        ended: called with the exit code.
        look: called with what is running, several times a second.
    """
    running: list[tuple[Job, subprocess.Popen[bytes]]] = []
    try:
        while True:
            ready = [job for job in waiting if may_start(job)]
            for job in ready[: max(count - len(running), 0)]:
                waiting.remove(job)
                running.append((job, begin(job)))
            if not running:
                return
            time.sleep(POLL_SECONDS)
            for job, process in list(running):
                code = process.poll()
                if code is not None:
                    running.remove((job, process))
                    ended(job, code)
            look([job for job, _ in running])
    finally:  # ask each that is left for a checkpoint, and wait for it
        for _, process in running:
            process.send_signal(SIGINT)
        for _, process in running:
            process.wait()
