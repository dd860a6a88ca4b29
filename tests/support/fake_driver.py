"""A driver for Triton that compiles for sm_90 and launches nothing, on a machine without a GPU."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import pytest
import torch


class FakeDriver:
    """What Triton's launcher asks of a driver; `launched` has what it would have launched."""

    def __init__(self) -> None:
        import triton
        from triton.backends.compiler import GPUTarget

        self.version = tuple(map(int, triton.__version__.split(".")[:2]))
        self.target = GPUTarget("cuda", 90, 32)
        self.launched: list[tuple[Any, ...]] = []  # grid and arguments
        self.loaded: list[str] = []  # the kernels, once for each time that one was compiled
        self.utils = SimpleNamespace(
            load_binary=self._load,
            unload_module=lambda _module: None,
            get_device_properties=lambda _device: {"max_shared_mem": 1 << 17},
        )

    def _load(self, name: str, *_: Any) -> tuple[Any, ...]:
        self.loaded.append(name)
        found = (object(), 0, 32, 0, 1024)  # module, function, registers, spills, threads
        return found if self.version >= (3, 4) else found[:4]

    def launcher_cls(self, src: Any, metadata: Any) -> Any:
        """A launcher that notes."""

        def launch(*args: Any) -> None:
            self.launched.append((*args[:3], *args[9:]))  # between them: streams, hooks, metadata

        return launch

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return 0

    def get_current_target(self) -> Any:
        return self.target


@functools.cache
def fake_driver() -> FakeDriver:
    """Triton's driver from now on; kernels that were compiled for it ask it until they are gone."""
    from triton.runtime import driver

    if torch.cuda.is_available():
        pytest.skip("there is a GPU, whose driver Triton has")
    made = FakeDriver()
    driver.set_active(made)  # pyright: ignore[reportArgumentType]
    return made
