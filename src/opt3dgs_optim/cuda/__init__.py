"""The CUDA kernels: sources, compilation at first use through `cuda.core`, launch.

Importing this module compiles nothing and touches no driver. A kernel is compiled by NVRTC for the
device it is launched on, once per machine (cuda.core's disk cache) and loaded once per process.
Only the float32 and float64 tensors of one CUDA device get here; see `opt3dgs_optim.backend`.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from torch import Tensor

BLOCK = 128  # threads; the .cu files promise it to the compiler
HEADERS = ("two_loop.cuh", "packed.cuh")  # the second for the curvature only
KERNELS = {"lqn.cu": "lqn_direction", "noise.cu": "add_covariance_noise"}


def source(name: str) -> str:
    """The text of a kernel file with the headers in front.

    cuda.core's disk cache refuses include paths, because it cannot see a header change.
    """
    folder = files(__name__)
    needed = HEADERS if name == "lqn.cu" else HEADERS[:1]
    headers = "".join((folder / header).read_text() for header in needed)
    return headers.replace("#pragma once\n", "") + (folder / name).read_text()


def macros(
    dtype: torch.dtype, history_size: int | None = None, packed: bool = False
) -> list[tuple[str, str]]:
    """What a kernel file is compiled with; `packed` is for half-size pairs."""
    size = [] if history_size is None else [("HISTORY_SIZE", str(history_size))]
    half = [("PACKED_PAIRS", "1")] if packed else []
    return size + half + ([("IN_FLOAT64", "1")] if dtype == torch.float64 else [])


def compile_cubin(
    name: str,
    dtype: torch.dtype,
    arch: str,
    *,
    history_size: int | None = None,
    packed: bool = False,
    cache: Any = None,
    logs: Any = None,
    ptxas_options: list[str] | None = None,
) -> Any:
    """Compile a kernel file for an architecture such as "sm_90"; no GPU is needed.

    Args:
        name: a key of `KERNELS`.
        dtype: torch.float32 or torch.float64.
        arch: without one, cuda.core would ask the driver.
        history_size: K; of "lqn.cu" only.
        packed: whether for half-size pairs; of "lqn.cu" only.
        cache: a cuda.core program cache.
        logs: an object with `write`, for what the compiler says.
        ptxas_options: for the assembler, such as "-v".

    Returns:
        cuda.core's ObjectCode.
    """
    core = importlib.import_module("cuda.core")
    program = core.Program(
        source(name),
        "c++",
        core.ProgramOptions(
            arch=arch,
            std="c++17",
            define_macro=macros(dtype, history_size, packed) or None,
            ptxas_options=ptxas_options,
        ),
    )
    return program.compile("cubin", logs=logs, cache=cache)


@functools.cache
def _disk_cache() -> Any:
    try:
        return importlib.import_module("cuda.core.utils").FileStreamProgramCache()
    except OSError:  # no writable home: compile in every process
        return None


@functools.cache
def _kernel(
    name: str,
    device: int,
    dtype: torch.dtype,
    history_size: int | None = None,
    packed: bool = False,
) -> Any:
    major, minor = torch.cuda.get_device_capability(device)
    importlib.import_module("cuda.core").Device(device).set_current()
    code = compile_cubin(
        name,
        dtype,
        f"sm_{major}{minor}",
        history_size=history_size,
        packed=packed,
        cache=_disk_cache(),
    )
    return code.get_kernel(KERNELS[name])


class _TorchStream:
    """torch's current stream, as cuda.core wants to see it."""

    def __init__(self, device: torch.device) -> None:
        self._handle = torch.cuda.current_stream(device).cuda_stream

    def __cuda_stream__(self) -> tuple[int, int]:
        return 0, self._handle


def _launch(kernel: Any, device: torch.device, rows: int, *arguments: Any) -> None:
    core = importlib.import_module("cuda.core")
    config = core.LaunchConfig(grid=(rows + BLOCK - 1) // BLOCK, block=BLOCK)
    core.launch(_TorchStream(device), config, kernel, *arguments)


def _real(dtype: torch.dtype) -> Any:
    return np.float64 if dtype == torch.float64 else np.float32


def lqn_direction(
    position: Tensor,
    grad: Tensor,
    history: Tensor,
    history_size: int,
    min_cosine: float,
    powell: bool,
    graft: bool,
    gamma_clamp: tuple[float, float] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """`curvature.step` on the GPU, for points of three coordinates. Never synchronises."""
    direction = torch.empty_like(grad, memory_format=torch.contiguous_format)
    accepted = torch.empty(grad.shape[0], dtype=torch.bool, device=grad.device)
    candidates = torch.empty_like(accepted)
    if grad.shape[0] == 0:
        return direction, accepted, candidates
    position, grad, cells = position.contiguous(), grad.contiguous(), history.contiguous()
    real = _real(grad.dtype)
    low, high = gamma_clamp or (0.0, 0.0)
    with torch.cuda.device(grad.device):
        _launch(
            _kernel("lqn.cu", grad.get_device(), grad.dtype, history_size, history.dim() == 2),
            grad.device,
            grad.shape[0],
            *(t.data_ptr() for t in (position, grad, cells, direction, accepted, candidates)),
            np.int64(grad.shape[0]),
            *(real(value) for value in (min_cosine, low, high)),
            *(np.int32(flag) for flag in (powell, graft, gamma_clamp is not None)),
        )
    if cells is not history:  # laid out for torch, e.g. loaded from a checkpoint of a CPU run
        history.copy_(cells)
    return direction, accepted, candidates


def add_covariance_noise(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    eta: Tensor,
    lr: Tensor,
    noise_scale: float,
    sharpness: float,
    threshold: float,
) -> None:
    """Add the noise of `noise.covariance_noise`, times lr * noise_scale, to `means` in place.

    A learning rate on the GPU is read there, when the kernel runs; one on the CPU is passed on.
    """
    if means.shape[0] == 0:
        return
    on_device = lr.is_cuda
    rate = lr.to(torch.float32) if on_device else None
    factor = noise_scale if on_device else noise_scale * float(lr)
    target = means.contiguous()
    tensors = [tensor.contiguous() for tensor in (scales, quats, opacities, eta)]
    real = _real(means.dtype)
    with torch.cuda.device(means.device):
        _launch(
            _kernel("noise.cu", means.get_device(), means.dtype),
            means.device,
            means.shape[0],
            target.data_ptr(),
            *(tensor.data_ptr() for tensor in tensors),
            0 if rate is None else rate.data_ptr(),
            *(real(value) for value in (factor, sharpness, threshold)),
            np.int64(means.shape[0]),
        )
    if target is not means:
        means.copy_(target)


@functools.cache
def missing() -> str | None:
    """Why the kernels cannot be compiled and launched in this process, or None."""
    if torch.version.hip is not None:
        return "this torch is built for ROCm, and the kernels are CUDA"
    try:
        found = importlib.util.find_spec("cuda.core") is not None
    except ModuleNotFoundError:
        found = False
    if not found:
        return "cuda.core is not installed (pip install 'opt3dgs_optim[cuda]')"
    if not torch.cuda.is_available():
        return "torch sees no CUDA device: no NVIDIA driver, or a build of torch without CUDA"
    try:
        importlib.import_module("cuda.core")
    except Exception as error:  # whatever a broken installation raises is the reason to show
        return f"cuda.core cannot be imported: {type(error).__name__}: {error}"
    return None
