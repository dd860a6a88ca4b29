"""The parts around a step that is not torch's: gsplat's SelectiveAdam, INRIA's SparseGaussianAdam.

Their arithmetic and their mask stay theirs. They are given another gradient and another rate for
the time of their step, and in the own frame zeros to step from, so that what they have moved is the
step in standard deviations. Of what a step may have, `hold` and `plain` are not for them: points
out of view are held by the mask already, and moments are theirs.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, MutableMapping
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.mean import like_rows, take_into_mean
from opt3dgs_optim.moments import MOMENTS
from opt3dgs_optim.step import (
    Axes,
    Step,
    axes_of,
    chosen_rows,
    finite,
    into_frame,
    out_of_frame,
)
from opt3dgs_optim.stepper import ParamStepper
from opt3dgs_optim.training import Training

_signature = functools.lru_cache(maxsize=8)(inspect.signature)  # every step asks


def check_arguments(call: str, step: Any, *args: Any) -> None:
    """TypeError unless a step takes these arguments: self, the others, and a dict of named ones."""
    *given, named = args
    try:
        _signature(step).bind(*given, **named)
    except TypeError as error:
        raise TypeError(f"{call}.step: {error}; it needs its mask, as before the upgrade") from None


@torch.no_grad()
def step_around(
    steppers: list[ParamStepper],
    states: MutableMapping[Tensor, dict[str, Any]],
    iteration: int,
    step_itself: Callable[[], Any],
) -> None:
    """Have the optimizer's own class make a step as the parts say; put back what it was given."""
    steps: list[tuple[ParamStepper, Step, float]] = []
    undo: list[tuple[ParamStepper, Tensor, float, Tensor, Axes | None]] = []
    try:
        for stepper in steppers:
            if stepper.param.grad is not None:
                step = stepper.plan(states[stepper.param], iteration)
                axes = None if step.frame is None else axes_of(step.frame)
                steps.append((stepper, step, float(step.state["step"])))
                undo.append(
                    (stepper, stepper.param.grad, stepper.group["lr"], stepper.param.data, axes)
                )
                _give(step, axes, stepper.training)
        step_itself()
    finally:
        for stepper, grad, lr, position, axes in undo:
            stepper.param.grad, stepper.group["lr"] = grad, lr
            if axes is not None and stepper.param.data_ptr() != position.data_ptr():
                moved, stepper.param.data = stepper.param.data, position
                stepper.param.add_(out_of_frame(axes, moved))
    for stepper, step, count in steps:
        if step.state["step"] == count:  # gsplat's and INRIA's kernels need no count, and keep none
            step.state["step"] += 1
        if step.put is not None:
            made = int(step.state["step"])  # steps, not iterations
            take_into_mean(stepper.mean(step.state, step.put, made), step.param)
        stepper.finish(step)


def _give(step: Step, axes: Axes | None, training: Training) -> None:
    """Have the step find the gradient, the rate and the moments that the parts say."""
    param, state = step.param, step.state
    grad, bad = finite(step.grad, training.bad_numbers.counter_on(param.device))
    training.bad_numbers.add(bad)
    if step.fade is not None:
        chosen = like_rows(chosen_rows(step.fade, len(param), param.device), param)
        for key, factor in zip(MOMENTS, step.fade[2:], strict=True):
            state[key].copy_(torch.where(chosen, state[key] * factor, state[key]))
    if step.frame is not None and axes is not None:
        grad = into_frame(axes, grad)
        param.data = torch.zeros_like(param.data)
        step.group["lr"] = step.frame.rate * step.factor
    elif not (isinstance(step.factor, float) and step.factor == 1.0):
        step.group["lr"] = step.group["lr"] * float(step.factor)
    param.grad = grad
