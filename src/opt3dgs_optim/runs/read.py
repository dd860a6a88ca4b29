"""Read a run log back: what the run finally kept, as columns."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from opt3dgs_optim.runs.lines import DEEPEST, NO_TEXT, START, text

Columns = dict[str, np.ndarray]
KINDS = ("start", "step", "evaluation", "event")
NON_FINITE = {"nan": float("nan"), "inf": float("inf"), "-inf": float("-inf")}


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
    line inside the file if a later session closed it off. The strings "nan", "inf" and "-inf"
    become floats. Lines past the iteration of a later "resumed" event are dropped.

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
        name=text(path.stem),
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
        except (ValueError, RecursionError) as error:
            after = whole[i + 1] if i + 1 < len(whole) else torn
            if after and (after.startswith(START) or START.startswith(after)):
                continue  # torn by a kill, closed off by the session that starts on the next line
            shown = raw[:60].decode("utf-8", "backslashreplace")
            what = "not a line of strict JSON" if isinstance(error, RecursionError) else error
            raise ValueError(f"{path}, line {i + 1}: {what}: {shown!a}") from None
    return lines


def _parse(raw: bytes) -> dict[str, Any]:
    try:
        line = json.loads(raw, parse_constant=_refuse_constant)
    except ValueError:  # among them UnicodeDecodeError, and integers of more than 4,300 digits
        raise ValueError("not a line of strict JSON") from None
    if not isinstance(line, dict) or line.get("kind") not in KINDS:
        raise ValueError(f"not a run-log line (an object with kind one of {KINDS})")
    line = _decode(line)
    iteration, seconds = line.get("iteration"), line.get("seconds")
    if type(iteration) is not int or not 0 <= iteration < 2**53:
        raise ValueError("iteration must be an integer >= 0, below 2**53")
    if type(seconds) not in (int, float) or not 0 <= seconds < 1e12:
        raise ValueError("seconds must be a number >= 0, below 1e12")
    if line["kind"] in ("step", "evaluation"):
        for key, value in line.items():
            if key not in ("kind", "phase") and not isinstance(value, (int, float)):
                raise ValueError(f"{key!a} must be a number")
    if line["kind"] == "event" and "event" not in line:
        raise ValueError("an event line without its event")
    if line["kind"] == "start" and not isinstance(line.get("metadata", {}), dict):
        raise ValueError("metadata must be an object")
    return line


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON")


def _decode(value: Any, depth: int = 0) -> Any:
    """`value` with its non-finite numbers; ValueError for what no report could show."""
    if depth > DEEPEST + 1:  # the line itself, and what `plain` allows in it
        raise ValueError(f"nested deeper than {DEEPEST}")
    if isinstance(value, str):
        if NO_TEXT.search(value):
            raise ValueError("text with NUL or with a lone surrogate")
        return NON_FINITE.get(value, value)
    if isinstance(value, int) and abs(value) >= 2**1023:
        raise ValueError("an integer that is no float64")
    if isinstance(value, list):
        return [_decode(item, depth + 1) for item in value]
    if isinstance(value, dict):
        _decode(list(value), depth)  # the keys
        return {key: _decode(item, depth + 1) for key, item in value.items()}
    return value


def _columns(lines: list[dict[str, Any]]) -> Columns:
    names = dict.fromkeys(key for line in lines for key in line if key not in ("kind", "phase"))
    names = dict.fromkeys(("iteration", "seconds", *names))
    nan = float("nan")
    columns = {name: np.array([line.get(name, nan) for line in lines], float) for name in names}
    columns["iteration"] = columns["iteration"].astype(np.int64)  # below 2**53: exact
    if any("phase" in line for line in lines):
        columns["phase"] = np.array([str(line.get("phase", "")) for line in lines], str)
    return columns
