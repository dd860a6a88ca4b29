"""What a run log says of program and machine."""

from __future__ import annotations

import os
import platform
import sys
from datetime import datetime, timezone
from typing import Any

import torch

from opt3dgs_optim.runs.lines import text


def origin() -> dict[str, Any]:
    """What runs, where and since when; no host name, no folders."""
    machine: dict[str, Any] = {"platform": platform.platform(), "cpus": os.cpu_count()}
    if torch.cuda.is_initialized():
        machine["gpu"] = torch.cuda.get_device_name()
    return {
        "format": 1,
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "command": text(" ".join(_base_name(argument) for argument in sys.argv)),
        "machine": machine | {"python": platform.python_version(), "torch": torch.__version__},
    }


def _base_name(argument: str) -> str:
    """An argument without folders: "--data=/home/me/plush" becomes "--data=plush"."""
    option, equals, value = argument.rpartition("=")
    return option + equals + value.replace("\\", "/").rstrip("/").rpartition("/")[2]


def synchronize() -> None:
    """Wait for the GPU, where one is in use; asking it anything else would start CUDA."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def peak_memory() -> dict[str, int]:
    """`peak_cuda_bytes` that torch has given out, else `peak_host_bytes` of the process."""
    if torch.cuda.is_initialized():
        return {"peak_cuda_bytes": torch.cuda.max_memory_allocated()}
    try:
        import resource
    except ImportError:  # Windows
        return {}
    unit = 1 if sys.platform == "darwin" else 1024
    return {"peak_host_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit}
