"""3DGRUT and fVDB reality capture: their optimizers, density control and checkpoints on a CPU.

`python -m pytest -m hosts tests/hosts` with OPT3DGS_TRAINERS, as for `test_trainers.py`.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys

import pytest
import without_renderer
from trials import TRAINERS

pytestmark = pytest.mark.hosts


@pytest.mark.parametrize(
    ("name", "folder", "kinds"), [("3dgrut", "3dgrut", 4), ("fvdb", "fvdb-0.6.0", 2)]
)
def test_trained_edited_saved_and_resumed(name: str, folder: str, kinds: int) -> None:
    """Bit for bit the trainer's own without parts, and through its checkpoint."""
    if not (TRAINERS / folder).is_dir():
        pytest.skip(f"no {TRAINERS / folder}: put its sources there, set OPT3DGS_TRAINERS")
    if name == "3dgrut" and not all(map(importlib.util.find_spec, ("hydra", "sklearn"))):
        pytest.skip("3dgrut needs hydra-core and scikit-learn: pip install them")
    command = [sys.executable, without_renderer.__file__, name, str(TRAINERS / folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.partition(without_renderer.BEFORE)[2])
    assert len(found) == kinds
    for kind, held in found.items():
        assert held["points"][0] != held["points"][1], kind
        assert held["resumed at"] == without_renderer.ITERATIONS // 2, kind
        assert all(value for value in held.values() if isinstance(value, bool)), (kind, held)
