"""The CUDA kernels of the curvature: sources, compilation at first use through `cuda.core`, launch.

Importing this module compiles nothing and touches no driver. A kernel is compiled by NVRTC for the
device it is launched on, once per machine (cuda.core's disk cache) and loaded once per process.
Nothing here checks its arguments: `opt3dgs_optim.lbfgs` has, and its `backend` says where the
kernels run.
"""

import functools
import importlib
from importlib.resources import files
from typing import Any

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim.messages import LOGGER

MOST_PAIRS = 5  # of curvature, that fit into a thread's registers
BLOCK = 128  # threads; the .cu files promise it to the compiler
HEADER = "two_loop.cuh"
KERNELS = {"lqn_direction": "lqn.cu", "two_loop": "two_loop.cu"}  # the kernel: its file
ALIGNMENT = 16  # bytes; the kernels read and write histories by vectors of so many
REALS = {torch.float32: np.float32, torch.float64: np.float64}  # the kernels' numbers
CONFIGS = 1024  # of the grids last launched; the number of points changes with density control


def source(name: str) -> str:
    """The text of a kernel file with the header in front.

    cuda.core's disk cache refuses include paths, because it cannot see a header change.
    """
    folder = files(__name__)
    return (folder / HEADER).read_text() + (folder / name).read_text()


def macros(dtype: torch.dtype, history_size: int) -> list[tuple[str, str]]:
    """What a kernel file is compiled with, for K = `history_size` pairs."""
    size = [("HISTORY_SIZE", str(history_size))]
    return size + ([("IN_FLOAT64", "1")] if dtype == torch.float64 else [])


def compile_cubin(
    name: str,
    dtype: torch.dtype,
    arch: str,
    *,
    history_size: int,
    cache: Any = None,
    logs: Any = None,
    ptxas_options: list[str] | None = None,
) -> Any:
    """cuda.core's ObjectCode of a file of `KERNELS`, for an `arch` such as "sm_90"; needs no GPU.

    history_size is K; cache, logs and ptxas_options are cuda.core's.
    """
    core = importlib.import_module("cuda.core")
    defined = macros(dtype, history_size)
    options = core.ProgramOptions(
        arch=arch, std="c++17", define_macro=defined, ptxas_options=ptxas_options
    )
    return core.Program(source(name), "c++", options).compile("cubin", logs=logs, cache=cache)


@functools.cache
def _disk_cache() -> Any:
    try:
        return importlib.import_module("cuda.core.utils").FileStreamProgramCache()
    except OSError:  # no writable home: compile in every process
        return None


@functools.cache
def _kernel(kernel: str, device: int, dtype: torch.dtype, history_size: int) -> Any:
    major, minor = torch.cuda.get_device_capability(device)
    importlib.import_module("cuda.core").Device(device).set_current()
    arch, cache = f"sm_{major}{minor}", _disk_cache()
    code = compile_cubin(KERNELS[kernel], dtype, arch, history_size=history_size, cache=cache)
    return code.get_kernel(kernel)


@functools.lru_cache(maxsize=CONFIGS)
def _config(blocks: int) -> Any:
    return importlib.import_module("cuda.core").LaunchConfig(grid=blocks, block=BLOCK)


@functools.cache
def _stream(handle: int) -> Any:
    """torch's stream for cuda.core, whose launch takes objects of others no more.

    It holds the handle alone. torch's streams live as long as the process.
    """
    return importlib.import_module("cuda.core").Stream.from_handle(handle)


@functools.cache
def several_gpus() -> bool:
    """Whether a tensor may lie on a GPU that is not the current one."""
    return torch.cuda.device_count() > 1


@functools.cache
def _launcher() -> Any:
    return importlib.import_module("cuda.core").launch


def launch(kernel: str, like: Tensor, *arguments: Any, history_size: int) -> None:
    """Run a kernel of `KERNELS`, a thread for each row of `like`, on its device's current stream.

    It is the kernel for the dtype of `like`. `arguments` are contiguous tensors, passed as their
    addresses, ints, passed in 8 bytes, and numpy numbers of C's size.
    """
    threads, device = like.shape[0], like.get_device()
    if threads == 0:
        return
    if several_gpus() and device != torch.cuda.current_device():
        with torch.cuda.device(device):
            launch(kernel, like, *arguments, history_size=history_size)
        return
    function = _kernel(kernel, device, like.dtype, history_size)
    # The public `torch.cuda.current_stream` makes an object of it, at the cost of this launch.
    stream = _stream(torch._C._cuda_getCurrentRawStream(device))
    values = [a.data_ptr() if isinstance(a, Tensor) else a for a in arguments]
    _launcher()(stream, _config((threads + BLOCK - 1) // BLOCK), function, *values)


def lqn_direction(
    position: Tensor,
    grad: Tensor,
    history: Tensor,
    history_size: int,
    min_cosine: float,
    graft: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """`lbfgs.lqn_direction` on the GPU, for points of three coordinates. Never synchronises."""
    rows = grad.shape[0]
    fed = torch.empty_like(grad, memory_format=torch.contiguous_format)
    accepted, candidates = torch.empty(2, rows, dtype=torch.bool, device=grad.device).unbind()
    cells = _aligned(history)
    tensors = (_contiguous(position), _contiguous(grad), cells, fed, accepted, candidates)
    numbers = (rows, REALS[grad.dtype](min_cosine), np.int32(graft))
    launch("lqn_direction", grad, *tensors, *numbers, history_size=history_size)
    if cells is not history:  # laid out for torch, e.g. loaded from a checkpoint of a CPU run
        history.copy_(cells)
    return fed, accepted, candidates


def two_loop(grad: Tensor, history: Tensor, history_size: int) -> Tensor:
    """`lbfgs.two_loop` on the GPU, for points of three coordinates. Never synchronises."""
    grad = _contiguous(grad)
    result = torch.empty_like(grad)
    tensors = grad, _aligned(history), result
    launch("two_loop", grad, *tensors, grad.shape[0], history_size=history_size)
    return result


def _contiguous(tensor: Tensor) -> Tensor:
    return tensor if tensor.is_contiguous() else tensor.detach().contiguous()


def _aligned(history: Tensor) -> Tensor:
    """`history` itself, or a copy if it is not as a kernel reads it: contiguous and aligned."""
    history = _contiguous(history)
    # A view into a larger buffer may begin anywhere.
    return history if history.data_ptr() % ALIGNMENT == 0 else history.clone()


@functools.cache
def missing(device: int | None = None) -> str | None:
    """Why the kernels cannot be compiled and launched for a GPU, or None.

    Args:
        device: its index; None: the present one. The first call compiles a kernel for it.
    """
    if torch.version.hip is not None:
        return "this torch is built for ROCm, and the kernels are CUDA"
    try:
        importlib.import_module("cuda.core")
    except ModuleNotFoundError:
        extra = "cuda12" if (torch.version.cuda or "").startswith("12") else "cuda"
        return f"cuda.core is not installed (in a clone: pip install '.[{extra}]')"
    except Exception as error:  # whatever a broken installation raises is the reason to show
        return f"cuda.core cannot be imported: {type(error).__name__}: {error}"
    if not torch.cuda.is_available():
        return "torch sees no CUDA device: no NVIDIA driver, or a build of torch without CUDA"
    try:  # the one of the defaults: NVRTC, and a driver, may not know each other or the GPU
        index = torch.cuda.current_device() if device is None else device
        with torch.cuda.device(index):  # cuda.core makes it the current one, and leaves it so
            _kernel("lqn_direction", index, torch.float32, MOST_PAIRS)
    except Exception as error:
        reason = f"cuda.core cannot compile for this GPU: {type(error).__name__}: {error}"
        LOGGER.warning("opt3dgs_optim: %s; the curvature runs in plain torch", reason)
        return reason
    return None
