"""Everything that only a GPU can show, in one command: python examples/gpu.py

On a machine with an NVIDIA GPU, torch for it and `pip install -e ".[cuda,test]"`, in ten minutes:

1. `opt3dgs doctor`, and the tests marked `cuda`;
2. what a step costs beside six fused torch Adams: time, launches, waits for the device, memory.

Writes `report.md` and `report.json` to `--out`; the `steps` of docs/results/gpu.json are its own.
With `--device cpu` it runs on a CPU, at smaller sizes, which says nothing about a GPU.
`benchmarks/simple_trainer.py` runs gsplat's own trainer.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import torch
from benchmarks import steps
from splatting.stopping import check_folder, command
from tqdm import tqdm

from opt3dgs_optim.doctor import versions
from opt3dgs_optim.lbfgs import two_loop
from opt3dgs_optim.lbfgs.history import history_from_pairs

ROOT = Path(__file__).resolve().parents[1]
POINTS = {"cuda": (10_000, 100_000, 1_000_000, 5_000_000), "cpu": (1_000, 10_000)}
PACKAGE = ("-m", "opt3dgs_optim")
TESTS = ("-m", "pytest", "-o", "addopts=--import-mode=importlib", "-m", "cuda", "-q", "-rs")
TESTS += ("tests/cuda", "tests/runs/test_log.py", "tests/test_doctor.py")  # where they are
PAIRS = 5  # of curvature


def run(words: Sequence[str]) -> tuple[int, str, float]:
    """Run Python with these words: exit status, what it printed, seconds."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *words],
        cwd=ROOT,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    return done.returncode, done.stdout, round(time.perf_counter() - begin, 1)


def recursion(device: torch.device, rounds: int, points: int) -> dict[str, float]:
    """Microseconds of a `two_loop`: of one call with its wait, and of one of a hundred in a queue.

    With few points the first is of Python and the wait; with many the second is the kernel's time.
    """
    grad, pairs = torch.randn(points, 3, device=device), torch.randn(2, PAIRS, points, 3)
    history = history_from_pairs(*pairs.to(device))

    def calls(count: int) -> None:
        for _ in range(count):
            two_loop(grad, history, PAIRS)

    calls(steps.WARM_UP)
    found = {}
    for name, count in (("alone", 1), ("in a queue", 100)):
        seconds = [steps.timed(partial(calls, count), device) for _ in range(rounds)]
        found[name] = round(1e6 * statistics.median(seconds) / count, 2)
    return found


def counts(results: dict[int, dict[str, steps.Row]]) -> str:
    """Markdown: what an iteration launches, waits for and takes, at the most Gaussians."""
    points, rows = max(results.items())
    lines = [f"At {points:,} Gaussians:", "", "| | launches | waits | bytes kept | bytes within |"]
    lines.append("|---|---:|---:|---:|---:|")
    for name, row in rows.items():
        within = f"{row['peak_bytes'] / points:.0f}" if "peak_bytes" in row else "-"
        cells = (row.get("launches", "-"), row.get("waits", "-"), row["bytes_per_point"], within)
        lines.append(f"| {name} | {' | '.join(map(str, cells))} |")
    return "\n".join([*lines, "", "Bytes are for each Gaussian; those within a step are freed."])


def report(made: dict[str, Any]) -> str:
    """The page."""
    lines = ["# What only a GPU shows", ""]
    lines += [f"- {key}: {value}" for key, value in made["about"].items()]
    for name in ("doctor", "tests"):
        text = made[name]["output"][-8_000:].rstrip()
        lines += ["", f"## {name}: exit status {made[name]['code']}", "", "```text", text, "```"]
    lines += ["", "## A step"]
    for points, found in made["two_loop"].items():
        said = ", ".join(f"{us:.1f} us {name}" for name, us in found.items())
        lines += ["", f"`two_loop` of {points:,} points with {PAIRS} pairs: {said}."]
    if results := made["steps"]["results"]:
        lines += ["", steps.table(results), ""]
        lines += ["On a GPU the six Adams are PyTorch's fused ones.", "", counts(results)]
    lines += [f"\n{what}: {why}" for what, why in made["failed"].items()]
    return "\n".join([*lines, ""])


def write(made: dict[str, Any], out: Path) -> None:
    """The page, and what it is made of."""
    (out / "report.json").write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    (out / "report.md").write_text(report(made), encoding="utf-8")


@command("gpu")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 1 where the doctor, a test or a measurement has failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--device", choices=("cuda", "cpu"), default="cuda")
    add("--points", type=int, nargs="+", metavar="N", help="numbers of Gaussians to step")
    add("--rounds", type=int, default=30, metavar="N", help="of every measurement")
    add("-o", "--out", type=Path, default=Path("runs/gpu"), metavar="DIR")
    args = parser.parse_args(arguments)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("torch sees no CUDA device; --device cpu runs on a CPU")
    check_folder(args.out)
    logging.getLogger("opt3dgs_optim").setLevel(logging.ERROR)  # nothing is trained to its end
    device, out = torch.device(args.device), args.out.resolve()
    torch.set_num_threads(1)
    about = {"machine": steps.machine(device), "date": time.strftime("%Y-%m-%d", time.gmtime())}
    made: dict[str, Any] = {"about": {**about, **versions(device)}}
    made |= {"two_loop": {}, "steps": {"rounds": args.rounds, "results": {}}, "failed": {}}
    for name, words in (
        ("doctor", (*PACKAGE, "doctor", "--device", args.device)),
        ("tests", TESTS),
    ):
        code, said, seconds = run(words)
        made[name] = {"code": code, "seconds": seconds, "output": said}
    # On a GPU all of PyTorch's Adams are the fused ones.
    names = [n for n in steps.SUBJECTS if args.device == "cpu" or "fused" not in n]
    sizes = args.points or POINTS[args.device]
    measurements = [("two_loop", points) for points in sorted({min(sizes), max(sizes)})]
    measurements += [("steps", points) for points in sizes]
    for what, points in tqdm(measurements, unit="measurement"):
        write(made, out)  # what is measured is kept, whatever comes
        try:
            if what == "steps":
                found = steps.measure(points, device, names, args.rounds)
                made[what]["results"][points] = found
            else:
                made[what][points] = recursion(device, args.rounds, points)
        except Exception as error:  # one on a GPU's kernels may be any
            made["failed"][f"{what}, {points:,}"] = f"{type(error).__name__}: {error}"
    write(made, out)
    print(out / "report.md")
    failed = made["doctor"]["code"] != 0 or made["tests"]["code"] not in (0, 5) or made["failed"]
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
