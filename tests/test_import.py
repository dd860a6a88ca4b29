"""Importing the package touches neither CUDA nor a compiler, and brings nothing of the extras."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

pytestmark = pytest.mark.processes
PROGRAM = """
import inspect, json, sys
import numpy, torch, torch.optim
real, LOOKED = inspect.getmodule, []
inspect.getmodule = lambda *what: (LOOKED.append(str(what[0])), real(*what))[1]
# torch itself imports cuda.bindings where that is installed, which asks for CUDA's folders.
before = set(sys.modules)
CHILDREN.clear()
import opt3dgs_optim
print(json.dumps({
    "cuda_started": torch.cuda.is_initialized(),
    "modules": [name for name in set(sys.modules) - before if name.split(".")[0] in FORBIDDEN],
    "foreign": [n for n in set(sys.modules) - before if n.split(".")[0] != "opt3dgs_optim"],
    "looked_at_every_module": LOOKED,
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


@pytest.fixture(scope="module")
def found() -> dict:
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", SPY + PROGRAM],
        check=True,
        capture_output=True,
        text=True,
    )
    return json.loads(run.stdout)


def test_import_touches_neither_cuda_nor_a_compiler(found: dict) -> None:
    assert not found["cuda_started"]
    assert found["modules"] == []
    assert found["children"] == []


def test_import_costs_the_package_alone(found: dict) -> None:
    """No module beyond torch's and numpy's, and no search through all that are loaded."""
    assert found["foreign"] == []
    assert found["looked_at_every_module"] == []
