"""What a step costs: the defaults and the paper's phases against six torch Adams.

    python examples/studies/bench/bench_step.py                # CPU, one thread: 1k to 1M points
    python examples/studies/bench/bench_step.py --device cuda  # 1M and 5M, what only a GPU shows

Every round times each subject once, in turn, so that a busy machine slows all of them alike; ratios
are taken within a round. Where a subject's tensors lie in memory changes its time by a tenth, at
10,000 points by more: all subjects are made anew five times, in another order, and one of them
stands there twice. Prints a table and writes it, a JSON file and a plot to `--out`.
"""

from __future__ import annotations

import argparse
import json
import platform
import random
import statistics
import sys
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch

from studies.bench.bench_subjects import (
    SUBJECTS,
    Case,
    gpu_only,
    history_bytes,
    kernel_bandwidth_share,
)

COMMAND = "python examples/studies/bench/bench_step.py"
BASELINE = "six Adams"
MAKES = 5  # times that the subjects are made
# What a step of the defaults may cost on a CPU: points -> ratio to six Adams in the same round.
GOALS = {1_000: 1.40, 10_000: 1.15, 100_000: 1.05, 1_000_000: 1.03}
Rounds = dict[str, list[float]]


def measure(case: Case, repeats: int) -> Rounds:
    """Seconds per call of every subject, one list entry per round."""
    rounds: Rounds = {name: [] for name in SUBJECTS}
    order, chance = list(SUBJECTS), random.Random(0)
    for share in range(min(MAKES, repeats)):
        calls = {name: SUBJECTS[name](case) for name in order}
        for name in order * 3:
            calls[name]()
        for _ in range(share, repeats, MAKES):
            for name in order:
                rounds[name].append(timed(calls[name], case.device))
        calls.clear()  # before the next are made
        chance.shuffle(order)
    return rounds


def timed(call: Callable[[], Any], device: torch.device) -> float:
    """CPU seconds of one call; on a GPU, of the device's work, by events."""
    if device.type != "cuda":
        begin = time.process_time()
        call()
        return time.process_time() - begin
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    call()
    end.record()
    end.synchronize()
    return start.elapsed_time(end) / 1e3


def summary(rounds: Rounds, points: int) -> dict[str, dict[str, float]]:
    """Nanoseconds per point (median, quartiles) and ratios within a round (median, quartiles)."""
    result = {}
    for name, seconds in rounds.items():
        low, middle, high = quartiles([s / points * 1e9 for s in seconds])
        row = {"ns_per_point": middle, "ns_low": low, "ns_high": high}
        for key, other in (("adam", BASELINE), ("copy", "copy of 144 bytes")):
            ratios = [a / b for a, b in zip(seconds, rounds[other], strict=True)]
            row[f"{key}_low"], row[f"per_{key}"], row[f"{key}_high"] = quartiles(ratios)
        result[name] = row
    return result


def quartiles(values: list[float]) -> tuple[float, float, float]:
    """Lower quartile, median, upper quartile."""
    if len(values) < 2:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, middle, high


def machine(device: torch.device) -> dict[str, str]:
    """What the figures belong to."""
    if device.type == "cuda":
        return {"device": torch.cuda.get_device_name(device), "torch": torch.__version__}
    return {
        "device": f"{cpu_name()}, one thread",
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def cpu_name() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def table(results: dict[int, dict[str, dict[str, float]]]) -> str:
    """Markdown: a row per subject, and per number of points ns per point and ratio."""
    counts = list(results)
    head = "| ns per point | " + " | ".join(f"{n:,} points" for n in counts) + " |"
    rule = "|---|" + "---:|" * len(counts)
    lines = [head, rule]
    for name in results[counts[0]]:
        cells = []
        for n in counts:
            row = results[n][name]
            cells.append(f"{row['ns_per_point']:.0f} (x{row['per_adam']:.2f})")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def goals_line(results: dict[int, dict[str, dict[str, float]]]) -> str:
    """What the defaults cost beside what they may cost."""
    said = [
        f"{n:,} points x{rows['defaults']['per_adam']:.2f} of x{GOALS[n]:.2f}"
        + ("" if rows["defaults"]["per_adam"] <= GOALS[n] else " (missed)")
        for n, rows in results.items()
        if n in GOALS
    ]
    return f"The defaults, of what they may cost on a CPU: {', '.join(said)}." if said else ""


def plot(results: dict[int, dict[str, dict[str, float]]], path: Path, title: str) -> None:
    """Nanoseconds per point over the number of points, one line per subject."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    counts = list(results)
    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    for i, name in enumerate(results[counts[0]]):
        style = "o-" if i < 10 else "s--"  # matplotlib has ten colours
        rows = [results[n][name] for n in counts]
        middle = [row["ns_per_point"] for row in rows]
        below = [row["ns_per_point"] - row["ns_low"] for row in rows]
        above = [row["ns_high"] - row["ns_per_point"] for row in rows]
        axes.errorbar(counts, middle, [below, above], fmt=style, capsize=3, label=name)
    axes.set(xscale="log", yscale="log", xlabel="points", ylabel="ns per point", title=title)
    axes.grid(which="both", alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=120)
    plt.close(figure)


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # pyright: ignore
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--points", type=int, nargs="+")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    options = parse(arguments)
    device = torch.device(options.device)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    on_gpu = device.type == "cuda"
    counts = options.points or (
        [1_000_000, 5_000_000] if on_gpu else [1_000, 10_000, 100_000, 1_000_000]
    )
    extra: dict[str, Any] = {}
    if on_gpu:  # first: the latency of the first use is part of it
        extra = gpu_only(device)
    results = {}
    for points in counts:
        print(f"{points:,} points ...", file=sys.stderr)
        rounds = measure(Case(points, device), options.repeats)
        results[points] = summary(rounds, points)
    if on_gpu:
        extra["kernel_share_of_copy_bandwidth"] = {
            points: kernel_bandwidth_share(
                rows["record + direction alone"]["ns_per_point"],
                rows["copy of 144 bytes"]["ns_per_point"],
            )
            for points, rows in results.items()
        }
    record = {
        "command": f"{COMMAND} {' '.join(arguments or sys.argv[1:])}",
        "date": date.today().isoformat(),
        **machine(device),
        "repeats": options.repeats,
        "baseline": BASELINE,
        "history_bytes_per_point": history_bytes(),
        "results": results,
        **extra,
    }
    write(record, results, options.out / f"step_{device.type}")
    return 0


def write(record: dict[str, Any], results: dict[int, Any], stem: Path) -> None:
    """The table to the terminal, and table, JSON and plot to files."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    told = {key: value for key, value in record.items() if key != "results"}
    lines = [f"- {key}: {value}" for key, value in told.items()]
    note = (
        f"Median of {record['repeats']} rounds, and of the ratio to "
        f'"{record["baseline"]}" in the same round. The JSON beside this has the quartiles.'
    )
    goals = goals_line(results) if stem.name.endswith("cpu") else ""
    parts = ["# Cost of a step", "", *lines, "", note, "", *([goals, ""] if goals else [])]
    text = "\n".join([*parts, table(results), ""])
    print(text)
    stem.with_suffix(".md").write_text(text)
    stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n")
    plot(results, stem.with_suffix(".png"), f"{record['device']}, torch {record['torch']}")


if __name__ == "__main__":
    sys.exit(main())
