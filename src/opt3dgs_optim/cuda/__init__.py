"""The CUDA kernels: sources, compilation at first use through `cuda.core`, launch.

Importing this module compiles nothing and touches no driver. A kernel is compiled by NVRTC for the
device it is launched on, once per machine (cuda.core's disk cache) and loaded once per process.
Only the tensors of one CUDA device get here; see `opt3dgs_optim.backend` and `has_own_frames`.
"""

import functools
import importlib
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

BLOCK = 128  # threads; the .cu files promise it to the compiler
HEADER = "two_loop.cuh"
KERNELS = {  # the kernel: its file
    "lqn_direction": "lqn.cu",
    "two_loop": "two_loop.cu",
    "take_energy": "histogram.cu",
    "own_frame_gradient": "own_frame.cu",
    "own_frame_displacement": "own_frame.cu",
}
DTYPES = (torch.float32, torch.float64)  # of the kernels
ALIGNMENT = 16  # bytes; the kernels read and write histories and quaternions by vectors of so many


def source(name: str) -> str:
    """The text of a kernel file with the header in front.

    cuda.core's disk cache refuses include paths, because it cannot see a header change.
    """
    folder = files(__name__)
    return (folder / HEADER).read_text() + (folder / name).read_text()


def macros(dtype: torch.dtype, history_size: int | None = None) -> list[tuple[str, str]]:
    """What a kernel file is compiled with."""
    size = [] if history_size is None else [("HISTORY_SIZE", str(history_size))]
    return size + ([("IN_FLOAT64", "1")] if dtype == torch.float64 else [])


def compile_cubin(
    name: str,
    dtype: torch.dtype,
    arch: str,
    *,
    history_size: int | None = None,
    cache: Any = None,
    logs: Any = None,
    ptxas_options: list[str] | None = None,
) -> Any:
    """cuda.core's ObjectCode of a file of `KERNELS`, for an `arch` such as "sm_90"; needs no GPU.

    history_size is K, of "lqn.cu" and "two_loop.cu" only; cache, logs and ptxas_options are
    cuda.core's.
    """
    core = importlib.import_module("cuda.core")
    defined = macros(dtype, history_size) or None
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
def _kernel(kernel: str, device: int, dtype: torch.dtype, history_size: int | None) -> Any:
    major, minor = torch.cuda.get_device_capability(device)
    importlib.import_module("cuda.core").Device(device).set_current()
    arch, cache = f"sm_{major}{minor}", _disk_cache()
    code = compile_cubin(KERNELS[kernel], dtype, arch, history_size=history_size, cache=cache)
    return code.get_kernel(kernel)


class _TorchStream(NamedTuple):
    """torch's current stream, as cuda.core wants to see it."""

    handle: int

    def __cuda_stream__(self) -> tuple[int, int]:
        return 0, self.handle


def launch(
    kernel: str,
    like: Tensor,
    threads: int,
    *arguments: Tensor | np.generic | int,
    history_size: int | None = None,
) -> None:
    """Run a kernel of `KERNELS` on the device and current stream of `like`, for its dtype.

    `arguments` are contiguous tensors, passed as their addresses, and numpy numbers of C's size.
    """
    if threads == 0:
        return
    core, device = importlib.import_module("cuda.core"), like.device
    values = (a.data_ptr() if isinstance(a, Tensor) else a for a in arguments)
    with torch.cuda.device(device):
        function = _kernel(kernel, like.get_device(), like.dtype, history_size)
        config = core.LaunchConfig(grid=(threads + BLOCK - 1) // BLOCK, block=BLOCK)
        stream = _TorchStream(torch.cuda.current_stream(device).cuda_stream)
        core.launch(stream, config, function, *values)


def real(dtype: torch.dtype) -> Any:
    """The numpy type of a number that a kernel for tensors of `dtype` takes."""
    return np.float64 if dtype == torch.float64 else np.float32


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
    _check_tensors("lqn_direction", grad, position=(position, grad.shape), history=(history, None))
    fed = torch.empty_like(grad, memory_format=torch.contiguous_format)
    accepted = torch.empty(rows, dtype=torch.bool, device=grad.device)
    candidates = torch.empty_like(accepted)
    cells = _aligned(history)
    tensors = (position.contiguous(), grad.contiguous(), cells, fed, accepted, candidates)
    numbers = (np.int64(rows), real(grad.dtype)(min_cosine), np.int32(graft))
    launch("lqn_direction", grad, rows, *tensors, *numbers, history_size=history_size)
    if cells is not history:  # laid out for torch, e.g. loaded from a checkpoint of a CPU run
        history.copy_(cells)
    return fed, accepted, candidates


def two_loop(grad: Tensor, history: Tensor, history_size: int) -> Tensor:
    """`lbfgs.two_loop` on the GPU, for points of three coordinates. Never synchronises."""
    rows = grad.shape[0]
    _check_tensors("two_loop", grad, history=(history, None))
    result = torch.empty_like(grad, memory_format=torch.contiguous_format)
    tensors = (grad.contiguous(), _aligned(history), result)
    launch("two_loop", grad, rows, *tensors, np.int64(rows), history_size=history_size)
    return result


def has_own_frames(quats: Tensor) -> bool:
    """Whether the kernels of the own frame run where these rotations lie."""
    return quats.is_cuda and quats.is_floating_point() and missing() is None


def own_frame_gradient(
    grad: Tensor, quats: Tensor, scales: Tensor, min_aspect: float = 0.0
) -> Tensor:
    """Gradients in each Gaussian's own frame, B^T g with B = R diag(exp(scales)).

    One launch where all are float32 or all float64. Half precision is cast to float32, and float32
    beside float64 to that. Never synchronises.

    Args:
        grad: [N, 3] of the positions, in units of the loss per world unit.
        quats: [N, 4] rotations, wxyz, need not be normalised, where `has_own_frames` says so.
        scales: [N, 3] log of the standard deviations, world units.
        min_aspect: share of the longest deviation that a shorter one counts as, at least; 0: none.

    Returns:
        [N, 3] of the gradient's dtype, in units of the loss per standard deviation. It has no
        autograd graph.

    Raises:
        ValueError: shapes or devices do not fit.
    """
    return _in_frames("own_frame_gradient", grad, quats, scales, min_aspect)


def own_frame_displacement(
    step: Tensor, quats: Tensor, scales: Tensor, min_aspect: float = 0.0
) -> Tensor:
    """Steps that were taken in each Gaussian's own frame, in world units: B z.

    Args:
        step: [N, 3] in standard deviations along the Gaussians' own axes.
        quats, scales, min_aspect: as in `own_frame_gradient`; so are dtypes and errors.
    """
    return _in_frames("own_frame_displacement", step, quats, scales, min_aspect)


def _in_frames(
    kernel: str, vectors: Tensor, quats: Tensor, scales: Tensor, min_aspect: float
) -> Tensor:
    rows = vectors.shape[0] if vectors.dim() else 0
    given = {"vectors": (vectors, 3), "quats": (quats, 4), "scales": (scales, 3)}
    for name, (tensor, width) in given.items():
        # The kernel reads memory by them.
        if (tuple(tensor.shape), tensor.device) != ((rows, width), vectors.device):
            raise ValueError(
                f"{kernel}: {name} of shape {tuple(tensor.shape)} on {tensor.device}, but "
                f"{(rows, width)} on {vectors.device} is needed"
            )
    wide = any(tensor.dtype == torch.float64 for tensor, _ in given.values())
    dtype = torch.float64 if wide else torch.float32
    v, q, s = (each.detach().to(dtype).contiguous() for each in (vectors, quats, scales))
    result = torch.empty_like(v)
    numbers = (np.int64(rows), real(dtype)(min_aspect))
    launch(kernel, v, rows, v, _aligned(q), s, result, *numbers)
    return result.to(vectors.dtype)


def _aligned(tensor: Tensor) -> Tensor:
    """`tensor` itself, or a copy if it is not as a kernel reads it: contiguous and aligned."""
    tensor = tensor.contiguous()
    # A view into a larger buffer may begin anywhere.
    return tensor if tensor.data_ptr() % ALIGNMENT == 0 else tensor.clone()


def _check_tensors(call: str, like: Tensor, **needed: tuple[Tensor, torch.Size | None]) -> None:
    """ValueError unless tensors have the dtype and device of `like`, and these shapes.

    A kernel reads memory by them. None is any shape.
    """
    for name, (given, size) in needed.items():
        shape = given.shape if size is None else size
        if (given.shape, given.dtype, given.device) != (shape, like.dtype, like.device):
            raise ValueError(
                f"{call}: {name} is {tuple(given.shape)} {given.dtype} on {given.device}, "
                f"but {tuple(shape)} {like.dtype} on {like.device} is needed"
            )


def take_energy(
    energy: Tensor,
    valid: Tensor | bool,
    state: Tensor,
    nu: Tensor,
    count: Tensor,
    sums: Tensor,
    sizes: tuple[int, int, int],
    *numbers: float,
) -> None:
    """`MovingPartitions.take_on_device` on the GPU. Never synchronises.

    `count` and `sums` are those of its `Tally`; `sizes` and `numbers` as in the kernel.
    """
    # A 0 is a null pointer.
    known = 0 if valid is True else torch.as_tensor(valid, dtype=torch.bool, device=state.device)
    tensors = (energy.to(state), known, state, nu, count, sums)
    integers = map(np.int64, (len(state) - 3, *sizes))
    launch("take_energy", state, 1, *tensors, *integers, *map(real(state.dtype), numbers))


@functools.cache
def missing() -> str | None:
    """Why the kernels cannot be compiled and launched in this process, or None."""
    if torch.version.hip is not None:
        return "this torch is built for ROCm, and the kernels are CUDA"
    try:
        importlib.import_module("cuda.core")
    except ModuleNotFoundError:
        extra = "cuda12" if (torch.version.cuda or "").startswith("12") else "cuda"
        return f"cuda.core is not installed (pip install 'opt3dgs_optim[{extra}]')"
    except Exception as error:  # whatever a broken installation raises is the reason to show
        return f"cuda.core cannot be imported: {type(error).__name__}: {error}"
    if not torch.cuda.is_available():
        return "torch sees no CUDA device: no NVIDIA driver, or a build of torch without CUDA"
    return None
