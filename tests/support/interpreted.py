"""The step's kernels by Triton's interpreter, on tensors of the CPU, in the tests' own process."""

from __future__ import annotations

import importlib.util
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from step_cases import interprets

from opt3dgs_optim import triton as package


def fresh_kernels(environment: dict[str, str]) -> ModuleType:
    """The kernels' module once more, by itself.

    The environment is read while functions are decorated; the kernels use none of Triton's own.
    """
    pytest.importorskip("triton.language", reason="Triton is not installed")
    spec = importlib.util.find_spec("opt3dgs_optim.triton.kernels")
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        spec.loader.exec_module(made)
    return made


def interpreted_kernels(patch: pytest.MonkeyPatch) -> ModuleType:
    """The kernels for the interpreter, which take the place of those in use."""
    made = fresh_kernels({"TRITON_INTERPRET": "1"})
    quiet = Quiet(made)
    patch.setattr(package, "_kernels", lambda: quiet)
    patch.setattr(package, "_COMPILED", {})
    if not interprets():
        pytest.skip("the interpreter of this Triton writes nothing")
    return made


class Quiet:
    """Kernels for the interpreter, without numpy's warnings of what is not finite."""

    def __init__(self, kernels: Any) -> None:
        self.kernels = kernels

    def __getattr__(self, name: str) -> Any:
        return _Launcher(self.run, name)

    def run(self, name: str, grid: Any, args: Any, kwargs: Any) -> None:
        """Launch a kernel; up to Triton 3.5 the interpreter leaves `triton.language` patched."""
        language = self.kernels.tl
        owners = (language, language.core, language.math, language.tensor, language.dtype)
        before = [dict(vars(owner)) for owner in owners]
        try:
            with np.errstate(all="ignore"):
                getattr(self.kernels, name)[grid](*args, **kwargs)
        finally:
            for owner, values in zip(owners, before, strict=True):
                for key, value in vars(owner).copy().items():
                    if key not in values:
                        delattr(owner, key)
                    elif value is not values[key]:
                        setattr(owner, key, values[key])


class _Launcher:
    def __init__(self, run: Any, name: str) -> None:
        self.run, self.name = run, name

    def __getitem__(self, grid: Any) -> Any:
        return lambda *args, **kwargs: self.run(self.name, grid, args, kwargs)
