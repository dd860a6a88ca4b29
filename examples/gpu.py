"""Everything that only a GPU can show, in one command: python examples/gpu.py

On a machine with an NVIDIA GPU, torch for it and `pip install -e ".[cuda,test]"`, in under ten
minutes:

1. `opt3dgs doctor`, and the tests marked `cuda`;
2. what a step of the defaults, of the paper's phases, of masked steps and of `two_loop` costs
   beside six fused torch Adams: time, launches, waits for the device, memory, bandwidth;
3. with `--gsplat PATH/examples/simple_trainer.py`, gsplat's own `mcmc` training, stock and with the
   lines of `opt3dgs hosts diff`, on `--scene DIR` or on the embedded scene.

Writes `report.md`, `report.json` and `step.png` to `--out`. Without a GPU, or with `--device cpu`,
all of it runs on the CPU at smaller sizes, and the report says what that leaves out.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import logging
import platform
import re
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import torch
from splatting.stopping import command
from splatting.writable import check_folder
from studies.bench.bench_step import cpu_name
from studies.bench.gpu_training import KINDS, run, train_both
from studies.bench.steps import COMPARED, counts_table, draw, measure_all, times_table
from studies.bench.subjects import BASELINES
from studies.pages import table
from tqdm import tqdm

from opt3dgs_optim.doctor import versions

ROOT = Path(__file__).resolve().parents[1]
POINTS = {"cuda": (10_000, 100_000, 1_000_000, 5_000_000), "cpu": (1_000, 10_000)}
REPEATS = {"cuda": 30, "cpu": 5}
ITERATIONS = {"cuda": 3_000, "cpu": 30}
GAUSSIANS = {"cuda": 30_000, "cpu": 1_000}
STEPPED = tuple(name for name in COMPARED if name not in BASELINES)  # on a GPU all are fused
CPU_NOTE = (
    "This is a CPU: no kernel was launched, nothing waited for a device, and the figures say "
    "nothing about a GPU. In the place of launches stand torch's operators, in that of waits the "
    "values that Python reads (a fused Adam on a GPU reads none)."
)


def check(device: torch.device) -> dict[str, Any]:
    """The doctor's and the tests' outcome."""
    code = "from opt3dgs_optim.doctor import main; raise SystemExit(main())"
    doctor, _ = run(["-c", code, "--device", str(device)], ROOT)
    made: dict[str, Any] = {"doctor": {"code": doctor.returncode, "output": doctor.stdout}}
    if importlib.util.find_spec("pytest") is None:
        made["tests"] = {"skipped": "pytest is not installed: pip install -e '.[test]'"}
        return made
    options = ["-m", "cuda", "-q", "-rs", "-p", "no:cacheprovider"]
    done, seconds = run(["-m", "pytest", "-o", "addopts=--import-mode=importlib", *options], ROOT)
    lines = [line for line in done.stdout.splitlines() if line.strip()]
    counts = {
        kind: int(found[1]) if (found := re.search(rf"(\d+) {kind}", lines[-1])) else 0
        for kind in ("passed", "failed", "skipped", "error")
    }
    reasons = sorted({re.sub(r"^SKIPPED \[\d+\] \S+ ", "", x) for x in lines if "SKIPPED" in x})
    made["tests"] = {"code": done.returncode, "seconds": round(seconds, 1), **counts}
    made["tests"]["reasons"] = reasons
    if done.returncode not in (0, 5):
        made["tests"]["output"] = done.stdout[-8_000:]
    return made


def about(device: torch.device, words: Sequence[str]) -> dict[str, Any]:
    """Machine, versions, command and date."""
    made: dict[str, Any] = {
        "command": shlex.join(["python", "examples/gpu.py", *words]),
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "machine": f"{platform.system()} {platform.machine()}, {cpu_name()}",
        "versions": versions(device),
    }
    if device.type == "cuda":
        found = torch.cuda.get_device_properties(device)
        made["gpu"] = {
            "name": found.name,
            "compute_capability": f"{found.major}.{found.minor}",
            "memory_bytes": found.total_memory,
            "multiprocessors": found.multi_processor_count,
        }
    return made


def training_text(found: dict[str, Any]) -> str:
    """Markdown of the two trainings, or why there are none."""
    if "skipped" in found:
        return f"Not run: {found['skipped']}."
    keys = ("psnr", "ssim", "training_seconds", "seconds", "gaussians", "skipped")
    rows = [(kind, *(found[kind].get(key, "-") for key in keys)) for kind in KINDS if kind in found]
    said = f"{found['script']} mcmc, {found['iterations']:,} iterations, scene {found['scene']}."
    return said + "\n\n" + table(("", *keys), "lr", rows)


def report(result: dict[str, Any]) -> str:
    """The whole page."""
    known, tests = result["about"], result["checks"]["tests"]
    lines = ["# What only a GPU shows", ""]
    if "gpu" not in known:
        lines += [CPU_NOTE, ""]
    lines += [f"- {key}: {known[key]}" for key in ("command", "date", "machine")]
    lines += [
        f"- {key}: {value}" for key, value in {**known["versions"], **known.get("gpu", {})}.items()
    ]
    lines += ["", "## Checks", ""]
    lines += ["```text", result["checks"]["doctor"]["output"].rstrip(), "```", ""]
    if "skipped" in tests and "code" not in tests:
        lines.append(f"Tests marked `cuda`: not run, {tests['skipped']}.")
    else:
        counts = ", ".join(f"{tests[k]} {k}" for k in ("passed", "failed", "error", "skipped"))
        lines.append(f"Tests marked `cuda`: {counts}, in {tests['seconds']} s.")
        lines += [f"Skipped: {reason}." for reason in tests["reasons"]]
        if "output" in tests:
            lines += ["", "```text", tests["output"].rstrip(), "```"]
    lines += ["", "## A step", ""]
    lines += [
        "Medians, in turn with six torch Adams, and the quartiles of the ratio. Bytes are kept "
        "beside parameters and gradients.",
        "",
    ]
    lines += [times_table(result["steps"]), "", counts_table(result["steps"]), ""]
    picture = "![Times of a step, and ratios to six Adams](step.png)"
    lines += [picture if result["picture"] else "No picture: matplotlib is not installed.", ""]
    lines += ["## gsplat's own trainer", "", training_text(result["training"]), ""]
    lines.append(f"All of it took {result['seconds']:.0f} s.")
    return "\n".join(lines) + "\n"


def training(args: argparse.Namespace, device: torch.device) -> dict[str, Any]:
    """gsplat's trainer, where there is one."""
    kind = device.type
    if args.gsplat is None:
        return {"skipped": "--gsplat PATH/examples/simple_trainer.py was not given"}
    if importlib.util.find_spec("gsplat") is None:
        return {"skipped": "gsplat is not installed: pip install gsplat"}
    iterations = args.iterations or ITERATIONS[kind]
    work = args.out / "training"
    check_folder(work)
    scene = None if args.scene is None else args.scene.resolve()
    both = train_both(
        args.gsplat.resolve(), scene, work.resolve(), iterations, GAUSSIANS[kind], cpu=kind == "cpu"
    )
    named = "embedded" if args.scene is None else args.scene.name
    return {"script": args.gsplat.name, "scene": named, "iterations": iterations, **both}


@command("gpu")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 1 where the doctor or a test has failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--device", choices=("cuda", "cpu"), help="default: the GPU, where torch sees one")
    add("--points", type=int, nargs="+", metavar="N", help="numbers of points to step")
    add("--repeats", type=int, metavar="N", help="rounds of every measurement")
    add("--gsplat", type=Path, metavar="FILE", help="simple_trainer.py of a gsplat checkout")
    add("--scene", type=Path, metavar="DIR", help="for it, in COLMAP's layout; default: embedded")
    add("--iterations", type=int, metavar="N", help="of its trainings")
    add("-o", "--out", type=Path, default=Path("runs/gpu"), metavar="DIR")
    args = parser.parse_args(arguments)
    kind = args.device or ("cuda" if torch.cuda.is_available() else "cpu")
    if kind == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: torch sees no CUDA device; --device cpu runs on this one")
    if args.gsplat is not None and not args.gsplat.is_file():
        raise FileNotFoundError(f"--gsplat {args.gsplat}: no such file")
    check_folder(args.out)
    logging.getLogger("opt3dgs_optim").addHandler(logging.NullHandler())
    device, start = torch.device(kind), time.perf_counter()
    words = list(sys.argv[1:] if arguments is None else arguments)
    result: dict[str, Any] = {"about": about(device, words), "checks": check(device), "steps": {}}
    torch.manual_seed(0)
    if kind == "cpu":
        torch.set_num_threads(1)
    for points in tqdm(args.points or POINTS[kind], desc="steps", unit="size"):
        repeats = args.repeats or REPEATS[kind]
        result["steps"][points] = measure_all(points, device, STEPPED, repeats)
    title = result["about"].get("gpu", {}).get("name", "CPU, one thread")
    result["picture"] = draw(result["steps"], title, args.out / "step.png")
    result["training"] = training(args, device)
    result["seconds"] = round(time.perf_counter() - start, 1)
    (args.out / "report.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    (args.out / "report.md").write_text(report(result), encoding="utf-8")
    print(args.out / "report.md", args.out / "report.json", sep="\n")
    checks = result["checks"]
    bad = checks["doctor"]["code"] != 0 or checks["tests"].get("code", 0) not in (0, 5)
    return int(bad)


if __name__ == "__main__":
    raise SystemExit(main())
