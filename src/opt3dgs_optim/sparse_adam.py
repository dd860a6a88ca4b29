"""The parts around a step that is not torch's: gsplat's SelectiveAdam, INRIA's SparseGaussianAdam.

Their arithmetic and their mask stay theirs. They are given another gradient and another rate for
the time of their step, and in the own frame zeros to step from, so that what they have moved is the
step in standard deviations. Of what a step may have, `hold` and `plain` are not for them: points
out of view are held by the mask already, and moments are theirs.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, MutableMapping
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.mean import like_rows
from opt3dgs_optim.moments import MOMENTS
from opt3dgs_optim.step import (
    Step,
    axes_of,
    chosen_rows,
    finite,
    into_frame,
    out_of_frame,
)
from opt3dgs_optim.stepper import FRAME_EPS, ParamStepper
from opt3dgs_optim.training import Training

_signature = functools.lru_cache(maxsize=8)(inspect.signature)  # every step asks


def check_arguments(call: str, step: Any, given: tuple[Any, ...], named: dict[str, Any]) -> None:
    """TypeError unless a step takes these arguments, `self` the first of them."""
    try:
        _signature(step).bind(*given, **named)
    except TypeError as error:
        raise TypeError(f"{call}.step: {error}; it needs its mask, as before the upgrade") from None


def refuse_mask(call: str) -> None:
    """TypeError where torch's Adam is given more than a closure."""
    raise TypeError(
        f"{call}.step: torch's Adam takes a closure at most, and steps all rows; use gsplat's "
        "SelectiveAdam or INRIA's SparseGaussianAdam for masked steps"
    )


def refuse_capture(call: str) -> None:
    """RuntimeError where a CUDA graph is being captured."""
    raise RuntimeError(
        f"{call}.step: a CUDA graph is being captured, which would repeat this one iteration's "
        "numbers for ever; capture the rendering alone"
    )


@torch.no_grad()
def step_around(
    steppers: list[ParamStepper],
    states: MutableMapping[Tensor, dict[str, Any]],
    iteration: int,
    step_itself: Callable[[], Any],
) -> None:
    """Have the optimizer's own class make a step as the parts say; put back what it was given."""
    steps: list[tuple[ParamStepper, Step, float]] = []
    with contextlib.ExitStack() as undo:  # all of it, also where some of it fails
        for stepper in steppers:
            param = stepper.param()
            if param is not None and param.grad is not None:
                step = stepper.plan(param, states[param], iteration)
                steps.append((stepper, step, float(step.state["step"])))
                _give(step, stepper.training, undo)
        step_itself()
    for stepper, step, count in steps:
        if step.state["step"] == count:  # gsplat's and INRIA's kernels need no count, and keep none
            step.state["step"] += 1
        stepper.after(step, int(step.state["step"]))  # steps, not iterations


def _give(step: Step, training: Training, undo: contextlib.ExitStack) -> None:
    """Have the step find the gradient, the rate and the moments that the parts say.

    In the own frame, and where the factor is a device's number, it steps from zeros. What `undo`
    gets restores all that, and moves the parameter by what the step has made of the zeros.
    """
    param, group, state, factor = step.param, step.group, step.state, step.factor
    was, position = (param.grad, group["lr"], group["eps"]), param.data
    axes = None if step.frame is None else axes_of(step.frame)
    grad, bad = finite(step.grad, training.bad_numbers.counter_on(param.device))
    training.bad_numbers.add(bad)
    if axes is not None:
        grad = into_frame(axes, grad)
    on_device = isinstance(factor, Tensor)
    start = torch.zeros_like(position) if on_device or axes is not None else position
    if step.fade is not None:
        chosen = like_rows(chosen_rows(step.fade, len(param), param.device), param)
        for key, share in zip(MOMENTS, step.fade[2:], strict=True):
            state[key].copy_(torch.where(chosen, state[key] * share, state[key]))

    def put_back() -> None:
        param.grad, group["lr"], group["eps"] = was
        if start is not position:
            moved, param.data = param.data, position
            moved = moved if axes is None else out_of_frame(axes, moved)
            param.add_(moved * factor if on_device else moved)

    undo.callback(put_back)
    known = 1.0 if on_device else factor
    if step.frame is not None:
        group["lr"], group["eps"] = step.frame.rate * known, FRAME_EPS
    elif known != 1.0:
        group["lr"] = group["lr"] * known
    param.data, param.grad = start, grad
