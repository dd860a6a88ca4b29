"""What Python does in an iteration of the defaults: what it enters, and how long it takes.

`python tests/test_calls.py` prints both. The time is that of six steps on a GPU whose kernels are
launched and do nothing, as a share of torch's six fused Adams on the CPU.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest
import torch
from torch.nn import Parameter
from torch.optim import Adam

import opt3dgs_optim
from opt3dgs_optim import PhaseScheduler, device, triton

ROOT = os.path.dirname(opt3dgs_optim.__file__)
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
SHAPES["shN"] = (15, 3)
TOTAL, ROWS = 30_000, 50
# Functions, files and calls, of most iterations and at most.
MOST = {
    "upgrade": (52, 8, 195),
    "iteration": (25, 9, 80),
    "iteration, at most": (33, 11, 90),  # one that looks who is out of view
    "last thirtieth": (33, 12, 112),
    "last thirtieth, at most": (36, 13, 118),
}


def six(**options: Any) -> dict[str, Any]:
    """An Adam for each parameter, with gradients."""
    adams = {}
    for name, shape in SHAPES.items():
        param = Parameter(torch.randn(ROWS, *shape))
        param.grad = torch.randn(ROWS, *shape)
        adams[name] = Adam([param], lr=0.01, eps=1e-15, **options)
    return adams


def step(adams: dict[str, Any]) -> None:
    for adam in adams.values():
        adam.step()


def entered(call: Callable[[], Any]) -> tuple[int, int, int]:
    """How many functions of the package, in how many files, were entered in how many calls."""
    calls: Counter[tuple[str, int]] = Counter()

    def count(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(ROOT):
            calls[code.co_filename, code.co_firstlineno] += 1

    sys.setprofile(count)
    try:
        call()
    finally:
        sys.setprofile(None)
    return len(calls), len({file for file, _ in calls}), calls.total()


def counted() -> dict[str, tuple[int, int, int]]:
    adams, phases = six(), PhaseScheduler(TOTAL)
    found = {"upgrade": entered(lambda: phases.upgrade(adams))}
    for name, iteration in (("iteration", 20_000), ("last thirtieth", 29_900)):
        phases.observe(iteration=iteration)
        step(adams)
        each = sorted(entered(lambda: step(adams)) for _ in range(24))
        found[name], found[f"{name}, at most"] = each[len(each) // 2], each[-1]
    return found


def test_an_iteration_enters_few_functions(capsys: pytest.CaptureFixture[str]) -> None:
    found = counted()
    with capsys.disabled():
        print(*(f"\n{name}: functions, files, calls {now}" for name, now in found.items()))
    for name, now in found.items():
        assert all(each <= most for each, most in zip(now, MOST[name], strict=True)), name


# -- how long --------------------------------------------------------------------------------------


class Launched(dict):
    """Compiled kernels that do nothing."""

    function = packed_metadata = None

    def get(self, key: Any, default: Any = None) -> Any:
        return self

    def run(self, *_: Any) -> None:
        """Nothing."""


def microseconds(adams: dict[str, Any], iterations: int = 30) -> float:
    begin = time.process_time()
    for _ in range(iterations):
        step(adams)
    return (time.process_time() - begin) / iterations * 1e6


def python_time(rounds: int = 40) -> dict[str, float]:
    """Of six steps, in microseconds: medians of rounds, one beside the other."""
    counter = torch.zeros(1, dtype=torch.int32)
    patch = pytest.MonkeyPatch()
    patch.setattr(triton, "_COMPILED", Launched())
    patch.setattr(triton, "takes", triton.fits)
    patch.setattr(triton, "_stand_in", lambda step, _: step)
    patch.setattr(triton, "looks", lambda _: True)
    patch.setattr(torch._C, "_cuda_getCurrentRawStream", lambda _: 0, raising=False)
    patch.setattr(device.BadNumbers, "counter_on", lambda *_: counter)
    arms = {"fused Adams": six(fused=True)}
    for name, iteration in (("the defaults", 600_000), ("the last thirtieth", 980_000)):
        arms[name] = six()
        phases = PhaseScheduler(1_000_000)
        phases.upgrade(arms[name])
        phases.observe(iteration=iteration)
    times: dict[str, list[float]] = {name: [] for name in arms}
    for _ in range(rounds):
        for name, adams in arms.items():
            microseconds(adams, 3)
            times[name].append(microseconds(adams))
    patch.undo()
    return {name: statistics.median(found) for name, found in times.items()}


if __name__ == "__main__":
    torch.set_num_threads(1)
    for name, now in counted().items():
        print(f"{name}: {now[0]} functions in {now[1]} files with {now[2]} calls")
    found = python_time()
    for name, now in found.items():
        print(f"{name}: {now:.0f} us, {now / found['fused Adams']:.2f} of six fused Adams")
