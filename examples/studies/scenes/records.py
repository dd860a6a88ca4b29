"""The study's records: gathered from the trainings' folders into one committed JSON file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).resolve().parents[3] / "docs" / "results" / "study"  # what is committed
COSTS = FOLDER / "costs.json"
MEASURED = ("iteration", "seconds", "psnr", "ssim", "train_psnr", "num_points")  # in all records
COLUMNS = (*MEASURED, "lpips", "relocated", "median_scale", "median_opacity", "visible_share")

COSTED = ("scene", "size", "iterations", "tiled", "sh_degree")  # what a cost is measured for
Costs = dict[tuple[Any, ...], float]  # these of a `Setting`, and the arm -> share of stock's


@dataclass(frozen=True)
class Setting:
    """What two trainings must share to be compared."""

    scene: str
    points: int
    iterations: int
    init: str
    sh_degree: int = 0
    rotated: bool = False  # the seed says which views are held out
    size: str = "images_4"
    views: int = 0  # trained on; 0: all
    rates: float = 1.0  # factor on the trainer's learning rates
    tiled: int = 0  # every view was cut into so many


@dataclass(frozen=True)
class Record:
    """A finished training."""

    setting: Setting
    arm: str
    seed: int
    curve: dict[str, np.ndarray]  # column -> [evaluations]
    mean_nu: float | None
    state_bytes: int
    peak_rss_bytes: int
    lpips: float | None
    machine: str
    date: str  # the training's last day, YYYY-MM-DD, UTC

    @property
    def seconds(self) -> float:
        """CPU seconds of the training, evaluations not counted."""
        return float(self.curve["seconds"][-1])

    @property
    def final(self) -> float:
        """Test PSNR after the last iteration, dB."""
        return float(self.curve["psnr"][-1])

    def at_seconds(self, seconds: float) -> float:
        """Test PSNR at that time, dB, linear between evaluations; the last one beyond the end."""
        return float(np.interp(seconds, self.curve["seconds"], self.curve["psnr"]))

    def at_iteration(self, iteration: float, metric: str = "psnr") -> float:
        """A metric at that iteration, linear between evaluations."""
        return float(np.interp(iteration, self.curve["iteration"], self.curve[metric]))

    def reached(self, psnr: float, column: str = "iteration") -> float | None:
        """When the test PSNR first reaches that value, interpolated; None if it never does."""
        values, times = self.curve["psnr"], self.curve[column]
        reached = np.flatnonzero(values >= psnr)
        if not len(reached):
            return None
        i = int(reached[0])
        if i == 0:
            return float(times[0])
        share = (psnr - values[i - 1]) / (values[i] - values[i - 1])
        return float(times[i - 1] + share * (times[i] - times[i - 1]))


def gather(folder: Path) -> list[dict[str, Any]]:
    """The finished trainings under a folder, as plain data, in a fixed order."""
    found = []
    for path in sorted(folder.rglob("record.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        if record.get("finished"):
            del record["finished"]
            if record.get("size") == "small":  # its name in the first trainings at 30,000
                record["size"] = "images_4"
            record["curve"] = [[row.get(name) for name in COLUMNS] for row in record["curve"]]
            found.append(record)
    return found


def merge(old: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """All of both; a training that both have is the new one."""
    optional = {field.name: field.default for field in fields(Setting)}
    keys = (*optional, "arm", "seed")
    kept = {tuple(r.get(k, optional.get(k)) for k in keys): r for r in (*old, *new)}
    return [kept[key] for key in sorted(kept)]


def write(records: list[dict[str, Any]], path: Path) -> None:
    """One line per training, so that a change shows as the trainings that changed."""
    for record in records:  # older ones have fewer columns
        record["curve"] = [row + [None] * (len(COLUMNS) - len(row)) for row in record["curve"]]
    lines = ",\n".join(json.dumps(record) for record in records)
    columns = json.dumps(COLUMNS)
    path.write_text(f'{{"columns": {columns},\n"records": [\n{lines}\n]}}\n', encoding="utf-8")


def read(path: Path) -> list[Record]:
    """The records of a committed file."""
    data = json.loads(path.read_text(encoding="utf-8"))
    columns = data.get("columns", [])
    if not set(MEASURED) <= set(columns):
        raise ValueError(f"{path}: columns {columns}, but {list(MEASURED)} are needed")
    return [_record(entry, columns) for entry in data["records"]]


def _record(entry: dict[str, Any], columns: list[str]) -> Record:
    table = np.array(entry["curve"], dtype=float)
    return Record(
        Setting(**{f.name: entry[f.name] for f in fields(Setting) if f.name in entry}),
        entry["arm"],
        entry["seed"],
        {name: table[:, i] for i, name in enumerate(columns)},
        entry["mean_nu"],
        entry["state_bytes"],
        entry["peak_rss_bytes"],
        entry.get("lpips"),
        entry["machine"],
        entry["date"],
    )


def read_costs(path: Path) -> Costs:
    """What an iteration costs, as `costs.py` measured it; empty where it was not."""
    entries = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    return {(*costed(e), arm): share for e in entries for arm, share in e["shares"].items()}


def costed(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    """`COSTED` of a record or a measured cost; older ones lack what they were not asked."""
    return tuple(entry.get(name, 0) for name in COSTED)
