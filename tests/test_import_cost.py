"""Importing the package is cheap and touches neither CUDA nor a compiler."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys

PROGRAM = """
import json, sys, time
import torch, torch.optim
# torch itself imports cuda.bindings where that is installed, which asks for CUDA's folders.
before = set(sys.modules)
CHILDREN.clear()
begin = time.perf_counter()
import opt3dgs_optim
seconds = time.perf_counter() - begin
print(json.dumps({
    "seconds": seconds,
    "cuda_started": torch.cuda.is_initialized(),
    "modules": [name for name in set(sys.modules) - before if name.split(".")[0] in FORBIDDEN],
    "children": CHILDREN,
}))
"""
# A child process would be a compiler or a question to the driver.
SPY = """
CHILDREN = []
FORBIDDEN = ("cuda", "triton", "matplotlib", "numba", "pynvml")
import sys
sys.addaudithook(lambda name, args: CHILDREN.append(name)
                 if name in ("subprocess.Popen", "os.posix_spawn", "os.fork") else None)
"""


def measure() -> dict:
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", SPY + PROGRAM],
        check=True,
        capture_output=True,
        text=True,
    )
    return json.loads(run.stdout)


def test_import_costs_less_than_50_ms_beyond_torch() -> None:
    runs = [measure() for _ in range(7)]
    assert min(run["seconds"] for run in runs) < 0.05, runs
    assert statistics.median(run["seconds"] for run in runs) < 0.15  # a busy machine


def test_import_touches_neither_cuda_nor_a_compiler() -> None:
    run = measure()
    assert not run["cuda_started"]
    assert run["modules"] == []
    assert run["children"] == []
