"""What is asked of a device without a wait: numbers that are read later, and how many were bad."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class Reading:
    """Numbers of a device [n] that the host reads some time later, without a wait."""

    def __init__(self, source: Tensor) -> None:
        self.source = source
        self._host: Tensor | None = None
        self._ready: Any = None

    def ask(self) -> None:
        """Have a copy of the present numbers made."""
        source = self.source
        if source.is_cuda:
            self._host = torch.empty(
                source.shape, dtype=source.dtype, device="cpu", pin_memory=True
            ).copy_(source, non_blocking=True)
            self._ready = torch.cuda.Event()
            self._ready.record(torch.cuda.current_stream(source.device))
        else:
            self._host = source.clone()

    def take(self, wait: bool = False) -> list[Any] | None:
        """The numbers that were asked for last; None: they are on their way, or none were."""
        if self._host is None:
            return None
        if self._ready is not None and not self._ready.query():
            if not wait:
                return None
            self._ready.synchronize()
        return self._host.tolist()


class BadNumbers:
    """How many numbers of gradients were not finite; devices count theirs themselves."""

    def __init__(self) -> None:
        self._on_host = 0
        self._on_devices: dict[torch.device, int] = {}
        self._readings: dict[torch.device, Reading] = {}

    def add(self, numbers: int) -> None:
        """Take a number that the host knows."""
        self._on_host += numbers

    def counter_on(self, device: torch.device) -> Tensor | None:
        """[1] int32 to which a device adds how many there were; None for a CPU."""
        if device.type == "cpu":
            return None
        if device not in self._readings:
            self._readings[device] = Reading(torch.zeros(1, dtype=torch.int32, device=device))
        return self._readings[device].source

    def look(self) -> int:
        """How many there have been, as far as is known without a wait."""
        for device, reading in self._readings.items():
            (found,) = reading.take() or [0]
            self._on_devices[device] = max(self._on_devices.get(device, 0), abs(found))  # may wrap
            reading.ask()
        return self._on_host + sum(self._on_devices.values())

    def __getstate__(self) -> dict[str, Any]:  # what is on its way does not reach a copy
        return {**vars(self), "_readings": {}}


def num_ranks() -> int:
    """How many processes train together."""
    distributed = torch.distributed
    ready = distributed.is_available() and distributed.is_initialized()
    return distributed.get_world_size() if ready else 1
