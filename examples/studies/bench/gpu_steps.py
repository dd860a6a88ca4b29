"""What a step costs, subject by subject beside six torch Adams: time, launches, waits, memory."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils._python_dispatch import TorchDispatchMode

from studies.bench.bench_step import BASELINE, quartiles, timed
from studies.bench.bench_subjects import SUBJECTS, Case

NUMBERS = 59  # of a Gaussian with harmonics of degree 3
ADAM_BYTES = 28 * NUMBERS  # parameter, gradient and two moments read; all but the gradient written
# What a subject must read and write of a point at least, where that is known.
LEAST_BYTES = {
    BASELINE: ADAM_BYTES,
    "six Adams again": ADAM_BYTES,
    "defaults": ADAM_BYTES,
    "defaults, last thirtieth": ADAM_BYTES + 2 * 4 * NUMBERS,  # and the mean, read and written
    "the paper's exploration": ADAM_BYTES,
    "the paper's exploitation": ADAM_BYTES + 2 * 160,  # and the history
    "two-loop, [N, 3] in and out": 144,
    "copy of 144 bytes": 288,
}
COMPARED = (
    "six Adams again",
    "defaults",
    "defaults, steps of a tenth",
    "defaults, last thirtieth",
    "the paper's exploration",
    "the paper's exploitation",
    "two-loop, [N, 3] in and out",
    "copy of 144 bytes",
)
WARM_UP = 3  # calls before anything is measured: compilation, allocation
READS = "aten._local_scalar_dense.default"  # a value that Python asks for


class Operators(TorchDispatchMode):
    """Counts operators, and those that read a value, which on a GPU waits for it."""

    count = 0
    reads = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        self.reads += str(func) == READS
        return func(*args, **(kwargs or {}))


def measure_all(points: int, device: torch.device, repeats: int) -> dict[str, dict[str, Any]]:
    """Every compared subject in turn with the baseline, two of them in memory at a time.

    A subject for which the memory does not suffice has `skipped` with the reason.
    """
    case, made = Case(points, device), {}
    for name in COMPARED:
        try:
            made[name] = measure(case, name, repeats)
        except torch.OutOfMemoryError as error:
            made[name] = {"skipped": str(error).splitlines()[0]}
        release(device)
    return made


def measure(case: Case, name: str, repeats: int) -> dict[str, Any]:
    """One subject: milliseconds, their ratio to the baseline's in the same round, and the rest."""
    release(case.device)
    before = bytes_in_use(case.device)
    call = SUBJECTS[name](case)
    for _ in range(WARM_UP):
        call()
    release(case.device)
    kept = bytes_in_use(case.device) - before
    counts = count(call, case.device)
    baseline = SUBJECTS[BASELINE](case)
    rounds: dict[str, list[float]] = {"ours": [], "theirs": []}
    for index in range(WARM_UP + repeats):
        for kind, each in (("theirs", baseline), ("ours", call)):
            seconds = timed(each, case.device)
            if index >= WARM_UP:
                rounds[kind].append(seconds)
    low, middle, high = quartiles([1e3 * seconds for seconds in rounds["ours"]])
    ratios = [a / b for a, b in zip(rounds["ours"], rounds["theirs"], strict=True)]
    made = {
        "ms": middle,
        "ms_low": low,
        "ms_high": high,
        "baseline_ms": quartiles([1e3 * seconds for seconds in rounds["theirs"]])[1],
        "ratio_low": quartiles(ratios)[0],
        "ratio": quartiles(ratios)[1],
        "ratio_high": quartiles(ratios)[2],
        "bytes_per_point": kept / case.points,
        **counts,
    }
    if name in LEAST_BYTES:
        made["gb_per_second"] = LEAST_BYTES[name] * case.points / middle / 1e6
    return made


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
