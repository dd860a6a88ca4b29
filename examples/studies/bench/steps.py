"""What a step costs beside six torch Adams: time, operators, launches, waits, memory."""

from __future__ import annotations

import gc
import importlib.util
import random
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from studies.bench.subjects import BASELINES, NUMBERS, SUBJECTS, Case
from studies.pages import table

BASELINE = next(iter(SUBJECTS))
COMPARED = tuple(name for name in SUBJECTS if name not in (BASELINE, *BASELINES.values()))
ADAM_BYTES = 28 * NUMBERS  # parameter, gradient and two moments read; all but the gradient written
# What a subject must read and write of a point at least, where that is known.
LEAST_BYTES = {
    "six Adams again": ADAM_BYTES,
    "defaults": ADAM_BYTES,
    "defaults, last thirtieth": ADAM_BYTES + 2 * 4 * NUMBERS,  # and the mean, read and written
    "the paper's exploration": ADAM_BYTES,
    "the paper's exploitation": ADAM_BYTES + 2 * 160,  # and the history
    "two-loop, [N, 3] in and out": 144,
    "copy of 144 bytes": 288,
}
SWEPT_NUMBERS = 1 << 24  # float32: 64 MB, more than a core's caches
WARM_UP = 3  # calls before anything is measured: compilation, allocation
READS = "aten._local_scalar_dense.default"  # a value that Python asks for
Row = dict[str, Any]
Results = dict[int, dict[str, Row]]  # points -> subject -> row


class Operators(TorchDispatchMode):
    """Counts operators, and those that read a value, which on a GPU waits for it."""

    count = 0
    reads = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        self.reads += str(func) == READS
        return func(*args, **(kwargs or {}))


def measure_all(
    points: int,
    device: torch.device,
    names: Sequence[str],
    repeats: int,
    *,
    makes: int = 1,
    together: bool = False,
) -> dict[str, Row]:
    """Every subject of that name: its time, its ratio to six Adams, launches and memory.

    A subject for which the memory does not suffice has `skipped` with the reason. The row of six
    Adams is of their medians beside the others.

    Args:
        repeats: rounds.
        makes: how often everything is made anew, see `rounds_of`.
        together: all of them in one round. Otherwise each has rounds with its baseline alone, which
            needs the memory of two.
    """
    made: dict[str, Row] = {BASELINE: {}}
    for name in names:
        made[name] = attempt(lambda name=name: counts_of(Case(points, device), name), device)
    for group in [names] if together else [[name] for name in names]:
        known = [name for name in group if "skipped" not in made[name]]
        if known:
            times = attempt(
                lambda k=known: times_of(Case(points, device), k, repeats, makes), device
            )
            for name in known:
                made[name] |= times.get(name, times)
    theirs = [row["baseline_ns"] for row in made.values() if row.get("baseline") == BASELINE]
    if not theirs:
        raise ValueError(f"measure_all: none of {', '.join(names)} could be measured at {points:,}")
    made[BASELINE] = {"ns_per_point": statistics.median(theirs), "per_adam": 1.0}
    return made


def attempt(work: Callable[[], dict[str, Any]], device: torch.device) -> dict[str, Any]:
    """What the work returns, or why the memory did not suffice."""
    release(device)
    try:
        return work()
    except torch.OutOfMemoryError as error:
        return {"skipped": str(error).splitlines()[0]}


def counts_of(case: Case, name: str) -> Row:
    """What a subject keeps beside parameters and gradients, and what one step of it does."""
    before = bytes_in_use(case.device)
    call = SUBJECTS[name](case)
    for _ in range(WARM_UP):
        call()
    release(case.device)
    kept = bytes_in_use(case.device) - before
    return {"bytes_per_point": kept / case.points, **count(call, case.device)}


def times_of(case: Case, names: Sequence[str], repeats: int, makes: int) -> dict[str, Row]:
    """Nanoseconds per point of the subjects, and their ratios to their baselines in each round."""
    versus = {name: BASELINES.get(name, BASELINE) for name in names}
    rounds = rounds_of(case, [*dict.fromkeys([*versus.values(), *names])], repeats, makes)
    made: dict[str, Row] = {}
    for name in names:
        ours, theirs = ([1e9 * s / case.points for s in rounds[n]] for n in (name, versus[name]))
        row: Row = {"baseline": versus[name], "baseline_ns": statistics.median(theirs)}
        row["ns_low"], row["ns_per_point"], row["ns_high"] = quartiles(ours)
        ratios = [a / b for a, b in zip(ours, theirs, strict=True)]
        row["adam_low"], row["per_adam"], row["adam_high"] = quartiles(ratios)
        if name in LEAST_BYTES:
            row["gb_per_second"] = LEAST_BYTES[name] / row["ns_per_point"]
        made[name] = row
    return made


def rounds_of(case: Case, names: Sequence[str], repeats: int, makes: int) -> dict[str, list[float]]:
    """Seconds of a call of every subject, one entry per round.

    A round times each once, so that a busy machine slows all of them. All are made anew `makes`
    times, in another order, since where their tensors lie in memory changes the time of a step by a
    tenth. Before each call a CPU's caches are filled with something else, as rendering does.
    """
    other = torch.zeros(SWEPT_NUMBERS if case.device.type == "cpu" else 0)
    rounds: dict[str, list[float]] = {name: [] for name in names}
    order, chance = list(names), random.Random(0)
    for make in range(min(makes, repeats)):
        calls = {name: SUBJECTS[name](case) for name in order}
        for name in order * WARM_UP:
            calls[name]()
        for _ in range(make, repeats, makes):
            for name in order:
                other.add_(1)
                rounds[name].append(timed(calls[name], case.device))
        calls.clear()  # before the next are made
        release(case.device)
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


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """Lower quartile, median, upper quartile."""
    if len(values) < 2:
        return values[0], values[0], values[0]
    low, middle, high = statistics.quantiles(values, n=4, method="inclusive")
    return low, middle, high


def count(call: Callable[[], Any], device: torch.device) -> dict[str, int]:
    """Of one call: operators and, on a GPU, kernels, waits and the most memory beside what is kept.

    On a CPU `waits` are the values that are read, each of which would wait on a GPU.
    """
    with Operators() as operators:
        call()
    if device.type != "cuda":
        return {"operators": operators.count, "waits": operators.reads}
    return {"operators": operators.count, **count_on_gpu(call, device)}


def count_on_gpu(call: Callable[[], Any], device: torch.device) -> dict[str, int]:
    """Kernels and copies that the profiler sees, waits that torch warns of, the most memory."""
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
    on_device = [
        event
        for event in profiler.events() or ()
        # Beside kernels and copies a trace has the optimizers' own marks.
        if str(event.device_type).endswith("CUDA") and not event.name.startswith("Optimizer.")
    ]
    waits = sum("called a synchronizing" in str(warning.message) for warning in caught)
    return {"launches": len(on_device), "waits": waits, "peak_bytes": peak}


def bytes_in_use(device: torch.device) -> int:
    """Bytes of tensors on a device; on a CPU of those that Python holds."""
    if device.type == "cuda":
        return torch.cuda.memory_allocated(device)
    kept = (each for each in gc.get_objects() if issubclass(type(each), torch.Tensor))
    storages = {each.untyped_storage().data_ptr(): each.untyped_storage().nbytes() for each in kept}
    return sum(storages.values())


def release(device: torch.device) -> None:
    """Free what nobody holds any more."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()


# -- what is shown ---------------------------------------------------------------------------------


def times_table(results: Results) -> str:
    """Markdown: a row per subject; per number of points its time and the ratio to its baseline."""

    def cell(row: Row) -> str:
        if "skipped" in row:
            return f"not run: {row['skipped']}"
        spread = f" ({row['adam_low']:.2f} to {row['adam_high']:.2f})" if "adam_low" in row else ""
        return f"{row['ns_per_point']:.3g} ns, x{row['per_adam']:.2f}{spread}"

    names = next(iter(results.values()))
    rows = [(name, *(cell(rows[name]) for rows in results.values())) for name in names]
    return table(("", *(f"{n:,} points" for n in results)), "lr", rows)


def counts_table(results: Results) -> str:
    """Markdown: what a step launches, waits for, keeps and moves, at the most points measured."""
    rows, on_device = [], False
    for name in next(iter(results.values())):
        points = max((n for n, found in results.items() if "waits" in found[name]), default=0)
        if not points:
            continue
        row = results[points][name]
        on_device |= "launches" in row
        rate = f"{row['gb_per_second']:,.0f}" if "gb_per_second" in row else "-"
        peak = f"{row['peak_bytes'] / points:,.0f}" if "peak_bytes" in row else "-"
        kept, launches = f"{row['bytes_per_point']:,.0f}", row.get("launches", row["operators"])
        rows.append((name, f"{points:,}", launches, row["waits"], kept, peak, rate))
    counted = ("launches", "waits") if on_device else ("operators", "values read")
    heads = ("", "points", *counted, "bytes kept per point", "more within the step")
    return table((*heads, "GB/s, at least"), "lr", rows)


def draw(results: Results, title: str, path: Path) -> bool:
    """Nanoseconds per point and ratios over the number of points; False without matplotlib."""
    if importlib.util.find_spec("matplotlib") is None:
        return False
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(10, 4.6), layout="constrained")
    for index, name in enumerate(next(iter(results.values()))):
        known = {n: rows[name] for n, rows in results.items() if "skipped" not in rows[name]}
        for axis, key, ends in zip(axes, ("ns_per_point", "per_adam"), ("ns", "adam"), strict=True):
            values = [row[key] for row in known.values()]
            low = [row[key] - row.get(f"{ends}_low", row[key]) for row in known.values()]
            high = [row.get(f"{ends}_high", row[key]) - row[key] for row in known.values()]
            style = "o-" if index < 10 else "s--"  # matplotlib has ten colours
            axis.errorbar(list(known), values, [low, high], fmt=style, capsize=3, label=name)
    axes[0].set(xscale="log", yscale="log", xlabel="points", ylabel="ns per point", title=title)
    axes[1].set(xscale="log", yscale="log", xlabel="points", ylabel="times six torch Adams")
    axes[1].axhline(1.0, color="black", linewidth=0.8)
    for axis in axes:
        axis.grid(alpha=0.3)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return True
