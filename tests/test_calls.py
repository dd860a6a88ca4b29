"""What Python enters of the package in an iteration of the defaults."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest
import torch
from torch.nn import Parameter
from torch.optim import Adam

import opt3dgs_optim
from opt3dgs_optim import PhaseScheduler

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


def six() -> dict[str, Any]:
    """An Adam for each parameter, with gradients."""
    adams = {}
    for name, shape in SHAPES.items():
        param = Parameter(torch.randn(ROWS, *shape))
        param.grad = torch.randn(ROWS, *shape)
        adams[name] = Adam([param], lr=0.01, eps=1e-15)
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
