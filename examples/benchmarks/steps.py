"""What a step costs beside six Adams, on a CPU: python examples/benchmarks/steps.py

Everything is stepped in turns, so that a busy machine slows all alike, in another order in each
round, since what a step follows changes its time. Writes the medians to `--out`, from which
`report.py` makes the table of docs/performance.md. `examples/gpu.py` measures the same on a GPU.
One to five minutes on a CPU.
"""

from __future__ import annotations

import argparse
import json
import logging
import platform
import random
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from splatting.gaussians import stock_learning_rates
from splatting.stopping import command
from torch.nn import Parameter
from torch.profiler import ProfilerActivity, profile
from tqdm import tqdm

from opt3dgs_optim import (
    DEFAULTS,
    Averaging,
    Curvature,
    EnergyHistogram,
    Fading,
    OutOfView,
    OwnFrame,
    Part,
    PhaseScheduler,
)

OUT = Path(__file__).resolve().parents[2] / "docs" / "results" / "steps.json"
POINTS = (1_000, 10_000, 100_000, 1_000_000)
TOTAL, VIEWS, WARM_UP = 30_000, 4, 4
SWEPT = torch.zeros(1 << 24)  # 64 MB: more than a core's caches, which a renderer fills as well
Row = dict[str, Any]
Call = Callable[[], Any]
Subject = tuple[Call, list[torch.optim.Optimizer]]  # an iteration, and what it steps


@lru_cache(maxsize=1)
def gaussians(points: int, device: torch.device) -> dict[str, Parameter]:
    """Of gsplat's shapes, harmonics of degree 3, with gradients; all subjects step the same."""
    torch.manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": ()}
    shapes |= {"sh0": (1, 3), "shN": (15, 3)}
    made = {k: Parameter(torch.randn(points, *s, device=device)) for k, s in shapes.items()}
    made["scales"].data.mul_(0.5).sub_(4.0)
    for param in made.values():
        param.grad = 1e-4 * torch.randn_like(param)
    return made


def stepped(
    parts: Callable[[], Sequence[Part]] | None,
    *,
    at: float = 0.25,  # share of the training: there fading is as frequent as it gets
    switch: float = 29 / 30,
    in_view: float = 1.0,
    fused: bool = False,
    moments: Literal[32, 16] = 32,
) -> Callable[[int, torch.device], Subject]:
    """Six optimizers, of stock or upgraded to these parts; a call is an iteration."""

    def make(points: int, device: torch.device) -> Subject:
        splats, rates = gaussians(points, device), stock_learning_rates(1.0)
        optimizers: Any = {
            name: torch.optim.Adam(
                [{"params": [param], "lr": rates[name], "name": name}],
                eps=1e-15,
                fused=fused or device.type == "cuda",
            )
            for name, param in splats.items()
        }
        rows = torch.rand(VIEWS, points, 1, device=device) < in_view
        gradients = [1e-4 * torch.randn(points, 3, device=device) * row for row in rows]
        losses = [x * torch.ones((), device=device) for x in (0.1, 0.12, 0.09, 0.11)]
        phases = None
        if parts is not None:
            phases = PhaseScheduler(TOTAL, parts=[*parts()], switch=switch, moments=moments)
            optimizers = phases.upgrade(optimizers)
            phases.observe(iteration=round(at * TOTAL))
        count = 0

        def step() -> None:
            nonlocal count
            count += 1
            splats["means"].grad = gradients[count % VIEWS]
            if phases is not None and phases.part(EnergyHistogram) is not None:
                phases.observe(losses[count % VIEWS])
            for optimizer in optimizers.values():
                optimizer.step()

        return step, list(optimizers.values())

    return make


BASELINE, FUSED = "six Adams", "six fused Adams"
SUBJECTS: dict[str, Callable[[int, torch.device], Subject]] = {
    BASELINE: stepped(None),
    FUSED: stepped(None, fused=True),
    "no parts": stepped(list),
    "defaults": stepped(lambda: DEFAULTS),
    "defaults, fused": stepped(lambda: DEFAULTS, fused=True),
    "defaults, a tenth in view": stepped(lambda: DEFAULTS, in_view=0.1),
    "defaults, last thirtieth": stepped(lambda: DEFAULTS, at=0.975),
    "defaults, moments of 16 bits": stepped(lambda: DEFAULTS, moments=16),
    "the same, last thirtieth": stepped(lambda: DEFAULTS, at=0.975, moments=16),
    "defaults without OwnFrame": stepped(lambda: [Fading(), OutOfView(), Averaging()]),
    "OwnFrame alone": stepped(lambda: [OwnFrame()]),
    "the paper's exploration": stepped(lambda: [EnergyHistogram.paper(warmup=4)]),
    "the paper's exploitation": stepped(lambda: [Curvature()], at=0.0, switch=0.0),
}


def measure(points: int, device: torch.device, names: Sequence[str], rounds: int) -> dict[str, Row]:
    """Of each subject: ms of an iteration, its ratio to six Adams in the same round, bytes kept.

    Bytes are of the optimizers' state: Adam's moments, and what the parts keep.

    A subject whose name ends in "fused" is compared with six fused Adams. On a GPU also what one
    iteration launches, how often it waits for the device, and the most memory beside what is kept.
    """
    made: dict[str, Row] = {}
    calls: dict[str, Call] = {}
    for name in dict.fromkeys([BASELINE, FUSED, *names]):
        calls[name], optimizers = SUBJECTS[name](points, device)
        for _ in range(WARM_UP):
            calls[name]()
        kept = state_bytes(optimizers) / points
        made[name] = {"bytes_per_point": round(kept, 1), **counts(calls[name], device)}
    times: dict[str, list[float]] = {name: [] for name in calls}
    order, shuffle = list(calls), random.Random(0).shuffle
    for _ in range(rounds):
        shuffle(order)
        for name in order:
            # There, of 30,000 iterations, every fourth iterate goes into the mean.
            count = 4 if "thirtieth" in name else 1
            times[name].append(statistics.fmean(timed(calls[name], device) for _ in range(count)))
    for name, row in made.items():
        theirs = times[FUSED if name.endswith("fused") else BASELINE]
        ratios = [a / b for a, b in zip(times[name], theirs, strict=True)]
        low, middle, high = statistics.quantiles(ratios, n=4)
        row["ms"] = round(1e3 * statistics.median(times[name]), 4)
        row |= {"low": round(low, 3), "ratio": round(middle, 3), "high": round(high, 3)}
    return {name: made[name] for name in names}


def timed(call: Call, device: torch.device) -> float:
    """Seconds of a call, on a GPU with what it waits for; CPU seconds on a CPU, caches emptied."""
    if device.type == "cpu":
        SWEPT.add_(1.0)
        begin = time.process_time()
        call()
        return time.process_time() - begin
    torch.cuda.synchronize(device)
    begin = time.perf_counter()
    call()
    torch.cuda.synchronize(device)
    return time.perf_counter() - begin


def counts(call: Call, device: torch.device) -> Row:
    """Launches, waits and memory of one call, on a GPU."""
    if device.type == "cpu":
        return {}
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    torch.cuda.synchronize(device)
    peak = torch.cuda.max_memory_allocated(device) - before
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        call()
        torch.cuda.synchronize(device)
    events = [e for e in profiler.events() or () if str(e.device_type).endswith("CUDA")]
    # Beside kernels and copies a trace has the optimizers' own marks.
    launches = sum(not event.name.startswith("Optimizer.") for event in events)
    waits = sum("called a synchronizing" in str(warning.message) for warning in caught)
    return {"launches": launches, "waits": waits, "peak_bytes": peak}


def state_bytes(optimizers: Iterable[torch.optim.Optimizer]) -> int:
    """Of the tensors that the optimizers keep."""
    states = (state for optimizer in optimizers for state in optimizer.state.values())
    tensors = (x for state in states for x in state.values() if isinstance(x, torch.Tensor))
    return sum(x.numel() * x.element_size() for x in tensors)


def table(results: Mapping[Any, dict[str, Row]]) -> str:
    """Markdown: a row a subject; for each number of Gaussians its ms and its ratio to six Adams."""
    heads = ["", *(f"{int(points):,} Gaussians" for points in results)]
    lines = [f"| {' | '.join(heads)} |", f"|---|{'---:|' * len(results)}"]
    for name in next(iter(results.values())):
        rows = [found.get(name) for found in results.values()]
        cells = (f"{row['ms']:.3g} ms, x{row['ratio']:.2f}" if row else "-" for row in rows)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def machine(device: torch.device) -> str:
    """What it ran on."""
    if device.type == "cuda":
        return f"{torch.cuda.get_device_name(device)}, torch {torch.__version__}"
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{(names or [platform.machine()])[0]}, one thread, torch {torch.__version__}"


@command("steps")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("--points", type=int, nargs="+", metavar="N", help="numbers of Gaussians")
    add("--rounds", type=int, default=50, help="of 100,000 Gaussians or less; a fifth of more")
    add("-o", "--out", type=Path, default=OUT, metavar="FILE", help="JSON")
    args = parser.parse_args(arguments)
    device = torch.device("cpu")
    torch.set_num_threads(1)
    logging.getLogger("opt3dgs_optim").setLevel(logging.ERROR)  # nothing is trained to its end
    results: dict[int, dict[str, Row]] = {}
    for points in tqdm(args.points or POINTS, unit="size"):
        rounds = args.rounds if points <= 100_000 else max(args.rounds // 5, 5)
        results[points] = measure(points, device, [*SUBJECTS], rounds)
    date = time.strftime("%Y-%m-%d", time.gmtime())
    made = {"machine": machine(device), "date": date, "rounds": args.rounds, "results": results}
    args.out.write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")
    print(table(results), args.out, sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
