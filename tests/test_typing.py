"""The documented lines, as type checkers see them."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.processes

ROOT = Path(__file__).resolve().parents[1]
LINES = '''
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, Optimizer

from opt3dgs_optim import (
    AWSGLD, DEFAULTS, Averaging, Training, Curvature, EnergyHistogram,
    Fading, FreshMoments, IsotropicNoise, LQNAdam, OwnFrame, Part, Phase,
    PhaseScheduler, PositionNoise, SquaredLoss, backend_info, two_loop,
)
from opt3dgs_optim.step import Step


class Trainer:
    """gsplat's, with the three lines."""

    def __init__(self, optimizers: dict[str, Optimizer], max_steps: int) -> None:
        self.optimizers = optimizers
        self.phases = PhaseScheduler(max_steps)
        self.phases.upgrade(self.optimizers)


class Gaussians:
    """INRIA's."""

    optimizer: Adam

    def __init__(self, iterations: int) -> None:
        self.optimizer = Adam([{"params": [Parameter(torch.ones(3))], "name": "xyz"}])
        phases = PhaseScheduler(iterations, parts=DEFAULTS[1:])
        self.optimizer = phases.upgrade(self.optimizer)
        phases.observe(iteration=0)
        phases.finish()


adams: dict[str, Adam] = {}
upgraded: dict[str, Adam] = PhaseScheduler(10).upgrade(adams)


class SignAgreement(Part):
    during: ClassVar[Phase | None] = Phase.EXPLOITATION

    def plan(self, step: Step, training: Training) -> None:
        step.factor *= 2.0
        step.grad = torch.where(step.grad * step.state["exp_avg"] < 0, 0.0, step.grad)


parts: list[Part] = [*DEFAULTS, SignAgreement()]
phases = PhaseScheduler(30_000, parts=parts, switch=0.9)
phases = PhaseScheduler(30_000, parts=[OwnFrame(0.2), Fading(seed=3)])
phases = PhaseScheduler(300, parts=[FreshMoments(), SquaredLoss(), Curvature(history_size=3)])
phases = PhaseScheduler.paper(total_steps=3_000)
phase: Phase = phases.phase
loss: Tensor = phases.pixel_loss(torch.ones(3), torch.ones(3))
phases.observe(loss)
points = Parameter(torch.ones(4, 3))
phases = PhaseScheduler(30, parts=[PositionNoise(scale=5e5), Averaging()])
a = AWSGLD([points], lr=0.1, histogram=EnergyHistogram(), noise=IsotropicNoise(0.1))
b = LQNAdam([points], lr=0.1, betas=(0.9, 0.99), history_size=5)
b.step()
a.step(lambda: torch.ones(()))
direction: Tensor = two_loop(torch.ones(4, 3), torch.zeros(4, 5, 8), 5)
print(backend_info("cpu"), phase)
'''
WRONG = (  # each is an error
    "PhaseScheduler(10, parts=[1.0])",
    "PhaseScheduler(10, annealing=None)",
    "AWSGLD([], histroy=None)",
    'Fading(share="much")',
)


def test_pyright_takes_the_documented_lines_and_refuses_wrong_ones(tmp_path: Path) -> None:
    pyright = shutil.which("pyright", path=str(Path(sys.executable).parent))
    if pyright is None:
        pytest.skip("pyright is not installed")
    (tmp_path / "pyrightconfig.json").write_text(
        f'{{"extraPaths": ["{ROOT / "src"}"], "typeCheckingMode": "standard"}}'
    )
    check([pyright, "--pythonpath", sys.executable], tmp_path)


def test_mypy_takes_the_documented_lines_and_refuses_wrong_ones(tmp_path: Path) -> None:
    if importlib.util.find_spec("mypy") is None:
        pytest.skip("mypy is not installed")
    options = ["--follow-imports=silent", "--cache-dir", str(tmp_path / "cache")]
    check([sys.executable, "-m", "mypy", *options], tmp_path)


def check(command: list[str], folder: Path) -> None:
    """The lines are fine; with the wrong ones there is an error at each of these."""
    good, bad = folder / "good.py", folder / "bad.py"
    good.write_text(LINES)
    bad.write_text(LINES + "\n".join(WRONG) + "\n")
    env = {**os.environ, "MYPYPATH": str(ROOT / "src")}
    run = subprocess.run(
        [*command, str(good), str(bad)],
        cwd=folder,
        env=env,
        capture_output=True,
        text=True,
        check=False,  # it exits with 1: there are errors
    )
    said = [line for line in run.stdout.splitlines() if "error" in line and ".py:" in line]
    assert [line for line in said if "good.py" in line] == [], run.stdout + run.stderr
    first = LINES.count("\n") + 1
    for number, wrong in enumerate(WRONG, first):
        assert any(f"bad.py:{number}:" in line for line in said), (wrong, run.stdout, run.stderr)
