"""The lines of a run log: JSON, appended whole by one writer at a time, and read as columns."""

import contextlib
import json
import math
import numbers
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

START = b'{"kind":"start"'  # how the first line of every session begins
RESUMED = "resumed"  # the event that says where a run goes on
KINDS = ("start", "step", "evaluation", "event")

Columns = dict[str, np.ndarray]


class LineFile:
    """An append-only file of lines, locked against a second writer where files can be locked.

    Raises:
        BlockingIOError: the file is open in another LineFile, here or in another process.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 - closed by close()
        try:
            if fcntl is not None:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise BlockingIOError(
                f"RunLog({str(self.path)!r}): another RunLog is writing this file; close that one "
                "or give each run its own path"
            ) from None
        except OSError:  # a file system without locks: nothing to check with
            pass

    @property
    def closed(self) -> bool:
        return self._file.closed

    def append(self, line: Mapping[str, Any]) -> None:
        """Write one line in one system call (more only if the kernel cuts it short), or nothing."""
        data = encoded(line).encode() + b"\n"
        if data.startswith(START) and self.path.read_bytes()[-1:] not in (b"", b"\n"):
            data = b"\n" + data  # the last session was killed within a line
        rest, size = memoryview(data), os.fstat(self._file.fileno()).st_size
        try:
            while rest:
                rest = rest[self._file.write(rest) or 0 :]
        except OSError as error:  # a full disk: half a line would make the file no run log
            with contextlib.suppress(OSError):
                self._file.truncate(size)
            raise OSError(
                error.errno, f"RunLog: a line cannot be written: {error.strerror}", str(self.path)
            ) from None

    def close(self) -> None:
        """Release the file; a data loader that was forked meanwhile shares the lock."""
        if fcntl and not self._file.closed:
            with contextlib.suppress(OSError):
                fcntl.flock(self._file, fcntl.LOCK_UN)
        self._file.close()


def encoded(value: Any) -> str:
    """`value` as strict JSON, NaN and infinities as strings; TypeError if JSON cannot hold it."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False, default=_plain)
    except ValueError:  # a number that is not finite
        loose = json.dumps(value, default=_plain)
        return encoded(json.loads(loose, parse_constant=lambda name: str(float(name))))


def with_plain_keys(value: Any) -> Any:
    """`value` with numpy's numbers as keys of mappings made Python's, which JSON turns to text."""
    if isinstance(value, Mapping):
        ours = (np.number, np.bool_)
        return {
            number("RunLog", "key", key) if isinstance(key, ours) else key: with_plain_keys(item)
            for key, item in value.items()
        }
    if isinstance(value, (list, tuple)):
        return [with_plain_keys(item) for item in value]
    return value


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return number("RunLog", "metadata or event", value)


def number(call: str, name: str, value: Any) -> float | int:
    """A number of Python or numpy, or that in a tensor or array of one element, on the host.

    Raises:
        TypeError: it is none.
        ValueError: a tensor of another number of elements, or a number beyond float64.
    """
    if hasattr(value, "item") and hasattr(value, "shape"):
        if math.prod(value.shape) != 1:
            raise ValueError(
                f"{call}({name}=tensor of {tuple(value.shape)}): must have one element"
            )
        value = value.item()
    if not isinstance(value, numbers.Real):
        raise TypeError(f"{call}({name}={value!r}): must be a number or a one-element tensor")
    try:
        as_float = float(value)
    except OverflowError:  # no reader of the log could take it as a number
        raise ValueError(f"{call}({name}={value!r:.40}...): must be in float64's range") from None
    return value if isinstance(value, int) else as_float


@dataclass(frozen=True)
class Run:
    """One training run, without what a resume superseded.

    Attributes:
        name: the file's name without its ending.
        metadata: what the trainer passed; a later session's entries win.
        origin: `command`, `time` (ISO, UTC) and `machine` of the first session.
        steps: columns of equal length over the step lines: `iteration` (int64), `seconds`,
            `phase` (str, "" where a line has none) and every logged value as float64, NaN where
            a line lacks it.
        evaluations: the same over the evaluation lines, without `phase`.
        events: the event lines, as dictionaries with `event`, `iteration`, `seconds`.
        records: all lines kept, in order, as dictionaries; tells "logged as NaN" from "absent".
    """

    name: str
    metadata: dict[str, Any]
    origin: dict[str, Any]
    steps: Columns
    evaluations: Columns
    events: list[dict[str, Any]]
    records: list[dict[str, Any]]

    def series(self, name: str, kind: str = "evaluation") -> tuple[np.ndarray, ...]:
        """(iteration, seconds, value) at the lines of `kind` that log the number `name`."""
        lines = [r for r in self.records if r["kind"] == kind and name in r]
        columns = _columns(lines)
        return tuple(columns.get(key, np.array([])) for key in ("iteration", "seconds", name))


def read_run(path: str | os.PathLike[str]) -> Run:
    """Read the run log `path`.

    A last line without its newline (a kill, or a writer at work) is left out, and so is such a
    line inside the file if a later session closed it off. Lines past the iteration of a later
    "resumed" event are dropped.

    Raises:
        OSError: the file cannot be read.
        ValueError: any other line that is no line of a run log; names the file and the line.
    """
    path = Path(path)
    lines, records = _lines(path), []
    starts = [line for line in lines if line["kind"] == "start"]
    for line in lines:
        if line["kind"] == "event" and line["event"] == RESUMED:
            records = [r for r in records if r["iteration"] <= line["iteration"]]
        records.append(line)
    return Run(
        name=path.stem,
        metadata={key: item for line in starts for key, item in line.get("metadata", {}).items()},
        origin={key: starts[0].get(key) for key in ("command", "time", "machine") if starts},
        steps=_columns([r for r in records if r["kind"] == "step"]),
        evaluations=_columns([r for r in records if r["kind"] == "evaluation"]),
        events=[r for r in records if r["kind"] == "event"],
        records=records,
    )


def _lines(path: Path) -> list[dict[str, Any]]:
    *whole, torn = path.read_bytes().split(b"\n")
    lines = []
    if torn and not whole and not (torn.startswith(START) or START.startswith(torn)):
        raise ValueError(f"{path}, line 1: no line of a run log: {torn[:60]!r}")
    for i, raw in enumerate(whole):
        try:
            lines.append(_parse(raw))
        except (ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
            after = whole[i + 1] if i + 1 < len(whole) else torn
            if after and (after.startswith(START) or START.startswith(after)):
                continue  # torn by a kill, closed off by the session that starts on the next line
            shown = raw[:60].decode("utf-8", "backslashreplace")
            what = f"{type(error).__name__}, {str(error)[:80]}"
            raise ValueError(
                f"{path}, line {i + 1}: no line of a run log ({what}): {shown!a}"
            ) from None
    return lines


def _parse(raw: bytes) -> dict[str, Any]:
    """A line with all that its kind needs; whatever Python raises where it has not."""
    line = json.loads(raw)
    kind, iteration, seconds = line["kind"], line["iteration"], line["seconds"]
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {KINDS}")
    if kind == "start" and not isinstance(line.get("metadata", {}), dict):
        raise ValueError("metadata must be an object")
    if type(iteration) is not int or not (0 <= iteration < 2**53 and 0 <= seconds < 1e12):
        raise ValueError("iteration must be an integer >= 0, and seconds a number >= 0")
    if kind == "event":
        line["event"]  # or a KeyError
    if kind in ("step", "evaluation"):
        for name in line.keys() - {"kind", "phase", "iteration"}:
            line[name] = float(line[name])  # of "nan", "inf" and "-inf", too
    return line


def _columns(lines: list[dict[str, Any]]) -> Columns:
    names = dict.fromkeys(key for line in lines for key in line if key not in ("kind", "phase"))
    names = dict.fromkeys(("iteration", "seconds", *names))
    columns = {name: np.array([line.get(name, np.nan) for line in lines], float) for name in names}
    columns["iteration"] = columns["iteration"].astype(np.int64)  # below 2**53: exact
    if any("phase" in line for line in lines):
        columns["phase"] = np.array([str(line.get("phase", "")) for line in lines], str)
    return columns
