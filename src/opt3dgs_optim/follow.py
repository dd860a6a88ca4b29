"""Watch runs while they train: `python -m opt3dgs_optim report --follow RUN... -o DIR`.

Redraws `live.html`, one file that opens offline, and `live.png` while the training writes its log.
A run may not have begun, may be killed and resumed, or be cut off in its last line. It ends by
itself when all runs have logged "finished", or have been silent for longer than `--patience`.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from opt3dgs_optim._status import StatusLine
from opt3dgs_optim.follow_page import page
from opt3dgs_optim.follow_plot import draw_live
from opt3dgs_optim.follow_state import Stamp, Watched, settled, stamp_of, watch
from opt3dgs_optim.runread import Run

__all__ = ["Follower", "follow"]

GRACE = 30.0  # seconds in which a folder's next run may begin after the last one has ended
NO_MATPLOTLIB = "No picture, since matplotlib is not installed: pip install 'opt3dgs_optim[report]'"
NOTHING_YET = "Nothing to draw yet."
EMPTY = Run("", {}, {}, {}, {}, [], [])


class Follower:
    """Reads the logs anew where they have changed, and writes the page.

    Args:
        paths: run logs or folders of them; they need not exist yet.
        out: folder to write into.
        metric: of the first panel.
        every: seconds between looks, as the page is told.
        patience: seconds without a new line after which a run counts as over.
    """

    def __init__(
        self, paths: Sequence[str | Path], out: Path, metric: str, every: float, patience: float
    ) -> None:
        self.paths = [Path(path) for path in paths]
        self.out, self.metric, self.every, self.patience = out, metric, every, patience
        self.runs: list[Watched] = []
        self._stamps: dict[Path, Stamp | None] = {}
        self._known: dict[Path, Watched] = {}
        self._pictures = (b"", b"")
        self._note = NOTHING_YET

    @property
    def over(self) -> bool:
        """Whether no run is expected to go on."""
        return bool(self.runs) and all(run.over for run in self.runs)

    def look(self) -> bool:
        """Read what has changed; whether anything has."""
        before = [(run.path, run.state) for run in self.runs]
        changed = False
        self.runs = []
        for path in self._logs():
            stamp = stamp_of(path)
            if path not in self._known or stamp != self._stamps.get(path):
                changed = True
                self._known[path] = watch(path, stamp, self.patience)
                self._stamps[path] = stamp
            elif stamp is not None:
                self._known[path] = settled(self._known[path], stamp, self.patience)
            self.runs.append(self._known[path])
        return changed or before != [(run.path, run.state) for run in self.runs]

    def _logs(self) -> list[Path]:
        """The logs there are, and the paths where nothing is yet; each file once."""
        found: dict[Path, Path] = {}
        for path in self.paths:
            logs = sorted(path.rglob("*.jsonl")) if path.is_dir() else [path]
            for log in logs or [path / "*.jsonl"]:
                found.setdefault(log.resolve(), log)
        return list(found.values())

    def draw(self) -> None:
        """Draw the pictures anew."""
        labels = [run.label for run in self.runs]
        runs = [run.run or EMPTY for run in self.runs]  # which keeps its colour for later
        try:
            wide, narrow = (
                draw_live(labels, runs, self.metric, narrow=narrow) for narrow in (False, True)
            )
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] != "matplotlib":
                raise
            self._note = NO_MATPLOTLIB
            return
        self._pictures = wide, narrow

    def write(self, *, last: bool = False) -> None:
        """Write the page and the picture; the last page does not reload."""
        self.out.mkdir(parents=True, exist_ok=True)
        every = None if last else self.every
        text = page(self.runs, self.metric, self._pictures, every=every, note=self._note)
        _replace(self.out / "live.html", text.encode())
        if self._pictures[0]:
            _replace(self.out / "live.png", self._pictures[0])


def follow(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    metric: str = "psnr",
    every: float = 10.0,
    patience: float = 900.0,
    grace: float = GRACE,
) -> int:
    """Watch until all runs are over: 0; or until Ctrl-C or a termination signal: 130.

    Either way the last page stays, and no longer reloads. After the last run of a folder has
    ended, `grace` seconds are left for another one to begin there.

    Raises:
        OSError: `out` cannot be written.
    """
    follower = Follower(paths, Path(out), metric, every, patience)
    status = StatusLine()
    since: float | None = None  # all over, since
    with _stop_asked() as stop:
        try:
            while not stop.is_set():
                if follower.look() or not follower.runs:
                    follower.draw()
                    since = None
                follower.write()
                status.show(f"{follower.out / 'live.html'}: {_summary(follower.runs)}")
                if follower.over:
                    since = time.monotonic() if since is None else since
                    left = since + (grace if _has_folder(follower) else 0.0) - time.monotonic()
                    if left <= 0:
                        return 0
                    stop.wait(min(every, left))
                else:
                    stop.wait(every)
            return 130
        finally:
            status.clear()
            follower.write(last=True)


def _has_folder(follower: Follower) -> bool:
    return any(path.is_dir() for path in follower.paths)


def _summary(runs: Sequence[Watched]) -> str:
    return "; ".join(f"{run.label}: {run.state}, {run.iteration:,}" for run in runs)


def _replace(path: Path, data: bytes) -> None:
    """Write a file as a whole: a browser that reads it meanwhile gets the old one."""
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    partial.write_bytes(data)
    os.replace(partial, path)


@contextmanager
def _stop_asked() -> Iterator[threading.Event]:
    """An event that Ctrl-C and a termination signal set, in a shell's background job too."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(_kind: int, _frame: Any) -> None:
        stop.set()

    old = {kind: signal.signal(kind, ask) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for kind, handler in old.items():
            signal.signal(kind, handler)
