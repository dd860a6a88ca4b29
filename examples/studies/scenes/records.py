"""The study's records: gathered from the trainings' folders into two committed files.

`records.jsonl` has the trainings of open questions, one a line. `archive.jsonl.xz` has all others,
compressed: those of arms that are no longer trained, and those of fixed held-out views. The first
line of both names the columns of the curves.
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).resolve().parents[3] / "docs" / "results" / "study"  # what is committed
RECORDS, ARCHIVE, COSTS = "records.jsonl", "archive.jsonl.xz", "costs.json"
MEASURED = ("iteration", "seconds", "psnr", "ssim", "train_psnr", "num_points")  # in all records
COLUMNS = (
    *MEASURED,
    *("lpips", "relocated", "median_scale", "median_opacity", "visible_share"),
)
ABOUT = ("mean_nu", "state_bytes", "peak_rss_bytes", "machine", "date")  # beside setting and curve
# What arms were called in the folders of trainings made before 2026-11-25.
OLD_NAMES = {
    "averaged@1/30": "mcmc+averaged",
    "adc+defaults-but-scales": "adc+annealed+faded-but-scales",
    "adc+defaults-but-scales+averaged": "adc+annealed+faded-but-scales+averaged",
}

# Records of bonsai from before `register.py` posed it anew, which is what `bonsai` is now.
RIGHT, MISPOSED = "bonsai", "bonsai-misposed"

COSTED = ("scene", "size", "iterations", "tiled", "sh_degree")  # what a cost is measured for
Costs = dict[tuple[Any, ...], float]  # these of a `Setting`, and the arm -> share of stock's
Plain = dict[str, Any]  # a record as it is in the files


@dataclass(frozen=True, order=True)
class Setting:
    """What two trainings must share to be compared."""

    scene: str
    points: int  # the most Gaussians
    iterations: int
    init: str
    sh_degree: int = 0
    rotated: bool = False  # the seed says which views are held out
    size: str = "images_4"  # folder of the photos
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

    def at_iteration(self, iteration: float, metric: str = "psnr") -> float:
        """A metric at that iteration, linear between evaluations."""
        return float(np.interp(iteration, self.curve["iteration"], self.curve[metric]))

    def reached(self, psnr: float) -> float | None:
        """The iteration at which the test PSNR first has that value, interpolated; None: never."""
        values, times = self.curve["psnr"], self.curve["iteration"]
        reached = np.flatnonzero(values >= psnr)
        if not len(reached):
            return None
        i = int(reached[0])
        if i == 0:
            return float(times[0])
        share = (psnr - values[i - 1]) / (values[i] - values[i - 1])
        return float(times[i - 1] + share * (times[i] - times[i - 1]))


def gather(folder: Path) -> list[Plain]:
    """The finished trainings under a folder of `run.py`, as plain data."""
    found = []
    for path in sorted(folder.rglob("record.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        if record.get("finished"):
            setting = Setting(
                **{f.name: record[f.name] for f in fields(Setting) if f.name in record}
            )
            arm = OLD_NAMES.get(record["arm"], record["arm"])
            curve = [[row.get(name) for name in COLUMNS] for row in record["curve"]]
            about = {name: record[name] for name in ABOUT}
            found.append(
                {**asdict(setting), "arm": arm, "seed": record["seed"], **about, "curve": curve}
            )
    return found


def merge(old: Iterable[Plain], new: Iterable[Plain]) -> list[Plain]:
    """All of both, in a fixed order; a training that both have is the new one."""
    keys = (*(f.name for f in fields(Setting)), "arm", "seed")
    kept = {tuple(record[key] for key in keys): record for record in (*old, *new)}
    return [kept[key] for key in sorted(kept)]


def load(folder: Path) -> list[Plain]:
    """The records of a folder, open and archived, as plain data."""
    found: list[Plain] = []
    for path in (folder / ARCHIVE, folder / RECORDS):
        if path.exists():
            data = path.read_bytes()
            text = (lzma.decompress(data) if path.name == ARCHIVE else data).decode("utf-8")
            head, *lines = text.splitlines()
            columns = json.loads(head).get("columns")
            if columns != list(COLUMNS):
                raise ValueError(f"{path}: columns {columns}, but {list(COLUMNS)} are needed")
            found += map(json.loads, lines)
    return found


def write(records: Iterable[Plain], folder: Path, is_open: Callable[[Plain], bool]) -> None:
    """Both files; one that would not change is left alone, whatever compressed it.

    Args:
        is_open: whether a record belongs to an open question.
    """
    parts: dict[str, list[str]] = {
        name: [json.dumps({"columns": COLUMNS})] for name in (RECORDS, ARCHIVE)
    }
    for record in records:
        parts[RECORDS if is_open(record) else ARCHIVE].append(json.dumps(record))
    for name, lines in parts.items():
        path, data = folder / name, ("\n".join(lines) + "\n").encode()
        if name == RECORDS:
            path.write_bytes(data)
        elif not path.exists() or lzma.decompress(path.read_bytes()) != data:
            path.write_bytes(lzma.compress(data, preset=9))


def read(folder: Path) -> list[Record]:
    """The records of a folder, open and archived."""
    return [_record(entry) for entry in load(folder)]


def _record(entry: Plain) -> Record:
    table = np.array(entry["curve"], dtype=float)
    return Record(
        Setting(**{f.name: entry[f.name] for f in fields(Setting)}),
        entry["arm"],
        entry["seed"],
        {name: table[:, i] for i, name in enumerate(COLUMNS)},
        **{name: entry[name] for name in ABOUT},
    )


def read_costs(path: Path) -> Costs:
    """What an iteration costs, as `costs.py` measured it; empty where it was not."""
    entries = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    return {(*costed(e), arm): share for e in entries for arm, share in e["shares"].items()}


def costed(entry: Mapping[str, Any]) -> tuple[Any, ...]:
    """`COSTED` of a record or a measured cost; older ones lack what they were not asked."""
    return tuple(entry.get(name, 0) for name in COSTED)
