"""The scene that the trainers are tried with, and the path of what runs them on a CPU."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BESIDE = ROOT.parent / "shared" / "scenes" / "banana"
sys.path.insert(0, str(ROOT / "examples/hosts/cpu"))


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small copy of the scene of OPT3DGS_SCENE; its folder's name is the original's."""
    from trials import copy_scene

    source = Path(os.environ.get("OPT3DGS_SCENE", BESIDE))
    if not (source / "images_4").is_dir():
        pytest.skip(f"no scene at {source}: set OPT3DGS_SCENE")
    return copy_scene(source, tmp_path_factory.mktemp("scene") / source.name)
