"""What an iteration of each arm costs: python examples/studies/scenes/costs.py --runs runs/study

Trainings that ran at different hours, beside other work, cannot be compared by their clocks. This
loads the checkpoints that they left at the same iterations, lets them step in turns, and writes the
seconds of an iteration of each arm, as a share of stock's, to docs/results/study/costs.json.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from statistics import fmean, median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from splatting.fit import Fit
from splatting.stopping import command

from studies.scenes.arms import BASELINE, arm_of, find_study_arm
from studies.scenes.records import COSTED, COSTS, FOLDER, costed
from studies.scenes.training import Spec, fit_of, machine, scene_of

ROUNDS, STEPS, FIRST = 7, 10, 5  # rounds of so many iterations in turns, after the first few
SHARES = (0.5, 0.75, 0.9)  # of a training, where it left checkpoints


def measure(fits: dict[str, Fit]) -> dict[str, float]:
    """CPU seconds of an iteration, as a share of the baseline's: medians of rounds in turns."""
    for fit in fits.values():
        for _ in range(FIRST):
            fit.step()
    seconds: dict[str, list[float]] = defaultdict(list)
    for _ in range(ROUNDS):
        for name, fit in fits.items():
            start = time.process_time()
            for _ in range(STEPS):
                fit.step()
            seconds[name].append(time.process_time() - start)
    return {
        name: median(a / b for a, b in zip(own, seconds[BASELINE], strict=True))
        for name, own in seconds.items()
    }


def fits_at(folders: dict[str, Path], mark: str) -> dict[str, Fit]:
    """Every arm's training as it was at that checkpoint."""
    fits = {}
    for name, folder in folders.items():
        call = json.loads((folder / "call.json").read_text(encoding="utf-8"))
        known = {f.name: call["spec"][f.name] for f in fields(Spec) if f.name in call["spec"]}
        spec, arm = Spec(**known), find_study_arm(name)
        fits[name] = fit_of(arm)(scene_of(spec), arm, spec.options(), call["mean_nu"])
        fits[name].load(folder / mark)
    return fits


def measure_all(runs: Path, iterations: Sequence[int]) -> list[dict[str, Any]]:
    """One entry for each of `COSTED`: of the first seed with stock and another arm."""
    found: dict[tuple[Any, ...], dict[str, Path]] = defaultdict(dict)
    for path in sorted(runs.rglob("record.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        plain = not record.get("views") and record.get("rates", 1.0) == 1.0
        arm = arm_of(record["arm"])
        whole = not arm.archived and arm.trunk is None and arm.needs is None
        if plain and whole and record.get("finished") and record["iterations"] in iterations:
            found[(*costed(record), record["seed"])][record["arm"]] = path.parent
    first: dict[tuple[Any, ...], dict[str, Path]] = {}
    for (*key, _seed), folders in sorted(found.items()):
        if BASELINE in folders and len(folders) > 1:
            first.setdefault(tuple(key), folders)
    made = []
    for key, folders in first.items():
        about = dict(zip(COSTED, key, strict=True))
        marks = [
            name
            for name in (f"at-{round(share * about['iterations'])}.pt" for share in SHARES)
            if all((folder / name).exists() for folder in folders.values())
        ]
        measured = [measure(fits_at(folders, mark)) for mark in marks]
        shares = {arm: round(fmean(m[arm] for m in measured), 3) for arm in folders if measured}
        made.append(
            {
                **about,
                "checkpoints": marks,
                "shares": shares,
                "machine": machine(),
                "date": time.strftime("%Y-%m-%d", time.gmtime()),
            }
        )
        print(made[-1])
    return made


@command("costs")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=Path, required=True, metavar="DIR", help="of run.py")
    parser.add_argument("--iterations", type=int, nargs="+", default=[7_500, 30_000])
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    made = measure_all(args.runs, args.iterations)
    if not made:
        raise ValueError(f"--runs {args.runs}: holds no scene with {BASELINE} and another arm")
    path = FOLDER / COSTS
    old = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
    entries = {costed(entry): entry for entry in old}
    for entry in made:  # what other arms cost stays
        known = entries.get(costed(entry), {}).get("shares", {})
        entries[costed(entry)] = {
            **entry,
            "shares": dict(sorted({**known, **entry["shares"]}.items())),
        }
    text = json.dumps([entries[key] for key in sorted(entries)], indent=1)
    path.write_text(text + "\n", encoding="utf-8")
    print(path)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
