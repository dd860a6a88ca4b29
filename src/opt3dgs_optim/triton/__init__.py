"""The step of a parameter as one Triton launch on a GPU.

Triton comes with torch's CUDA and ROCm builds for Linux. It is imported with the first step of a
tensor on a GPU. Where it is missing, or cannot compile, `opt3dgs_optim.step.take_step` runs.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import itertools
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.cuda import several_gpus
from opt3dgs_optim.mean import Mean, mean_of
from opt3dgs_optim.messages import LOGGER
from opt3dgs_optim.moments import CODES, MOMENTS, signed
from opt3dgs_optim.step import Hold, Step

ROWS_BLOCK, FRAME_BLOCK, LOOK_BLOCK = 1024, 128, 1024  # as in `kernels`
WARPS = {"step_rows": 8, "step_in_own_frame": 2, "look_at_positions": 4}  # fastest on an H200
DTYPES = (torch.float32, CODES)  # of the kernels
MAX_WIDTH = 2**20 - ROWS_BLOCK  # numbers of a row: see `kernels.rows_of`
NO_FADE = (0, 0.0, 1.0, 1.0)
NO_MEAN: Any = Mean(False, 0, None, None)  # pyright: ignore
_COMPILED: dict[Any, Any] = {}  # what Triton has compiled, by what it depends on
_PREPARED: set[Any] = set()  # for which parameters' steps it has


def missing() -> str | None:
    """Why no kernel runs on this machine's GPU, in a sentence; None: they run."""
    if not torch.cuda.is_available():
        return _import_error() or "torch sees no GPU, so that a step is plain torch."
    return missing_on(torch.device("cuda"))


@functools.cache
def missing_on(device: torch.device) -> str | None:
    """`missing` on a GPU. The first call launches a kernel: it shows whether Triton compiles."""
    if (error := _import_error()) is not None:
        return error
    try:
        # Aligned, and with a counter, as parameters of trainers: its kernel is compiled for them.
        p, g, m, v = torch.zeros(4, 4, device=device, dtype=torch.float32)
        step = Step(p, g, None, "", {}, {"exp_avg": m, "exp_avg_sq": v}, 0, -1)
        step.nonfinite = torch.zeros(1, device=device, dtype=torch.int32)
        for _ in range(2):  # by Triton's launcher, and as in all later steps
            launch(step)
    except Exception as error:  # no C compiler, a GPU that is too old, a folder that is read-only
        return (
            f"Triton cannot launch a kernel ({type(error).__name__}: {error}), so that a step on "
            "a GPU is many launches; it needs a C compiler (apt install gcc) and a writable home."
        )
    return None


def _import_error() -> str | None:
    try:
        _kernels()
    except Exception as error:  # of a Triton for another machine, anything
        return f"Triton cannot be imported ({error}), so that a step on a GPU is many launches."
    return None


@functools.cache
def _runs(device: torch.device) -> bool:
    reason = missing_on(device)
    if reason is not None:
        LOGGER.warning("opt3dgs_optim: %s", reason)
    return reason is None


@functools.cache
def _kernels() -> Any:
    return importlib.import_module("opt3dgs_optim.triton.kernels")


def takes(step: Step) -> bool:
    """Whether the kernels make this step: float32 without gaps, on a GPU with Triton."""
    return step.param.is_cuda and _runs(step.param.device) and fits(step)


def fits(step: Step) -> bool:  # noqa: PLR0911
    """`takes`, wherever the tensors lie."""
    frame, hold, mean, state, param = step.frame, step.hold, step.mean, step.state, step.param
    device, numbers = param.get_device(), param.numel()
    if step.plain or (numbers and not param.data_ptr()):  # or without memory of its own, a DTensor
        return False
    for tensor in (param, step.grad, state["exp_avg"], state["exp_avg_sq"]):
        if tensor.dtype not in DTYPES or not _lies_on(device, tensor):
            return False
    if mean is not None:
        for tensor in (mean.tensor, mean.began, mean.rest):
            if tensor is not None and not _lies_on(device, tensor):
                return False
    if isinstance(step.factor, Tensor) and not _plain_on(device, step.factor):
        return False
    if frame is None:
        if numbers > MAX_WIDTH and numbers > MAX_WIDTH * param.shape[0]:
            return False
        return hold is None or (
            hold.rows.dtype is torch.bool
            and len(hold.rows) == len(param)
            and _lies_on(device, hold.rows)
        )
    if step.fade is not None or hold is not None:
        return False  # none of our parts says so of positions in their own frames
    rows = param.shape[0]
    if frame.quats.numel() != 4 * rows or frame.scales.numel() != 3 * rows or 4 * rows >= 2**31:
        return False
    longest = frame.longest is None or _plain_on(device, frame.longest)
    return longest and _plain_on(device, frame.quats) and _plain_on(device, frame.scales)


def _lies_on(device: int, tensor: Tensor) -> bool:
    return tensor.is_contiguous() and tensor.get_device() == device


def _plain_on(device: int, tensor: Tensor) -> bool:
    return tensor.dtype is torch.float32 and _lies_on(device, tensor)


def take_step(step: Step, later: tuple[str, ...] = ()) -> None:
    """Make the step in one launch: what `opt3dgs_optim.step.take_step` means.

    Numbers that are not finite are added to `step.nonfinite` [1] int32. Nothing waits for the
    device, and nothing is allocated there. At a parameter's first step the kernels that its later
    steps will need (`Part.later`) are compiled, too.
    """
    if later:
        dtype = step.state["exp_avg"].dtype
        key = step.name, step.param.device, dtype, later, step.frame is None
        if key not in _PREPARED:
            _PREPARED.add(key)
            for forms in _subsets(later):
                launch(_stand_in(step, forms))
    launch(step)
    # Autograd is to see that a parameter has changed, as after an operator of torch's.
    torch.autograd.graph.increment_version(step.param)


def _subsets(later: tuple[str, ...]) -> list[tuple[str, ...]]:
    return [c for size in range(len(later) + 1) for c in itertools.combinations(later, size)]


def _stand_in(step: Step, forms: tuple[str, ...]) -> Step:
    """A step of one row that changes nothing of the training, and compiles what others need."""
    param = step.param
    shape = (1, *param.shape[1:]) if param.dim() else ()
    one: Any = torch.zeros(shape, dtype=param.dtype, device=param.device)
    state = {key: torch.zeros_like(one, dtype=step.state[key].dtype) for key in MOMENTS}
    made = dataclasses.replace(
        step, param=one, grad=torch.zeros_like(one), state=state, fade=None, hold=None, mean=None
    )
    if step.frame is not None:
        quats, scales = one.new_zeros(1, 4), one.new_zeros(1, 3)
        made.frame = step.frame._replace(quats=quats, scales=scales)
    if "factor" in forms:
        made.factor = one.new_ones(())
    if "hold" in forms:
        made.hold = Hold(torch.zeros(1, dtype=torch.bool, device=one.device), 1.0)
    if "mean" in forms:
        made.mean = mean_of(one, state, step.name, False, 1)
    return made


def looks(grad: Tensor) -> bool:
    """Whether `look` takes the positions' gradient."""
    if not (grad.is_cuda and _runs(grad.device)):
        return False
    return _plain_on(grad.get_device(), grad) and 4 * len(grad) < 2**31


def look(
    grad: Tensor, exp_avg_sq: Tensor | None, out_of_view: Tensor | None, counter: Tensor | None
) -> None:
    """See in one launch which positions have no gradient.

    Args:
        grad: [N, 3] of the positions; `looks(grad)`. N above 0.
        exp_avg_sq: [N, 3] their second moments, or None before their first step.
        out_of_view: [N] bool to write into, or None.
        counter: [1] int64, to which 2^32 is added for each position with a gradient, and 1 for each
            that has or had one; or None.
    """
    mask = None if out_of_view is None else out_of_view.view(torch.uint8)
    dtype = torch.float32 if exp_avg_sq is None else exp_avg_sq.dtype
    if counter is not None and ("look", grad.device, dtype) not in _PREPARED:
        # What later looks need is compiled with the first ones.
        _PREPARED.add(("look", grad.device, dtype))
        one, seen = torch.zeros_like(grad[:1]), torch.zeros_like(grad[:1, 0], dtype=torch.bool)
        second, count = torch.zeros_like(one, dtype=dtype), torch.zeros_like(counter)
        for given in ((second, seen, count), (None, seen, None), (second, None, count)):
            look(one, *given)
    _run(
        "look_at_positions", -(-len(grad) // LOOK_BLOCK), (grad, exp_avg_sq, mask, counter),
        (len(grad),), (exp_avg_sq is not None and exp_avg_sq.dtype is CODES, False),
    )  # fmt: skip


def launch(step: Step) -> None:
    """Launch the kernel of this step, whatever device it is on."""
    param, exp_avg, exp_avg_sq = step.param, step.state["exp_avg"], step.state["exp_avg_sq"]
    numbers = param.numel()
    if not numbers:
        return
    frame, fade, hold, factor = step.frame, step.fade, step.hold, step.factor
    # Triton would compile an integer, or a number of numpy, as another kind of argument.
    size = float(step.lr if frame is None else frame.rate)
    on_device = None
    if isinstance(factor, Tensor):
        on_device = factor
    else:
        size *= float(factor)
    size /= step.correction1
    kept = NO_MEAN if step.mean is None else step.mean
    mean, began, rest = kept.tensor, kept.began, kept.rest
    number, put = float(kept.count), 1.0 if kept.put else 0.0
    coded = exp_avg.dtype is CODES, mean is not None and mean.dtype is CODES
    adam = (
        step.beta2, 1 - step.beta1, 1 - step.beta2, step.eps, step.sqrt_correction2,
        step.shrink, step.decay, signed(step.rounding),
    )  # fmt: skip
    if frame is not None:
        _run(
            "step_in_own_frame", -(-param.shape[0] // FRAME_BLOCK),
            (param, step.grad, exp_avg, exp_avg_sq, frame.quats, frame.scales, frame.longest,
             mean, rest, began, on_device, step.nonfinite),
            (param.shape[0], float(frame.min_aspect), size, *adam, number, put), coded,
        )  # fmt: skip
        return
    key, *fades = NO_FADE if fade is None else fade
    share, fade_m, fade_v = map(float, fades)
    held = None if hold is None else hold.rows.view(torch.uint8)
    weight = 0.0 if hold is None else float(hold.weight)
    _run(
        "step_rows", -(-numbers // ROWS_BLOCK),
        (param, step.grad, exp_avg, exp_avg_sq, mean, rest, began, held, on_device, step.nonfinite),
        (numbers, numbers // param.shape[0] if param.dim() else 1, size, *adam,
         signed(key), share, fade_m, fade_v, weight, number, put, kept.grid),
        coded,
    )  # fmt: skip


def _run(
    name: str, programs: int, tensors: tuple[Tensor | None, ...], numbers: tuple[float, ...],
    coded: tuple[bool, bool],
) -> None:  # fmt: skip
    """Launch a kernel; what Triton has compiled is launched again without its launcher.

    `coded` says whether moments, and whether the mean, are codes: each has a kernel of its own.
    Triton's launcher looks at every argument, which takes 30 us. What it finds depends only on
    which tensors are None, on whether each begins at a multiple of 16 bytes, on the device, and on
    the size: of 2^31 numbers, and of 2^31 bytes for ROCm.
    """
    pointers = [None if tensor is None else tensor.data_ptr() for tensor in tensors]
    first = tensors[0]
    assert first is not None
    device = first.get_device()  # -1: the CPU
    if several_gpus() and device not in (-1, torch.cuda.current_device()):
        with torch.cuda.device(device):
            _run(name, programs, tensors, numbers, coded)
        return
    size = max(27, int(numbers[0]).bit_length())  # a row of quaternions has 16 bytes
    key = name, coded, device, size, *[p and p & 15 for p in pointers]
    compiled = _COMPILED.get(key)
    if compiled is not None:
        # The public `torch.cuda.current_stream` makes an object of it, at the cost of this launch.
        stream = torch._C._cuda_getCurrentRawStream(device)
        # As the code that torch.compile generates does; the Nones are of profilers' hooks.
        compiled.run(
            programs, 1, 1, stream, compiled.function, compiled.packed_metadata, None, None, None,
            *pointers, *numbers,
        )  # fmt: skip
        return
    kernel = getattr(_kernels(), name)
    # As torch's operators: without the fusion of a product and a sum.
    options = {"enable_fp_fusion": False, "num_warps": WARPS[name]}
    compiled = kernel[programs,](*tensors, *numbers, **options)
    if compiled is not None:
        _COMPILED[key] = compiled
