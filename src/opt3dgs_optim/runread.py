"""Read a run log back: what the run finally kept, as columns."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from opt3dgs_optim.runfile import START

__all__ = ["Run", "read_run"]

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
            `phase` (str) and every logged value as float64, NaN where a line lacks it.
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
        return tuple(
            np.array([r[key] for r in lines], dtype=dtype)
            for key, dtype in (("iteration", np.int64), ("seconds", float), (name, float))
        )


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
        if line["kind"] == "event" and line.get("event") == "resumed":
            records = [r for r in records if r["iteration"] <= line["iteration"]]
        records.append(line)
    metadata: dict[str, Any] = {}
    for start in starts:
        metadata |= start.get("metadata", {})
    origin = {key: starts[0].get(key) for key in ("command", "time", "machine")} if starts else {}
    return Run(
        name=path.stem,
        metadata=metadata,
        origin=origin,
        steps=_columns([r for r in records if r["kind"] == "step"]),
        evaluations=_columns([r for r in records if r["kind"] == "evaluation"]),
        events=[r for r in records if r["kind"] == "event"],
        records=records,
    )


def _lines(path: Path) -> list[dict[str, Any]]:
    *whole, _torn = path.read_bytes().split(b"\n")
    lines = []
    for i, raw in enumerate(whole):
        try:
            lines.append(_parse(raw))
        except ValueError as error:
            after = whole[i + 1] if i + 1 < len(whole) else _torn
            if after and (after.startswith(START) or START.startswith(after)):
                continue  # torn by a kill, closed off by the session that starts on the next line
            raise ValueError(f"{path}, line {i + 1}: {error}") from None
    return lines


def _parse(raw: bytes) -> dict[str, Any]:
    try:
        line = json.loads(raw, parse_constant=_refuse_constant)
    except (ValueError, RecursionError):
        raise ValueError(f"not a line of strict JSON: {_shown(raw)}") from None
    if not isinstance(line, dict) or line.get("kind") not in KINDS:
        raise ValueError(f"not a run-log line (an object with kind one of {KINDS}): {_shown(raw)}")
    line = {key: _decode(value) for key, value in line.items()}
    if type(line.get("iteration")) is not int or type(line.get("seconds")) not in (int, float):
        raise ValueError(f"iteration must be an integer and seconds a number: {_shown(raw)}")
    if line["kind"] in ("step", "evaluation"):
        for key, value in line.items():
            if key not in ("kind", "phase") and not isinstance(value, (int, float)):
                raise ValueError(f"{key} must be a number: {_shown(raw)}")
    if line["kind"] == "event" and "event" not in line:
        raise ValueError(f"an event line without its event: {_shown(raw)}")
    if line["kind"] == "start" and not isinstance(line.get("metadata", {}), dict):
        raise ValueError(f"metadata must be an object: {_shown(raw)}")
    return line


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON")


def _shown(raw: bytes) -> str:
    text = raw.decode("utf-8", "backslashreplace")
    return repr(text if len(text) <= 60 else text[:57] + "...")


def _decode(value: Any) -> Any:
    if isinstance(value, str):
        return NON_FINITE.get(value, value)
    if isinstance(value, list):
        return [_decode(item) for item in value]
    if isinstance(value, dict):
        return {key: _decode(item) for key, item in value.items()}
    return value


def _columns(lines: list[dict[str, Any]]) -> Columns:
    names = dict.fromkeys(key for line in lines for key in line if key not in ("kind", "phase"))
    nan = float("nan")
    columns = {name: np.array([line.get(name, nan) for line in lines], float) for name in names}
    columns["iteration"] = np.array([line["iteration"] for line in lines], np.int64)
    columns["seconds"] = np.array([line["seconds"] for line in lines], float)
    if any("phase" in line for line in lines):
        columns["phase"] = np.array([str(line.get("phase", "")) for line in lines], str)
    return columns
