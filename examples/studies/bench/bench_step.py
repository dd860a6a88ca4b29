"""What a step costs on a CPU: the defaults and the paper's phases beside six torch Adams.

    python examples/studies/bench/bench_step.py     (one thread: 1,000 to 1,000,000 points)

Writes `step_cpu.md`, `step_cpu.json` and `step_cpu.png` to `--out`, anew after each size, so that
a run that is interrupted leaves those that it has finished. `python examples/gpu.py` measures the
same on a GPU.
"""

from __future__ import annotations

import argparse
import json
import logging
import platform
import shlex
import sys
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from splatting.stopping import command
from tqdm import tqdm

from studies.bench.steps import COMPARED, Results, counts_table, draw, measure_all, times_table

CPU = torch.device("cpu")
MAKES = 3  # times that the subjects are made anew
# Points up to which all subjects are in memory at once. Of more points they are measured by twos,
# in a fifth of the rounds: a round takes long, and its ratio varies less.
TOGETHER = 100_000
FEWER = 5
# What a step of the defaults may cost on a CPU: points -> ratio to six Adams in the same round.
GOALS = {1_000: 1.40, 10_000: 1.15, 100_000: 1.05, 1_000_000: 1.03}


def cpu_name() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def goals_line(results: Results) -> str:
    """What the defaults cost beside what they may cost."""
    said = [
        f"{n:,} points x{rows['defaults']['per_adam']:.2f} of x{GOALS[n]:.2f}"
        + ("" if rows["defaults"]["per_adam"] <= GOALS[n] else " (missed)")
        for n, rows in results.items()
        if n in GOALS
    ]
    return f"The defaults, of what they may cost on a CPU: {', '.join(said)}." if said else ""


def rounds_at(points: int, repeats: int) -> int:
    """Rounds of a measurement of so many points."""
    return repeats if points <= TOGETHER else min(repeats, max(MAKES, repeats // FEWER))


def page(record: dict[str, Any], results: Results) -> str:
    """The Markdown of all tables."""
    repeats = record["repeats"]
    parts = ["# Cost of a step", "\n".join(f"- {key}: {value}" for key, value in record.items())]
    parts += [
        f"Nanoseconds per point, medians of {repeats} rounds. A round times everything in this "
        f"table once (of more than {TOGETHER:,} points: one of them and six Adams, in "
        f"{rounds_at(TOGETHER + 1, repeats)} rounds). Behind x stand the median of the ratio to "
        "six torch Adams in the same round, and its quartiles. Six Adams have torch's options, "
        "with which Adam is not fused on a CPU; `fused` is beside six fused Adams. Before each "
        "call the caches are filled with something else, as rendering does.",
        goals_line(results),
        times_table(results),
        "## What a step does",
        "Operators are torch's. Values read are those that Python reads on a CPU. Where they would "
        "lie on a GPU the package leaves them there, which the tests check. Bytes are kept beside "
        "parameters and gradients.",
        counts_table(results),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def save(stem: Path, record: dict[str, Any], results: Results) -> str:
    """Write the page, the JSON and the picture; return the page."""
    text = page(record, results)
    stem.with_suffix(".md").write_text(text, encoding="utf-8")
    made = {**record, "goals": GOALS, "results": results}
    stem.with_suffix(".json").write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    draw(results, f"{record['device']}, torch {record['torch']}", stem.with_suffix(".png"))
    return text


@command("bench_step")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--points", type=int, nargs="+", default=list(GOALS), metavar="N")
    add("--repeats", type=int, default=50, metavar="N", help="rounds of every measurement")
    add("-o", "--out", type=Path, default=Path("docs/benchmarks"), metavar="DIR")
    args = parser.parse_args(arguments)
    logging.getLogger("opt3dgs_optim").addHandler(logging.NullHandler())  # not what was upgraded
    torch.set_num_threads(1)
    torch.manual_seed(0)
    words = sys.argv[1:] if arguments is None else arguments
    record = {
        "command": shlex.join(["python", "examples/studies/bench/bench_step.py", *words]),
        "date": date.today().isoformat(),
        "device": f"{cpu_name()}, one thread",
        "torch": torch.__version__,
        "python": platform.python_version(),
        "repeats": args.repeats,
    }
    args.out.mkdir(parents=True, exist_ok=True)
    results: Results = {}
    text = ""
    for points in tqdm(args.points, desc="steps", unit="size"):
        rounds, together = rounds_at(points, args.repeats), points <= TOGETHER
        results[points] = measure_all(points, CPU, COMPARED, rounds, makes=MAKES, together=together)
        text = save(args.out / "step_cpu", record, results)
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
