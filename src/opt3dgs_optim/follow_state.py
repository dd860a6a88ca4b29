"""What a run is doing, by its log: the numbers of the live view."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from opt3dgs_optim.runread import Run, read_run

__all__ = ["Stamp", "Watched", "settled", "stamp_of", "watch"]

State = Literal["waiting", "running", "finished", "interrupted", "silent", "unreadable"]
Stamp = tuple[int, int, int]  # inode, size, time of the last write: any change shows
RECENT = 50  # step lines that a present value is the mean of
TOTALS = ("iterations", "total_steps", "max_steps")  # of the metadata


@dataclass(frozen=True)
class Watched:
    """A run log as it is now.

    Attributes:
        path: where it is, or will be.
        state: "waiting" for its first line; "running"; "finished" or "interrupted", if the last
            session said so; "silent" if it has written nothing for longer than it may;
            "unreadable".
        run: what it holds, if anything.
        detail: what is wrong with it, or "".
        quiet: seconds since it was written to.
    """

    path: Path
    state: State
    run: Run | None = None
    detail: str = ""
    quiet: float = 0.0

    @property
    def over(self) -> bool:
        """Whether nothing more is to be expected."""
        return self.state in ("finished", "silent")

    @property
    def label(self) -> str:
        """Arm and seed if the log tells them, else its path's last names."""
        about = {} if self.run is None else self.run.metadata
        if "arm" not in about:
            return "/".join(self.path.parts[-2:])
        return f"{about['arm']}, seed {about['seed']}" if "seed" in about else str(about["arm"])

    @property
    def iteration(self) -> int:
        """The last iteration logged; 0 before any."""
        return max((r["iteration"] for r in self.records), default=0)

    @property
    def seconds(self) -> float:
        """Run seconds at the last line."""
        return max((r["seconds"] for r in self.records), default=0.0)

    @property
    def records(self) -> list[dict[str, Any]]:
        """All lines kept."""
        return [] if self.run is None else self.run.records

    @property
    def total(self) -> int | None:
        """Iterations of the whole run, if its metadata tell."""
        about = {} if self.run is None else self.run.metadata
        found = [about[name] for name in TOTALS if type(about.get(name)) is int]
        return found[0] if found and found[0] > 0 else None

    @property
    def phase(self) -> str:
        """The last step's phase, or ""."""
        if self.run is None or "phase" not in self.run.steps:
            return ""
        return str(self.run.steps["phase"][-1])

    @property
    def rate(self) -> float | None:
        """Iterations per second over the last fifth of the step lines."""
        if self.run is None or len(self.run.steps["iteration"]) < 2:
            return None
        iteration, seconds = self.run.steps["iteration"], self.run.steps["seconds"]
        first = min(int(0.8 * len(iteration)), len(iteration) - 2)
        took = float(seconds[-1] - seconds[first])
        return float(iteration[-1] - iteration[first]) / took if took > 0 else None

    def present(self, name: str) -> float | None:
        """Mean of a logged number over the last steps; None where the last steps lack it."""
        if self.run is None or name not in self.run.steps:
            return None
        recent = self.run.steps[name][-RECENT:]
        finite = recent[np.isfinite(recent)]
        return float(finite.mean()) if len(finite) else None

    def evaluated(self, metric: str) -> float | None:
        """The last evaluation of a metric."""
        values = [] if self.run is None else self.run.series(metric)[2]
        return float(values[-1]) if len(values) else None


def stamp_of(path: Path) -> Stamp | None:
    """What changes when the file does; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns


def watch(path: Path, stamp: Stamp | None, patience: float) -> Watched:
    """Read the log of that stamp; `patience` are seconds of silence after which a run is over."""
    if stamp is None:
        return Watched(path, "waiting", detail="no such file yet")
    try:
        run = read_run(path)
    except (OSError, ValueError) as error:
        return settled(Watched(path, "unreadable", detail=str(error)), stamp, patience)
    return settled(Watched(path, _state(run), run), stamp, patience)


def settled(watched: Watched, stamp: Stamp, patience: float) -> Watched:
    """`watched`, unchanged in its file, as of now: it may have fallen silent."""
    quiet = max(0.0, time.time() - stamp[2] / 1e9)
    state = watched.state
    if state != "finished" and quiet > patience:
        state = "silent"
    return replace(watched, state=state, quiet=quiet)


def _state(run: Run) -> State:
    for record in reversed(run.records):
        event = record.get("event") if record["kind"] == "event" else None
        if event in ("finished", "interrupted"):
            return event
        if record["kind"] == "start" or event == "resumed":
            return "running"
    return "waiting"
