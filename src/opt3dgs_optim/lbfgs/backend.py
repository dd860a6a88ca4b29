"""Which implementation runs, the CUDA kernels or pure torch, and why."""

from dataclasses import dataclass
from typing import Literal

import torch

from opt3dgs_optim import cuda
from opt3dgs_optim.checks import check_choice

Backend = Literal["auto", "cuda", "torch"]
BACKENDS = ("auto", "cuda", "torch")


@dataclass(frozen=True)
class BackendInfo:
    """What runs for tensors of a device and dtype; `reason` says why it is not the other."""

    device: str
    dtype: torch.dtype
    backend: Literal["cuda", "torch"]
    reason: str


def backend_info(
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
    *,
    backend: Backend = "auto",
) -> BackendInfo:
    """Which backend a `backend` option chooses for the curvature, and why.

    Args:
        device, dtype: of the parameters; None for the GPU, if torch sees one, else the CPU.
        backend: `"auto"` takes the CUDA kernels where they can run; the others insist.

    The two give the same numbers, up to rounding. The kernels are for points of three coordinates
    with at most five curvature pairs; others are stepped by pure torch, and so are all where the
    default one does not compile. What fails later raises: nothing is replaced after an error.

    Raises:
        ValueError: `backend` is none of these.
        RuntimeError: `backend="cuda"`, and the kernels cannot run.
    """
    check_choice("backend_info", "backend", backend, BACKENDS)
    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"
    place = torch.device(device)
    why_not = obstacle(backend, place, dtype)
    if why_not is None:
        return BackendInfo(str(place), dtype, "cuda", "cuda.core and a CUDA device are present")
    return BackendInfo(str(place), dtype, "torch", why_not)


def obstacle(
    backend: str, device: torch.device, dtype: torch.dtype, dim: int = 3, history_size: int = 1
) -> str | None:
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
    elif dtype not in cuda.DTYPES:
        kind = str(dtype).removeprefix("torch.")
        found = f"the kernels take float32 and float64, not {kind}"
    else:
        found = cuda.missing(device.index)
    if found is not None and backend == "cuda":
        raise RuntimeError(
            f"backend='cuda' was asked for on {device} in {dtype}, but {found}; backend='auto' "
            "takes pure torch then"
        )
    return found
