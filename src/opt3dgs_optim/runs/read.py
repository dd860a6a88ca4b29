"""Read a run log back: what the run finally kept, as columns."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from opt3dgs_optim.runs.lines import START

Columns = dict[str, np.ndarray]
KINDS = ("start", "step", "evaluation", "event")


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
    starts, records = [], []
    for line in _lines(path):
        if line["kind"] == "start":
            starts.append(line)
        if line["kind"] == "event" and line["event"] == "resumed":
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
    if kind not in KINDS or not isinstance(line.get("metadata", {}), dict):
        raise ValueError(f"kind must be one of {KINDS}, and metadata an object")
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
    nan = float("nan")
    columns = {name: np.array([line.get(name, nan) for line in lines], float) for name in names}
    columns["iteration"] = columns["iteration"].astype(np.int64)  # below 2**53: exact
    if any("phase" in line for line in lines):
        columns["phase"] = np.array([str(line.get("phase", "")) for line in lines], str)
    return columns
