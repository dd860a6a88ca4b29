"""The examples in the public docstrings run."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import opt3dgs_optim

MODULES = [name for _, name, _ in pkgutil.walk_packages(opt3dgs_optim.__path__, "opt3dgs_optim.")]


@pytest.mark.parametrize("name", [name for name in MODULES if not name.endswith("__main__")])
def test_examples_run(name: str) -> None:
    if name == "opt3dgs_optim.nerfstudio":
        pytest.importorskip("nerfstudio", reason="nerfstudio is not installed: its users' module")
    result = doctest.testmod(importlib.import_module(name))
    assert result.failed == 0


@pytest.mark.parametrize("name", ["AWSGLD", "LQNAdam", "PhaseScheduler"])
def test_the_main_classes_have_one(name: str) -> None:
    assert ">>>" in getattr(opt3dgs_optim, name).__doc__
