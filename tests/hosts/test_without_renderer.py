"""3DGRUT and fVDB reality capture: their optimizers, density control and checkpoints on a CPU.

`python -m pytest -m hosts tests/hosts` with OPT3DGS_TRAINERS, as for `test_trainers.py`.
"""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hosts import without_renderer

TRAINERS = Path(os.environ.get("OPT3DGS_TRAINERS", "/no/trainers"))

pytestmark = pytest.mark.hosts


def installed_fvdb() -> Path:
    """Where the package index's fVDB reality capture is; skips where it is not."""
    spec = importlib.util.find_spec("fvdb_reality_capture")
    if spec is None or spec.origin is None:
        pytest.skip("no fVDB: pip install --no-deps fvdb-reality-capture==0.6.0")
    return Path(spec.origin).parents[1]


@pytest.mark.parametrize(
    ("name", "folder"),
    [("3dgrut", "3dgrut"), ("fvdb", "fvdb-reality-capture"), ("fvdb", "installed")],
)
def test_trained_edited_saved_and_resumed(name: str, folder: str) -> None:
    """Bit for bit the trainer's own without parts, and through its checkpoint."""
    sources = installed_fvdb() if folder == "installed" else TRAINERS / folder
    if not sources.is_dir():
        pytest.skip(f"no {sources}: put its sources there, set OPT3DGS_TRAINERS")
    needed = {"hydra": "hydra-core", "tensorboard": "tensorboard"} if name == "3dgrut" else {}
    missing = [
        package for module, package in needed.items() if not importlib.util.find_spec(module)
    ]
    if missing:
        pytest.skip(f"3dgrut needs {', '.join(missing)}: pip install them")
    command = [sys.executable, without_renderer.__file__, name, str(sources)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.partition(without_renderer.BEFORE)[2])
    assert len(found) == {"3dgrut": 4, "fvdb-reality-capture": 1, "installed": 2}[folder]
    for kind, held in found.items():
        relocates = "mcmc" in kind.lower()
        assert held["switched off"] == ([] if relocates else ["Fading"]), kind
        assert held["points"][0] != held["points"][1]
        assert held["without parts the trainer's own"]
        assert held["with the default parts finite and another"]
        assert held["resumed at"] == without_renderer.ITERATIONS // 2
        assert held["resumed as uninterrupted"]
