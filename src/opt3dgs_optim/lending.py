"""What a step lends to torch's Adam, and takes back whatever happens."""

import cmath
import functools
import inspect
import operator
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, TypedDict

import torch
from torch import Tensor
from torch.optim import Adam

from opt3dgs_optim.checks import LOGGER
from opt3dgs_optim.course import Course
from opt3dgs_optim.part import Group
from opt3dgs_optim.rows import Frozen


class AdamOptions(TypedDict, total=False):
    """torch.optim.Adam's keyword-only options."""

    foreach: bool | None
    maximize: bool
    capturable: bool
    differentiable: bool
    fused: bool | None
    decoupled_weight_decay: bool


class Lent(AbstractContextManager["Lent"]):
    """Learning rates, gradients and flags that stand in place of others until the `with` ends.

    Attributes:
        frozen: rows that are to be put back after it.
    """

    def __init__(self) -> None:
        self.frozen: list[Frozen] = []
        self._kept: list[tuple[Callable[..., None], Any, str, Any]] = []  # an ExitStack takes 5 us

    def __exit__(self, *_: object) -> None:
        for put, owner, name, kept in reversed(self._kept):
            put(owner, name, kept)

    def item(self, owner: dict[str, Any], key: str, value: Any) -> None:
        """Put `value` in place of `owner[key]`."""
        self._kept.append((operator.setitem, owner, key, owner[key]))
        owner[key] = value

    def attribute(self, owner: Any, name: str, value: Any) -> None:
        """Put `value` in place of `owner.name`; None where there is none."""
        self._kept.append((setattr, owner, name, getattr(owner, name, None)))
        setattr(owner, name, value)

    def rate(self, group: Group, factors: list[Any], valid: Tensor | bool) -> None:
        """lr times the factors, never left in the group: schedulers would compound it.

        Not on decoupled weight decay, which would grow weights where a factor is negative.
        `valid` is 0-d, whether the step will be made, where only the device knows.
        """
        if not factors:
            return
        rate, factor = group["lr"], functools.reduce(operator.mul, factors)
        if isinstance(factor, Tensor):
            if factor.device.type == "cpu":
                factor = factor.item()
            else:  # fused Adam reads a float32 learning rate from the device
                device = group["params"][0].device
                factor = factor.to(device=device, dtype=torch.float32, non_blocking=True)
        if group.get("decoupled_weight_decay") and group["weight_decay"]:
            kept = 1 - rate * group["weight_decay"]
            kept = torch.where(valid, kept, 1.0) if isinstance(valid, Tensor) else kept
            for param in group["params"]:
                if param.grad is not None:
                    param.mul_(kept)
            self.item(group, "weight_decay", 0.0)
        self.item(group, "lr", rate * factor)


def use_fused(optimizer: Any) -> None:
    """Only torch's fused path takes a factor, and drops a step, on the device."""
    optimizer.defaults["fused"] = True
    optimizer._step_supports_amp_scaling = True
    for group in optimizer.param_groups:
        group["fused"] = True
        for param in group["params"]:
            state = optimizer.state.get(param)
            if state:
                state["step"] = state["step"].to(param.device, torch.float32)


def guard(grad: Tensor, course: Course, told: bool) -> bool:
    """Take numbers in a gradient that are not finite as zero, in place.

    Returns whether there were any; False where only the device knows.
    """
    on_host = grad.is_cpu
    # The sum is finite unless a summand is not, or it overflows.
    if on_host and cmath.isfinite(grad.sum().item()):
        return False
    grad.nan_to_num_(0.0, 0.0, 0.0)
    if on_host and not told:
        said = "iteration %d: a gradient of shape %s is not finite; such numbers count as zero"
        LOGGER.warning(said, course.current, tuple(grad.shape))
    return on_host


def refuse_capture(call: str, course: Course) -> None:
    """RuntimeError in the capture of a CUDA graph: its replays would repeat what parts say now."""
    if course.parts and torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing():
        raise RuntimeError(
            f"{call}.step: a CUDA graph is being captured, but its replays would repeat this "
            "iteration's factors and phase; leave the optimizers' steps out of it"
        )


@functools.cache
def own_step(base: type[Adam]) -> tuple[Callable[..., Any], bool]:
    """The step of an Adam; whether it is INRIA's `step(mask, N)`."""
    # Unwrapped: torch's step hooks and its profiler are around our step already.
    step = inspect.unwrap(base.step)
    return step, len(inspect.signature(step).parameters) > 2
