"""The lines of a run log: JSON objects, written whole, and read as columns."""

import json
import math
import numbers
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

RESUMED = "resumed"  # the event that says where a run goes on
KINDS = ("start", "step", "evaluation", "event")

Columns = dict[str, np.ndarray]


def encoded(value: Any) -> str:
    """`value` as strict JSON, NaN and infinities as strings; TypeError if JSON cannot hold it."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False, default=_plain)
    except ValueError:  # a number that is not finite
        loose = json.dumps(value, default=_plain)
        return encoded(json.loads(loose, parse_constant=lambda name: str(float(name))))


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return number("RunLog", "metadata or event", value)


def number(call: str, name: str, value: Any) -> float | int:
    """A number of Python or numpy, or that in a tensor or array of one element, on the host.

    Raises:
        TypeError: it is none.
        ValueError: a tensor of another number of elements.
    """
    if hasattr(value, "item") and hasattr(value, "shape"):
        if math.prod(value.shape) != 1:
            raise ValueError(
                f"{call}({name}=tensor of {tuple(value.shape)}): must have one element"
            )
        value = value.item()
    if not isinstance(value, numbers.Real):
        raise TypeError(f"{call}({name}={value!r}): must be a number or a one-element tensor")
    return value if isinstance(value, int) else float(value)


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
        columns = _columns([r for r in self.records if r["kind"] == kind and name in r])
        return tuple(columns.get(key, np.array([])) for key in ("iteration", "seconds", name))


def read_run(path: str | os.PathLike[str]) -> Run:
    """Read the run log `path`.

    A last line without its newline (a kill, or a writer at work) is left out. Lines past the
    iteration of a later "resumed" event are dropped.

    Raises:
        OSError: the file cannot be read.
        ValueError: any other line that is no line of a run log; names the file and the line.
    """
    path, starts = Path(path), []
    records: list[dict[str, Any]] = []
    for i, raw in enumerate(path.read_bytes().split(b"\n")[:-1]):
        try:
            line = _parse(raw)
        except (ValueError, KeyError, TypeError, ArithmeticError) as error:
            shown = raw[:60].decode("utf-8", "backslashreplace")
            raise ValueError(
                f"{path}, line {i + 1}: no line of a run log ({type(error).__name__}, "
                f"{str(error)[:80]}): {shown!a}"
            ) from None
        if line["kind"] == "start":
            starts.append(line)
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


def _parse(raw: bytes) -> dict[str, Any]:
    """A line with all that its kind needs; whatever Python raises where it has not."""
    line = json.loads(raw)
    if line["kind"] not in KINDS or (line["kind"] == "event" and not line["event"]):
        raise ValueError(f"kind must be one of {KINDS}, and an event must have a name")
    if not (type(line["iteration"]) is int and line["iteration"] >= 0 <= line["seconds"]):
        raise ValueError("iteration must be an integer >= 0, and seconds a number >= 0")
    if line["kind"] in ("step", "evaluation"):
        for name in line.keys() - {"kind", "phase", "iteration"}:
            line[name] = float(line[name])  # of "nan", "inf" and "-inf", too
    return line


def _columns(lines: list[dict[str, Any]]) -> Columns:
    names = dict.fromkeys(key for line in lines for key in line if key not in ("kind", "phase"))
    names = dict.fromkeys(("iteration", "seconds", *names))
    columns = {name: np.array([line.get(name, np.nan) for line in lines], float) for name in names}
    columns["iteration"] = columns["iteration"].astype(np.int64)
    if any("phase" in line for line in lines):
        columns["phase"] = np.array([str(line.get("phase", "")) for line in lines], str)
    return columns
