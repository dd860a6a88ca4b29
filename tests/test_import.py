"""Importing the package touches neither CUDA nor a compiler, and brings nothing of the extras."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

PROGRAM = """
import json, sys
import torch, torch.optim
# torch itself imports cuda.bindings where that is installed, which asks for CUDA's folders.
before = set(sys.modules)
CHILDREN.clear()
import opt3dgs_optim
print(json.dumps({
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

import pytest
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


@pytest.mark.processes
def test_import_touches_neither_cuda_nor_a_compiler() -> None:
    run = measure()
    assert not run["cuda_started"]
    assert run["modules"] == []
    assert run["children"] == []
