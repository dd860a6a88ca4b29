"""A GPU that is not there: tensors that say they are on `cuda:0`, and compute on the CPU.

    with SimulatedDevice() as gpu:
        means = Parameter(torch.rand(10, 3, device="cuda"))
        ...                              # a training, as on a machine with a GPU
    gpu.synchronisations                 # what made the host wait, and which line did it
    gpu.operators, gpu.launches          # what torch, and Triton, have launched there

A tensor shares its memory with one of the CPU, so that a training computes what it computes there;
Triton's kernels are run by its interpreter. As on a GPU, operators raise RuntimeError where tensors
lie on two devices (but for 0-d ones of the host), and a copy to the host that is not waited for is
not there yet: it holds -1 until its event is asked for the second time.

What it does not show: speed, streams, memory, and the digits of a GPU's own sums.
"""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from interpreted import interpreted_kernels
from torch import Tensor
from torch.overrides import TorchFunctionMode

from opt3dgs_optim import triton

CUDA = torch.device("cuda", 0)
WAITS = ("item", "__bool__", "__float__", "__int__", "__index__", "tolist", "nonzero", "numpy")
WAITS += ("equal", "is_nonzero", "masked_select", "allclose", "unique", "__len_of_mask__")
# What is answered by the host, and launches nothing.
FREE = ("__get__", "__set__", "dim", "size", "numel", "stride", "is_floating_point", "is_complex")
FREE += ("__len__", "detach", "view", "reshape", "unbind", "expand", "as_subclass", "data_ptr")
FREE += ("is_contiguous", "get_device", "requires_grad_", "element_size", "__hash__", "unsqueeze")
FREE += ("view_as", "t", "transpose", "squeeze", "__repr__", "storage_offset", "untyped_storage")
MIXED = ("copy_", "to", "__set__", "_foreach_copy_")


class DeviceTensor(Tensor):
    """A tensor that says it is on a GPU."""

    device = property(lambda self: CUDA)  # pyright: ignore[reportAssignmentType]
    is_cuda = property(lambda self: True)  # pyright: ignore[reportAssignmentType]
    is_cpu = property(lambda self: False)  # pyright: ignore[reportAssignmentType]

    def get_device(self) -> int:
        """The first GPU."""
        return 0

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        made = on_device(self.detach())
        memo[id(self)] = made
        return made.requires_grad_(self.requires_grad)


def on_device(tensor: Tensor) -> Tensor:
    """A copy on the simulated GPU; parameters stay such."""
    with torch._C.DisableTorchFunction():
        made = tensor.detach().as_subclass(Tensor).clone().as_subclass(DeviceTensor)
    is_param = isinstance(tensor, torch.nn.Parameter)
    return torch.nn.Parameter(made, tensor.requires_grad) if is_param else made


def on_host(tensor: Tensor) -> Tensor:
    """What it holds, as a tensor of the CPU that shares its memory; nothing is counted."""
    with torch._C.DisableTorchFunction():
        return tensor.detach().as_subclass(Tensor)


class SimulatedDevice(TorchFunctionMode):
    """Simulates a GPU while the `with` lasts.

    Attributes:
        synchronisations: "KIND at FILE:LINE" of the package's innermost line, or "" elsewhere.
        capturing: whether a CUDA graph is being captured.
        operators: how often each of torch's operators was launched. launches: of Triton's kernels.
    """

    def __init__(self) -> None:
        super().__init__()
        self._patches, self.capturing = contextlib.ExitStack(), False
        self.forget()

    def forget(self) -> None:
        """Begin to count anew."""
        self.synchronisations: list[str] = []
        self.operators: Counter[str] = Counter()
        self.launches: Counter[str] = Counter()

    def __enter__(self) -> SimulatedDevice:
        patch = self._patches.enter_context(pytest.MonkeyPatch.context())
        interpreted_kernels(patch)
        kernels = triton._kernels()
        run = kernels.run

        def launch(name: str, grid: Any, args: Any, kwargs: Any) -> None:
            self.launches[name] += 1
            Event.launched += 1
            with torch._C.DisableTorchFunction():
                run(name, grid, [on_host(a) if isinstance(a, Tensor) else a for a in args], kwargs)

        kernels.run = launch
        patch.setattr(triton, "_runs", lambda _: True)
        patch.setattr(triton, "_PREPARED", set())
        patch.setattr(torch.cuda, "is_available", lambda: True)
        patch.setattr(torch.cuda, "current_device", lambda: 0)
        patch.setattr(torch.cuda, "Event", Event)
        patch.setattr(torch.cuda, "current_stream", lambda *_: None)
        patch.setattr(torch.cuda, "is_current_stream_capturing", lambda: self.capturing)
        patch.setattr(Event, "waited", staticmethod(lambda: self._wait("event")))
        patch.setattr(torch.cuda, "synchronize", lambda *_: self._wait("synchronize"))
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._patches.close()

    def _wait(self, kind: str) -> None:
        Event.finish_all()
        self.synchronisations.append(f"{kind} at {_line()}")

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", str(func))
        tensors = list(_tensors([*args, *kwargs.values()]))
        here = [t for t in tensors if isinstance(t, DeviceTensor)]
        if kwargs.pop("pin_memory", False):
            kwargs["device"] = "cpu"
        target = kwargs.get("device")
        if name in ("to", "cpu", "cuda") and tensors:
            return self._moved(name, args, kwargs)
        if target is not None and torch.device(target).type == "cuda":
            kwargs["device"] = "cpu"
        mixed = here and len(here) < len(tensors) and name not in MIXED
        if mixed and any(t.dim() and not isinstance(t, DeviceTensor) for t in tensors):
            raise RuntimeError(f"Expected all tensors to be on the same device ({name})")
        if here and name in WAITS:
            self._wait(name)
        if (
            here
            and name in ("__getitem__", "__setitem__")
            and any(t.dtype == torch.bool for t in _tensors(args[1:]))
        ):
            self._wait("boolean index")
        if name == "copy_" and len(here) == 1:
            return self._copied(args[0], args[1], kwargs.get("non_blocking", False))
        if here and name not in FREE + WAITS:
            self.operators[name] += 1
        found = func(*args, **kwargs)
        if here or (target is not None and torch.device(target).type == "cuda"):
            return _placed(found) if name not in WAITS else found
        return found

    def _moved(self, name: str, args: Any, kwargs: Any) -> Any:
        source, device, rest = args[0], {"cpu": "cpu", "cuda": "cuda"}.get(name), []
        for each in args[1:]:
            if isinstance(each, (str, torch.device)):
                device = torch.device(each).type
            else:
                rest.append(each)
        device = torch.device(kwargs.pop("device", device or source.device)).type
        blocking = not kwargs.pop("non_blocking", False)
        if device != source.device.type and blocking:
            self._wait(f"to {device}")
        with torch._C.DisableTorchFunction():
            made = source.as_subclass(Tensor).to(*rest, **kwargs)
        if device == source.device.type:
            self.operators["to"] += device == "cuda" and made is not source
        return made.as_subclass(DeviceTensor) if device == "cuda" else made.clone()

    def _copied(self, target: Tensor, source: Tensor, non_blocking: bool) -> Tensor:
        if not non_blocking:
            self._wait("copy_")
        self.operators["copy"] += 1
        with torch._C.DisableTorchFunction():
            values = source.as_subclass(Tensor).clone()
            if non_blocking and not isinstance(target, DeviceTensor):
                Event.pending.append((target, values))
                target.fill_(-1)
            else:
                target.as_subclass(Tensor).copy_(values)
        return target


class Event:
    """torch.cuda.Event: done when a whole iteration's kernels have been launched after it."""

    pending: list[tuple[Tensor, Tensor]] = []  # noqa: RUF012
    launched = 0

    def record(self, _: Any = None) -> None:
        """What was begun before belongs to it."""
        self.since, self.copies, Event.pending = Event.launched, Event.pending, []

    def query(self) -> bool:
        """Whether it is done."""
        done = Event.launched >= self.since + 6
        if done:
            _finish(self.copies)
        return done

    @staticmethod
    def waited() -> None:
        """The host waits for one."""

    def synchronize(self) -> None:
        """Wait for it."""
        if not self.query():
            self.waited()
            _finish(self.copies)

    @classmethod
    def finish_all(cls) -> None:
        """The host has waited."""
        _finish(cls.pending)


def _finish(copies: list[tuple[Tensor, Tensor]]) -> None:
    with torch._C.DisableTorchFunction():
        for target, values in copies:
            target.copy_(values)
    copies.clear()


def _line() -> str:
    frame = sys._getframe(1)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if "opt3dgs_optim" in path.parts:
            return f"{path.name}:{frame.f_lineno}"
        frame = frame.f_back
    return ""


def _tensors(values: Any) -> Any:
    for each in values:
        if isinstance(each, Tensor):
            yield each
        elif isinstance(each, (list, tuple)):
            yield from _tensors(each)


def _placed(value: Any) -> Any:
    if isinstance(value, Tensor):
        return value if isinstance(value, DeviceTensor) else value.as_subclass(DeviceTensor)
    if isinstance(value, (list, tuple)) and any(isinstance(each, Tensor) for each in value):
        return tuple(_placed(each) for each in value)
    return value
