"""Which implementation runs, the CUDA kernels or pure torch, and why."""

from dataclasses import dataclass
from typing import Literal

import torch

from opt3dgs_optim import cuda

Backend = Literal["auto", "cuda", "torch"]
BACKENDS = ("auto", "cuda", "torch")


@dataclass(frozen=True)
class BackendInfo:
    """What runs on a device; `reason` says why it is not the other."""

    device: str
    backend: Literal["cuda", "torch"]
    reason: str


def backend_info(device: torch.device | str | None = None) -> BackendInfo:
    """Which backend `"auto"` chooses for the curvature, and why.

    Args:
        device: of the parameters; None for the GPU, if torch sees one, else the CPU.

    The two give the same numbers, up to rounding. The kernels are for points of three coordinates
    with at most five curvature pairs; others are stepped by pure torch, and so are all where the
    default one does not compile. What fails later raises: nothing is replaced after an error.
    """
    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"
    place = torch.device(device)
    why_not = obstacle("auto", place)
    if why_not is None:
        return BackendInfo(str(place), "cuda", "cuda.core and a CUDA device are present")
    return BackendInfo(str(place), "torch", why_not)


def obstacle(backend: str, device: torch.device, dim: int = 3, history_size: int = 1) -> str | None:
    """Why pure torch runs for so many pairs of points of `dim` coordinates; None: the kernels do.

    Raises:
        RuntimeError: the kernels were asked for and cannot.
    """
    if backend == "torch":
        return "backend='torch' was asked for"
    if dim != 3 or history_size > cuda.MOST_PAIRS:
        found = (
            f"there is no kernel for {history_size} pairs of points of {dim} coordinates, "
            f"only for at most {cuda.MOST_PAIRS} of 3"
        )
    elif device.type != "cuda":
        found = "the kernels need a CUDA device"
    else:
        found = cuda.missing(device.index)
    if found is not None and backend == "cuda":
        raise RuntimeError(
            f"backend='cuda' was asked for on {device}, but {found}; backend='auto' takes pure "
            "torch then"
        )
    return found
