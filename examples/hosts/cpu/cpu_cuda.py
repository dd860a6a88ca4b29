"""CUDA mapped to the CPU: `device="cuda"`, `.cuda()`, `torch.cuda.*`, pinned memory, events."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch.overrides import TorchFunctionMode
from torch.utils.data import DataLoader


def on_cpu(value: Any) -> Any:
    """`value`, or the CPU where it names a CUDA device."""
    if isinstance(value, torch.device) and value.type == "cuda":
        return torch.device("cpu")
    if isinstance(value, str) and value.split(":")[0] == "cuda":
        return "cpu"
    return value


class CudaOnCpu(TorchFunctionMode):
    """Every torch function that is asked for a CUDA device gives a CPU tensor."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Replace the device, call the function."""
        name = getattr(func, "__name__", "")
        if name in ("cuda", "pin_memory") and args and isinstance(args[0], torch.Tensor):
            return args[0]
        kwargs = {key: on_cpu(value) for key, value in (kwargs or {}).items()}
        if name in ("to", "type"):
            args = tuple(on_cpu(a) for a in args)
            if len(args) == 2 and str(args[1]).startswith("torch.cuda."):
                args = (args[0], str(args[1]).replace("torch.cuda.", "torch."))
        return func(*args, **kwargs)


class Event:
    """torch.cuda.Event by the wall clock."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.at = 0.0

    def record(self, *_: Any) -> None:
        self.at = time.perf_counter()

    def elapsed_time(self, other: Event) -> float:
        """Milliseconds to the other event."""
        return 1e3 * (other.at - self.at)

    def query(self) -> bool:
        """All is done at once."""
        return True

    def synchronize(self) -> None:
        """Nothing to wait for."""


def install() -> None:
    """Put the CPU in CUDA's place for this process; there is no way back."""
    values = {
        "is_available": True,
        "device_count": 1,
        "current_device": 0,
        "get_device_name": "CPU",
        "memory_allocated": 0,
        "max_memory_allocated": 0,
        "memory_reserved": 0,
        "max_memory_reserved": 0,
        "is_current_stream_capturing": False,
        "current_stream": None,
        "is_bf16_supported": False,
        "get_device_capability": (0, 0),
    }
    for name, value in values.items():
        setattr(torch.cuda, name, lambda *_, _value=value, **__: _value)
    nothing = ("set_device", "synchronize", "empty_cache", "reset_peak_memory_stats", "init")
    for name in (*nothing, "manual_seed", "manual_seed_all", "ipc_collect"):
        setattr(torch.cuda, name, lambda *_, **__: None)
    torch.cuda.Event = Event  # pyright: ignore
    for kind in ("Float", "Int", "Long", "Bool", "Byte", "Double", "Half"):
        setattr(torch.cuda, f"{kind}Tensor", getattr(torch, f"{kind}Tensor"))
    _replace(torch, "load", _load(torch.load))
    _replace(torch.nn.Module, "cuda", lambda self, *_: self)
    _replace(DataLoader, "__init__", _in_process(DataLoader.__init__))
    CudaOnCpu().__enter__()


def _replace(owner: Any, name: str, value: Any) -> None:
    setattr(owner, name, value)


def _load(load: Any) -> Any:
    def loaded(*args: Any, **kwargs: Any) -> Any:
        return load(*args, **{**kwargs, "map_location": "cpu"})

    return loaded


def _in_process(init: Any) -> Any:
    """Loaders of a few small photos need no processes, and there is no memory to pin."""

    def initialised(self: Any, *args: Any, **kwargs: Any) -> None:
        plain = {"num_workers": 0, "persistent_workers": False, "pin_memory": False}
        init(self, *args, **{**kwargs, **plain, "prefetch_factor": None})

    return initialised
