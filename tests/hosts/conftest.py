"""The scene that the trainers are tried with."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hosts.trials import copy_scene

BESIDE = Path(__file__).resolve().parents[3] / "shared" / "scenes" / "banana"


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small copy of the scene of OPT3DGS_SCENE; its folder's name is the original's."""
    source = Path(os.environ.get("OPT3DGS_SCENE", BESIDE))
    if not (source / "images_4").is_dir():
        pytest.skip(f"no scene at {source}: set OPT3DGS_SCENE")
    return copy_scene(source, tmp_path_factory.mktemp("scene") / source.name)
