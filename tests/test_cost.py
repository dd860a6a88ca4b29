"""What an iteration costs: operators that torch dispatches, and calls that a reader follows."""

from __future__ import annotations

import statistics
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch
from torch.nn import Parameter
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from trainers import gsplat_optimizers, make_splats

import opt3dgs_optim
from opt3dgs_optim import EnergyHistogram, PhaseScheduler
from opt3dgs_optim.lbfgs import lqn_direction

PACKAGE = str(Path(opt3dgs_optim.__file__).parent)
EXPLORING, EXPLOITING = 5_000, 29_500  # fading is on in the first
PLAIN = 24  # six fused Adams
MOST = {"none": PLAIN + 2, "defaults": 44, "exploitation": 80, "histogram": 56}


class Counter(TorchDispatchMode):
    """Counts every operator."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return func(*args, **(kwargs or {}))


def iterations(
    splats: dict[str, Parameter], optimizers: Any, phases: Any, first: int, many: int
) -> list[int]:
    """Operators of every iteration."""
    draw = torch.Generator().manual_seed(1)
    counts = []
    for iteration in range(first, first + many):
        for param in splats.values():
            param.grad = 1e-4 * torch.randn(param.shape, generator=draw)
        loss = torch.rand((), generator=draw) * 0.2
        with Counter() as counter:
            if phases is not None:
                phases.observe(loss, iteration=iteration)
            for optimizer in optimizers.values():
                optimizer.step()
        counts.append(counter.count)
    return counts


def operators(phases: PhaseScheduler | None, first: int) -> int:
    """The median over iterations: what a run pays. Those of a fading event cost more."""
    splats = make_splats(50)
    optimizers = gsplat_optimizers(splats, fused=True)
    if phases is not None:
        phases.upgrade(optimizers)
        iterations(splats, optimizers, phases, EXPLORING, 20)
    iterations(splats, optimizers, phases, first - 10, 10)
    return int(statistics.median(iterations(splats, optimizers, phases, first, 30)))


def test_six_fused_adams_are_the_measure() -> None:
    assert operators(None, EXPLORING) == PLAIN


def as_a_kernel(*given: Any, **options: Any) -> Any:
    """The curvature's step, counted as on a GPU: three outputs and a launch."""
    with _disable_current_modes():
        result = lqn_direction(*given, **options)
    return tuple(torch.empty_like(each).copy_(each) for each in result)


@pytest.mark.parametrize("case", ["none", "defaults", "exploitation", "histogram"])
def test_operators_per_iteration(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("opt3dgs_optim.parts.curvature.lqn_direction", as_a_kernel)
    phases = {
        "none": lambda: PhaseScheduler(30_000, parts=[]),
        "defaults": lambda: PhaseScheduler(30_000),
        "exploitation": PhaseScheduler.paper,
        "histogram": lambda: PhaseScheduler(30_000, parts=[EnergyHistogram(warmup=8)]),
    }[case]()
    found = operators(phases, EXPLOITING if case == "exploitation" else EXPLORING)
    assert found <= MOST[case]


def exploiting_step() -> list[tuple[str, str]]:
    """(file, function) of every call of the package in `means.step()`, as a reader follows it."""
    splats = make_splats(50)
    phases = PhaseScheduler.paper(300)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    iterations(splats, optimizers, phases, 291, 6)
    phases.observe(torch.tensor(0.1), iteration=297)
    splats["means"].grad = torch.ones(50, 3)
    calls: list[tuple[str, str]] = []

    def follow(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGE):
            calls.append((code.co_filename.removeprefix(PACKAGE), code.co_name))

    before = sys.getprofile()
    sys.setprofile(follow)
    try:
        optimizers["means"].step()
    finally:
        sys.setprofile(before)
    return [call for call in calls if not call[1].startswith("<")]


def test_the_path_of_a_gradient_through_an_exploiting_step_is_short() -> None:
    assert len(exploiting_step()) <= 110


def test_the_path_of_a_gradient_is_in_few_files() -> None:
    files = {file for file, _ in exploiting_step()}
    assert len(files) <= 13, sorted(files)
