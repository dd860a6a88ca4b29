"""A driver for Triton that compiles for sm_90 and launches nothing, on a machine without a GPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest


class FakeDriver:
    """What Triton's launcher asks of a driver; `launched` counts what it would have launched."""

    def __init__(self) -> None:
        from triton.backends.compiler import GPUTarget

        self.target, self.launched, self.names = GPUTarget("cuda", 90, 32), 0, []
        self.utils = SimpleNamespace(
            load_binary=self._load,
            get_device_properties=lambda _device: {"max_shared_mem": 1 << 17},
        )

    def _load(self, name: str, *_: Any) -> tuple[Any, ...]:
        self.names.append(name)
        return object(), 0, 32, 0, 1024

    def launcher_cls(self, src: Any, metadata: Any) -> Any:
        """A launcher that counts."""

        def launch(*_: Any) -> None:
            self.launched += 1

        return launch

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return 0

    def get_current_target(self) -> Any:
        return self.target


@contextmanager
def fake_driver() -> Iterator[FakeDriver]:
    """Triton's driver is a fake one within."""
    from triton.runtime import driver

    made = FakeDriver()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "_active", made, raising=False)
        assert driver.active is made
        yield made
