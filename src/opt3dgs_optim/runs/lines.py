"""The lines of a run log, read as columns."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Columns = dict[str, np.ndarray]


@dataclass(frozen=True)
class Run:
    """One training run, without what a resume superseded.

    Attributes:
        name: the file's folder and name, without its ending: "garden/stock-0".
        metadata: what the trainer passed; a later session's entries win.
        origin: `time` (ISO, UTC) and `machine` of the first session.
        steps: columns of equal length over the step lines: `iteration` (int64), `seconds` and
            every logged number as float64, NaN where a line lacks it.
        evaluations: the same over the evaluation lines.
        records: all lines kept, in order, as dictionaries; they tell "logged as NaN" from "absent".
    """

    name: str
    metadata: dict[str, Any]
    origin: dict[str, Any]
    steps: Columns
    evaluations: Columns
    records: list[dict[str, Any]]

    def series(self, name: str, kind: str = "evaluation") -> tuple[np.ndarray, ...]:
        """(iteration, seconds, value) at the lines of `kind` that log the number `name`."""
        columns = _columns([r for r in self.records if r["kind"] == kind and name in r])
        return tuple(columns.get(key, np.array([])) for key in ("iteration", "seconds", name))


def read_run(path: str | os.PathLike[str]) -> Run:
    """Read the run log `path`.

    A last line without its newline (a kill, or a writer at work) is left out. Lines past the
    iteration at which a later session begins are dropped.

    Raises:
        OSError: the file cannot be read.
        ValueError: any other line that is no line of a run log; names the file and the line.
    """
    path = Path(path)
    starts: list[dict[str, Any]] = []
    records: list[dict[str, Any]] = []
    for i, raw in enumerate(path.read_bytes().split(b"\n")[:-1]):
        try:
            line = _parse(raw)
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path}, line {i + 1}: no line of a run log ({error!r:.80}): {raw[:60]!r}"
            ) from None
        if line["kind"] == "start":
            starts.append(line)
            records = [r for r in records if r["iteration"] <= line["iteration"]]
        records.append(line)
    return Run(
        name=f"{path.resolve().parent.name}/{path.stem}",
        metadata={key: item for line in starts for key, item in line.get("metadata", {}).items()},
        origin={key: starts[0].get(key) for key in ("time", "machine") if starts},
        steps=_columns([r for r in records if r["kind"] == "step"]),
        evaluations=_columns([r for r in records if r["kind"] == "evaluation"]),
        records=records,
    )


def _parse(raw: bytes) -> dict[str, Any]:
    """A line with all that its kind needs; whatever Python raises where it has not."""
    line = json.loads(raw)
    kind, iteration, seconds = line["kind"], line["iteration"], line["seconds"]
    if kind not in ("start", "step", "evaluation") or iteration != int(iteration) or seconds < 0:
        raise ValueError("kind, iteration or seconds")
    if kind != "start":
        for name in line.keys() - {"kind", "iteration"}:
            line[name] = float(line[name])  # of "nan", "inf" and "-inf", too
    return line


def _columns(lines: list[dict[str, Any]]) -> Columns:
    names = dict.fromkeys(["iteration", "seconds", *(key for line in lines for key in line)])
    columns = {
        name: np.array([line.get(name, np.nan) for line in lines], float)
        for name in names
        if name != "kind"
    }
    return columns | {"iteration": columns["iteration"].astype(np.int64)}
