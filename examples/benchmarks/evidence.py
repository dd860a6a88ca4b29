"""The file of evidence, one line a training: add finished ones, read them all.

    python examples/benchmarks/evidence.py RECORD.json...     (those that train.py has left)

A line has what was trained (scene, size of the photos, density control, arm, iterations, points,
sh_degree, seed), what came of it on views that were held out (psnr, ssim, lpips) and of some that
were not (train_psnr), how many Gaussians there were at the end, CPU or GPU seconds, device, date
and command. What is not in a line is as usual, see `USUAL`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

FILE = Path(__file__).resolve().parents[2] / "docs" / "results" / "evidence.jsonl"
DENSITIES = RELOCATION, SPLIT = ("relocation", "clone-and-split")
TRAINED = ("scene", "size", "density", "arm", "iterations", "points", "sh_degree", "seed")
# `rotated`: the seed says which views are held out. `views`: trained on, 0 is all of them.
# `threshold`: factor on that of clone and split. `host`: whose own script trained, see
# simple_trainer.py.
USUAL = {"rotated": True, "views": 0, "threshold": 1.0, "host": ""}
MEASURED = ("psnr", "ssim", "lpips", "train_psnr", "seconds")
CURVE = ("iteration", "psnr", "ssim", "lpips")
SHOWN = ("bonsai", "lego", "plush")  # whose curves of half size are kept
ORDER = (*TRAINED, *USUAL, *MEASURED, "gaussians", "device", "date", "command", "note", "curve")
Line = dict[str, Any]


def line_of(record: Line) -> Line:
    """The line of a finished training, from what `train.py` leaves of it."""
    end = record["curve"][-1]
    made = {key: record[key] for key in TRAINED}
    made |= {key: record[key] for key, usual in USUAL.items() if record.get(key, usual) != usual}
    made |= {key: end.get(key) for key in MEASURED}
    system, *_, torch = record["machine"].split(", ")
    made |= {"gaussians": int(end["num_points"]), "device": f"{system}, one thread, {torch}"}
    made |= {"date": record["date"], "command": record.get("command") or command_of(made)}
    if record["size"] == "images_2" and record["scene"] in SHOWN:
        made["curve"] = {key: [row.get(key) for row in record["curve"]] for key in CURVE}
    return made


def command_of(line: Line) -> str:
    """The command that trains a line, in a folder that holds the scenes."""
    options = {"scene": "", "density": RELOCATION, "arm": "", "size": "", "iterations": 0}
    options |= {"points": 0, "sh_degree": 0, "views": 0, "threshold": 1.0, "seed": -1}
    said = [(name, line.get(name, usual)) for name, usual in options.items()]
    words = [f"--{n.replace('_', '-')} {v}" for n, v in said if v != options[n]]
    words += ["--background white"] * (line["scene"] == "lego")
    return " ".join(["python examples/benchmarks/train.py", *words])


def key_of(line: Line) -> tuple[Any, ...]:
    """What a training is known by; two of the same are one, the later."""
    usual = [json.dumps(line.get(key, value)) for key, value in USUAL.items()]
    kind = "GPU" if "NVIDIA" in line["device"] else "CPU"
    first = [line["scene"], line["size"], line["sh_degree"], line["points"], line["iterations"]]
    last = (kind, line["density"], line["arm"], json.dumps(line["seed"]), line.get("note", ""))
    return (*first, *usual, *last)


def read(path: Path = FILE) -> list[Line]:
    """All lines, each with `USUAL` where it does not say otherwise."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [USUAL | json.loads(line) for line in lines]


def add(lines: Iterable[Line], path: Path = FILE) -> None:
    """Write these lines into the file, in the place of those of the same training."""
    kept = {key_of(line): line for line in (*read(path), *lines)}
    with path.open("w", encoding="utf-8") as file:
        for _, line in sorted(kept.items()):
            shown = [key for key in ORDER if key in line and line[key] != USUAL.get(key, ...)]
            file.write(json.dumps({key: line[key] for key in shown}) + "\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("records", nargs="+", type=Path, metavar="RECORD.json")
    paths = parser.parse_args(arguments).records
    records = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    made = [line_of(record) for record in records if record.get("finished")]
    add(made)
    print(f"{len(made)} of {len(records)} trainings are finished; they are in {FILE.name}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
