"""The parts around a step that is not torch's: gsplat's SelectiveAdam, INRIA's SparseGaussianAdam.

Their arithmetic and their mask stay theirs. They are given another gradient and another rate for
the time of their step, and in the own frame zeros to step from, so that what they have moved is the
step in standard deviations. Of what a step may have, `hold` and `plain` are not for them: points
out of view are held by the mask already, and moments are theirs.
"""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from opt3dgs_optim.lane import MOMENTS, Lane
from opt3dgs_optim.step import (
    Axes,
    Step,
    axes_of,
    chosen_rows,
    finite,
    into_frame,
    like_rows,
    out_of_frame,
    take_into_mean,
)

if TYPE_CHECKING:
    from opt3dgs_optim.adam import StepAdam
    from opt3dgs_optim.course import Course


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
    optimizer: StepAdam, iteration: int, args: tuple[Any, ...], masks: dict[str, Any]
) -> None:
    """Have the optimizer's own class make a step as the parts say; put back what it was given."""
    steps: list[tuple[Lane, Step, float]] = []
    undo: list[tuple[Lane, Tensor, float, Tensor, Axes | None]] = []
    try:
        for lane in optimizer.present_lanes():
            if lane.param.grad is not None:
                step = optimizer.plan(lane, iteration)
                axes = None if step.frame is None else axes_of(step.frame)
                steps.append((lane, step, float(step.state["step"])))
                undo.append((lane, lane.param.grad, lane.group["lr"], lane.param.data, axes))
                _give(step, axes, optimizer.course)
        optimizer.own_class_step(*args, **masks)
    finally:
        for lane, grad, lr, position, axes in undo:
            lane.param.grad, lane.group["lr"] = grad, lr
            if axes is not None and lane.param.data_ptr() != position.data_ptr():
                moved, lane.param.data = lane.param.data, position
                lane.param.add_(out_of_frame(axes, moved))
    for lane, step, count in steps:
        if step.state["step"] == count:  # gsplat's and INRIA's kernels need no count, and keep none
            step.state["step"] += 1
        if step.mean is not None:
            made = int(step.state["step"])  # steps, not iterations
            take_into_mean(made, step.mean, step.param, *lane.mean_of(step.state))
        lane.finish(step, optimizer.course)


def _give(step: Step, axes: Axes | None, course: Course) -> None:
    """Have the step find the gradient, the rate and the moments that the parts say."""
    param, state = step.param, step.state
    grad, bad = finite(step.grad, course.counter_on(param.device))
    course.count_nonfinite(bad)
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
