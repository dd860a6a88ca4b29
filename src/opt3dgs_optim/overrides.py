"""What a step puts in place of the trainer's values for torch's Adam, and takes back."""

import functools
import inspect
import operator
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, ParamSpec, TypedDict, TypeVar

import torch
from torch import Tensor
from torch._C._autograd import _profiler_enabled
from torch._compile import _disable_dynamo
from torch.autograd import profiler
from torch.compiler import is_dynamo_compiling
from torch.optim import Adam, Optimizer
from torch.optim.optimizer import _global_optimizer_post_hooks, _global_optimizer_pre_hooks

from opt3dgs_optim.part import Group
from opt3dgs_optim.state import broadcast_rows

P = ParamSpec("P")
R = TypeVar("R")


class AdamOptions(TypedDict, total=False):
    """torch.optim.Adam's keyword-only options."""

    foreach: bool | None
    maximize: bool
    capturable: bool
    differentiable: bool
    fused: bool | None
    decoupled_weight_decay: bool


class TemporaryOverrides(AbstractContextManager["TemporaryOverrides"]):
    """Learning rates, gradients and flags that stand in place of others until the `with` ends.

    They are restored in reverse order, whatever happens in between or meanwhile.
    """

    def __init__(self) -> None:
        # A list of our own, because an ExitStack takes 5 us.
        self._previous: list[tuple[Callable[..., None], Any, Any, Any]] = []

    def __exit__(self, *_: object) -> None:
        try:
            while self._previous:
                restore, owner, name, value = self._previous[-1]
                restore(owner, name, value)
                del self._previous[-1]
        except BaseException:  # Ctrl-C: the rest first
            self.__exit__()
            raise

    def item(self, owner: Any, key: Any, value: Any) -> None:
        """Put `value` in place of `owner[key]`."""
        self._previous.append((operator.setitem, owner, key, owner[key]))
        owner[key] = value

    def attribute(self, owner: Any, name: str, value: Any) -> None:
        """Put `value` in place of `owner.name`; None where there is none."""
        self._previous.append((setattr, owner, name, getattr(owner, name, None)))
        setattr(owner, name, value)

    def extra_item(self, owner: Any, key: Any, value: Any) -> None:
        """Have `owner[key]`, which is not there otherwise."""
        self._previous.append((_delete, owner, key, None))
        owner[key] = value


def uncompiled(function: Callable[P, R]) -> Callable[P, R]:
    """A function that runs as it is in a compiled one, at no cost outside of one.

    torch's own decorator for it changes the interpreter's state in every call, compiled or not.
    """
    disabled = _disable_dynamo(function)

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        if is_dynamo_compiling():
            return disabled(*args, **kwargs)
        return function(*args, **kwargs)

    return called


def as_step(function: Callable[P, R]) -> Callable[P, R]:
    """A method as a step of torch's optimizers: with step hooks, a profiler's range, uncompiled.

    torch's own decorator enters the range in every step, whether anybody profiles or not. With few
    points that takes a good part of the time of a step.
    """
    watched = Optimizer.profile_hook_step(function)
    disabled = _disable_dynamo(watched)

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        if is_dynamo_compiling():
            return disabled(*args, **kwargs)
        optimizer: Any = args[0]
        # A subclass's step may be around this one, and torch's hooks around that.
        if type(optimizer).step is not called:
            return function(*args, **kwargs)
        hooked = optimizer._optimizer_step_pre_hooks or _global_optimizer_pre_hooks
        if hooked or _profiler_enabled() or profiler._is_profiler_enabled:
            return watched(*args, **kwargs)
        found = function(*args, **kwargs)
        own = optimizer._optimizer_step_post_hooks
        if own or _global_optimizer_post_hooks:  # a closure may have registered one
            for hook in [*own.values(), *_global_optimizer_post_hooks.values()]:
                hook(optimizer, args, kwargs)
        return found

    vars(called)["hooked"] = True  # torch adds nothing to it
    return called


def without_torchs_own(step: Callable[..., Any]) -> Callable[..., Any]:
    """A step without the decorators of torch's optimizers; those of others stay."""
    torchs = Optimizer.profile_hook_step.__code__.co_filename

    def is_anothers(wrapper: Any) -> bool:
        return getattr(getattr(wrapper, "__code__", None), "co_filename", None) != torchs

    return inspect.unwrap(step, stop=is_anothers)


def _delete(owner: Any, key: Any, _: Any) -> None:
    owner.pop(key, None)


def is_moving_rate(rate: float | Tensor) -> bool:
    """Whether a learning rate is not 0; one on a device is taken for moving, without a wait."""
    return bool((isinstance(rate, Tensor) and not rate.is_cpu) or rate)


class WeightDecay:
    """Decoupled weight decay of a group, by the learning rate that the trainer has given it.

    Args:
        params: of the group, or what Adam moves in their place.
        rows: [N] bool, those that a mask lets move; None: all.
    """

    def __init__(
        self,
        group: Group,
        params: list[Tensor],
        counts: Tensor | bool,
        rows: Tensor | None = None,
    ) -> None:
        self._kept: Any = 1 - group["lr"] * group["weight_decay"]
        self._params, self._counts, self._rows = list(params), counts, rows

    @torch.no_grad()
    def make(self) -> None:
        """Shrink the parameters that have a gradient."""
        for param in self._params:
            if param.grad is None:
                continue
            rows = self._rows
            made: Any = True if rows is None else broadcast_rows(rows.to(param.device), param)
            if isinstance(self._counts, Tensor):
                made = self._counts.to(param.device) & made
            # .data: no write of the trainer's that a part should notice by the version counter.
            if made is True:
                param.data.mul_(self._kept)
            else:
                param.data.copy_(torch.where(made, param * self._kept, param))


def scale_learning_rate(
    overrides: TemporaryOverrides,
    group: Group,
    params: list[Tensor],
    factors: list[Any],
    counts: Tensor | bool,
    decays: list[WeightDecay],
    read: Callable[[Tensor], float],
) -> None:
    """lr times the factors, never left in the group: schedulers would compound it.

    Not on decoupled weight decay, which would grow weights where a factor is negative: that goes to
    `decays`, for `params`, which Adam moves. `counts` is whether the step will be made, 0-d where
    only the device knows; `read` gives a device's number to the host.
    """
    if not factors:
        return
    device = next((param.device for param in group["params"]), torch.device("cpu"))
    # Fused Adam reads a float32 rate from the device. Other paths need a number on the host, as do
    # parameters there, where a copy that is not waited for may be read before it is made.
    on_device = device.type != "cpu" and (group["fused"] or group["capturable"])
    # Each by itself: a product would be read again for every group.
    known: list[Any] = [
        read(each) if isinstance(each, Tensor) and (each.is_cpu or not on_device) else each
        for each in factors
    ]
    rate, factor = group["lr"], functools.reduce(operator.mul, known)
    if isinstance(factor, Tensor):
        factor = factor.to(device=device, dtype=torch.float32, non_blocking=True)
    if group.get("decoupled_weight_decay") and group["weight_decay"]:
        decays.append(WeightDecay(group, params, counts))
        overrides.item(group, "weight_decay", 0.0)
    overrides.item(group, "lr", rate * factor)


def can_be_fused(optimizer: Any) -> bool:
    """Whether torch's fused path can take the optimizer, whose user has asked for no other path."""
    tensors = [param for group in optimizer.param_groups for param in group["params"]]
    asked = any(
        group["capturable"]
        or group.get("differentiable")
        or (group["fused"], group["foreach"]) != (None, None)
        for group in optimizer.param_groups
    )
    return (
        bool(tensors)
        and not asked
        and all(param.is_cuda and param.is_floating_point() for param in tensors)
    )


def use_fused(optimizer: Any) -> None:
    """Take torch's fused path: it alone takes a factor, and drops a step, on the device."""
    optimizer.defaults["fused"] = True
    optimizer._step_supports_amp_scaling = True
    for group in optimizer.param_groups:
        group["fused"] = True
        for param in group["params"]:
            state = optimizer.state.get(param)
            if state:
                state["step"] = state["step"].to(param.device, torch.float32)


def zero_nonfinite(grad: Tensor) -> bool | Tensor:
    """Take numbers in a gradient that are not finite as zero, in place.

    Returns whether there were any, 0-d where only the device knows.

    Args:
        grad: on a CPU, one whose sum is not finite.
    """
    if grad.is_cpu:
        found = not bool(grad.isfinite().all())
        grad.nan_to_num_(0.0, 0.0, 0.0)
        return found
    found = ~grad.sum().isfinite()
    grad.nan_to_num_(0.0, 0.0, 0.0)
    return found


def refuse_capture(optimizer: Any) -> None:
    """RuntimeError in the capture of a CUDA graph: its replays would repeat what parts say now."""
    if not optimizer.course.parts or not torch.cuda.is_initialized():
        return
    if torch.cuda.is_current_stream_capturing():
        raise RuntimeError(
            f"{optimizer.call_name}.step: a CUDA graph is being captured, but its replays would "
            "repeat this iteration's factors and phase; leave the optimizers' steps out of it"
        )


@functools.cache
def own_step(base: type[Adam]) -> tuple[Callable[..., Any], bool]:
    """The step of an Adam; whether it is INRIA's `step(mask, N)`."""
    # Unwrapped: torch's step hooks and its profiler are around our step already.
    step = without_torchs_own(base.step)
    return step, len(inspect.signature(step).parameters) > 2
