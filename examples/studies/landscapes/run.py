"""Sampling claims on landscapes with known answers: nine modes, a Gaussian, a double well.

    python examples/studies/landscapes/run.py            # writes docs/results/landscapes/

Every experiment is a JSON file; one that is there with the same settings is not repeated, so
Ctrl-C loses the running one only. Tables and pictures are made from the files, and with the
default output the tables of docs/landscapes.md are renewed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "examples"))

from studies.landscapes import laws, nine, plots, tables  # noqa: E402
from studies.pages import filled  # noqa: E402

COMMAND = "python examples/studies/landscapes/run.py"
RESULTS = ROOT / "docs" / "results" / "landscapes"
PAGE = ROOT / "docs" / "landscapes.md"
MARK = "<!-- {} -->"
Run = Callable[..., dict[str, Any]]
Experiment = tuple[Run, str, dict[str, Any], int]  # function, arm, settings, progress steps
WELL_HEIGHTS = (1.0, 3.0, 6.0)


def experiments(quick: bool) -> dict[str, Experiment]:
    """Every experiment by its file's name."""
    found: dict[str, Experiment] = {}

    def add(name: str, run: Run, arm: str, progress: int, **settings: Any) -> None:
        found[name] = (run, arm, settings | {"seeds": 3}, progress)

    for name, arm in nine.ARMS.items():
        steps = arm.steps // 500 if quick else arm.steps
        add(f"nine-{name}", nine.run_arm, name, steps, steps=steps, chains=4 if quick else 48)
    for name, rates, betas in (
        ("sgld", [0.02, 0.1, 0.25, 0.4], [0.9, 0.999]),
        ("adam", [0.005, 0.02], [0.9, 0.999]),
        ("adam-slow", [0.005], [0.0, 0.9999]),
    ):
        few = rates[-1:] if name == "sgld" else []
        tried = {"chains": 64 if quick else 1024, "rates": few if quick else rates, "betas": betas}
        progress = 3 * len(tried["rates"])
        add(f"gaussian-{name}", laws.gaussian_law, name.split("-")[0], progress, **tried)
    steps = 200 if quick else 100_000
    for height in WELL_HEIGHTS:
        for name in ("sgld", "awsgld"):
            settings = {"height": height, "chains": 4 if quick else 48, "steps": steps, "lr": 1e-3}
            add(f"well-{name}-{height:.0f}", laws.well_law, name, steps, **settings)
    heights = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    for name, chains, length in (("sgld", 192, 60_000), ("awsgld", 32, 100_000)):
        steps = 200 if quick else length
        settings = {"heights": heights, "chains": 4 if quick else chains, "steps": steps}
        add(f"escape-{name}", laws.escape_rates, name, steps, **settings, lr=1e-3)
    return found


def write(path: Path, text: str) -> None:
    """All of it or nothing."""
    partial = path.with_name(path.name + ".part")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)


def run_all(output: Path, quick: bool) -> dict[str, Any]:
    """The result of every experiment, run where it is not there yet."""
    results: dict[str, Any] = {}
    everything = experiments(quick)
    for number, (name, (run, arm, settings, total)) in enumerate(everything.items(), start=1):
        path = output / f"{name}.json"
        found = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if found.get("settings") != settings:
            begin = time.process_time()
            title = f"{number}/{len(everything)} {name}"
            with tqdm(total=total, desc=title, unit="step") as bar:
                result = run(arm, **settings, progress=bar.update)
            about = {
                "command": COMMAND + (" --quick" if quick else ""),
                "date": date.today().isoformat(),
                "machine": f"{platform.system()} {platform.machine()}, 1 thread, "
                f"torch {torch.__version__}",
                "cpu_seconds": round(time.process_time() - begin, 1),
            }
            found = {"about": about, "settings": settings, "result": result}
            write(path, json.dumps(found) + "\n")
        results[name] = found
    return results


def load(output: Path) -> dict[str, Any]:
    """Every result in a folder, by its experiment's name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(output.glob("*.json"))}


def main(arguments: list[str] | None = None) -> int:
    """The command; 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=RESULTS)
    parser.add_argument("--quick", action="store_true", help="a few steps of everything, a smoke")
    options = parser.parse_args(arguments)
    if options.quick and options.output.resolve() == RESULTS:
        parser.error("--quick needs -o: its results are no evidence and do not belong in docs/")
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    try:
        results = run_all(options.output, options.quick)
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on with the unfinished experiments")
        return 130
    sections = tables.sections(results)
    plots.all_plots(results, options.output)
    if options.output.resolve() == RESULTS:
        write(PAGE, filled(PAGE.read_text(encoding="utf-8"), sections, MARK))
    else:
        write(options.output / "tables.md", "\n\n".join(sections.values()) + "\n")
    print(f"wrote {options.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
