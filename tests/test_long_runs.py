"""A training of many steps: memory stays flat, and a kill at any point costs nothing."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from small_training import Training

SUPPORT = Path(__file__).parent / "support"
LENGTHS = [
    pytest.param(300, 3, id="short"),
    pytest.param(100_000, 40, id="long", marks=pytest.mark.slow),
]

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


def launch(folder: Path, steps: int) -> subprocess.Popen[bytes]:
    folder.mkdir(exist_ok=True)
    command = [
        sys.executable,
        str(SUPPORT / "small_training.py"),
        str(folder),
        "--steps",
        str(steps),
    ]
    return subprocess.Popen([*command, "--every", str(max(20, steps // 500))])


def written(path: Path) -> int:
    """When a file was last replaced, or 0 where there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


def memory(folder: Path) -> list[list[int]]:
    """[iteration, resident bytes, tensor bytes] of every tenth of a run."""
    lines = (folder / "memory.txt").read_text().splitlines()
    return [[int(word) for word in line.split()] for line in lines]


@pytest.mark.processes
@pytest.mark.parametrize(("steps", "kills"), LENGTHS)
def test_killed_and_resumed_it_ends_bit_for_bit_where_it_would(
    steps: int, kills: int, tmp_path: Path
) -> None:
    """SIGKILL, which no handler sees, at random points, also while a checkpoint is written."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert launch(whole, steps).wait() == 0
    chance, checkpoint, stopped = random.Random(0), killed / "checkpoint.pt", 0
    for _ in range(kills):
        before = written(checkpoint)
        process = launch(killed, steps)
        # How long a process takes to start says nothing: wait for a checkpoint of its own.
        while process.poll() is None and written(checkpoint) == before:
            time.sleep(0.001)
        time.sleep(chance.uniform(0.0, 0.03))
        process.send_signal(signal.SIGKILL)
        stopped += process.wait() == -signal.SIGKILL
    assert stopped > 0
    assert launch(killed, steps).wait() == 0
    ends = [torch.load(f / "checkpoint.pt", weights_only=True) for f in (whole, killed)]
    for name, value in ends[0]["splats"].items():
        assert torch.equal(value, ends[1]["splats"][name]), name
    for name in ends[0]["optimizers"]:
        states = [end["optimizers"][name] for end in ends]
        assert states[0]["param_groups"] == states[1]["param_groups"]
        for key, value in states[0]["state"][0].items():
            assert torch.equal(value, states[1]["state"][0][key]), key
    assert_flat(whole, steps)


def assert_flat(folder: Path, steps: int) -> None:
    """Nothing grows within a phase: no state, no graph."""
    for first, last in ((0.1, 0.6), (0.8, 1.0)):  # the pairs' history comes in between
        inside = [m for m in memory(folder) if first * steps <= m[0] <= last * steps]
        sizes = [size for _, _, size in inside]
        assert max(sizes) == min(sizes)
        # the allocator's own ups and downs, and the interpreter's
        assert inside[-1][1] - inside[0][1] < 8 * 2**20


@pytest.mark.thorough
def test_it_trains(tmp_path: Path) -> None:
    training = Training(tmp_path, 300)
    losses = [training.step() for _ in range(200)]  # up to the switch, where the loss is another
    assert sum(losses[-12:]) < 0.5 * sum(losses[:12])
