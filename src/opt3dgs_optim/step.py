"""The step of one parameter: what it has (`Step`), and how it is made (`take_step`).

Parts of a training fill in a `Step` with plain values, and may put another gradient in the place of
the parameter's. The arithmetic is here, in plain torch, which runs on every device; on a GPU
`opt3dgs_optim.triton` makes the same step in one launch. Without any of the parts it is
`torch.optim.Adam`, bit for bit on a CPU.

A row is one Gaussian: dimension 0 of a parameter. In the order in which it is made:

    gradient    numbers that are not finite count as zero
    fade        moments of random rows are shrunk
    decay       the trainer's weight decay: off the parameter (AdamW), or onto the gradient (Adam)
    frame       the gradient is turned into each Gaussian's own axes, B^T g; rows without one keep
                their moments, and move by decay alone
    hold        second moments of rows out of view are kept large
    Adam        m, v, and the step m / (sqrt(v) + eps), with bias correction
    frame       the step is turned back, B z
    mean        the iterate goes into the running mean; at the end the mean takes its place

`Part.after` comes last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from opt3dgs_optim.mean import Mean, like_rows, take_into_mean
from opt3dgs_optim.moments import CODES, chances, decoded, encode

CHUNK = 65_536  # numbers that a CPU works on at a time, so that intermediates stay in its cache
# Above it a square is infinite: Adam's second moment would stay so for ever.
LARGEST = {dtype: torch.finfo(dtype).max ** 0.5 / 2 for dtype in (torch.float32, torch.float64)}
MIN_QUATERNION = 1e-12  # a shorter one is divided by this


class Fade(NamedTuple):
    """Shrink the moments of random rows before the step."""

    key: int  # which rows: see `chosen_rows`
    share: float  # of the rows, 0..1
    exp_avg: float  # factors on the moments
    exp_avg_sq: float


class Frame(NamedTuple):
    """Step the positions [N, 3] along each Gaussian's axes, in its standard deviations.

    A row without a gradient, as of a Gaussian out of view, keeps its moments, and moves by weight
    decay alone.
    """

    rate: float  # standard deviations of a full step
    min_aspect: float  # share of the longest axis that a shorter one counts as, at least
    quats: Tensor  # [N, 4] wxyz, need not be normalised
    scales: Tensor  # [N, 3] log of the standard deviations
    longest: Tensor | None = None  # [] a longer axis counts as of this standard deviation


class Hold(NamedTuple):
    """Raise the second moment of some rows to (weight * gradient)^2 at least."""

    rows: Tensor  # [N] bool
    weight: float


@dataclass(slots=True)
class Step:
    """What the step of one parameter has in one iteration. Parts set what they want of it.

    Attributes:
        param, grad: [N, ...] float32 or float64, and the gradient that Adam is fed. A part may put
            another tensor of that shape in its place, but not write into it.
        name: gsplat's name of the Gaussian parameter, or None.
        set: the set of Gaussians that it belongs to, "" where there is one.
        group, state: torch's parameter group and the optimizer's state of the parameter.
        iteration: of the training, from 0.
        stepped_in: the iteration of the parameter's step before this one; of its first step, the
            iteration before it.
        keep: `keep(state, key, shape)` is what a part keeps for the rows, see
            `ParamStepper.keep`.
        factor: on the learning rate; on a device it may be a tensor of one element.
        fresh: Adam's moments begin anew before the step.
        plain: no moments and no frame: the step is the gradient times the rate.
        decayed: the gradient has the trainer's weight decay of Adam's kind in it.
        fade, frame, hold: see there; None: not in this step.
        put: whether the running mean, with this iterate in it, takes the parameter's place; None:
            this iterate is not averaged.
        every: of so many of Adam's steps one goes into the mean, and all where it is put.

    Adam's numbers are set when the parts have planned, from the group and the state:

        lr, beta1, beta2, eps: as torch's.
        correction1, sqrt_correction2: 1 - beta1^t and sqrt(1 - beta2^t).
        shrink: factor on the parameter (decoupled weight decay).
        decay: share of the parameter in the gradient (the other kind).
        mean: the running mean; None: it takes no iterate now.
        nonfinite: [1] int32 on the device, counts numbers; None on a CPU.
        rounding: 32 bits on which the rounding of moments to codes depends.
    """

    param: Tensor
    grad: Tensor
    name: str | None
    set: str
    group: dict[str, Any]
    state: dict[str, Any]
    iteration: int
    stepped_in: int
    keep: Any = None
    factor: Any = 1.0
    fresh: bool = False
    plain: bool = False
    decayed: bool = False
    fade: Fade | None = None
    frame: Frame | None = None
    hold: Hold | None = None
    put: bool | None = None
    every: int = 1
    lr: float = 0.0
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    correction1: float = 1.0
    sqrt_correction2: float = 1.0
    shrink: float = 1.0
    decay: float = 0.0
    mean: Mean | None = None
    nonfinite: Tensor | None = None
    rounding: int = 0


def take_step(step: Step) -> int:  # noqa: PLR0912, PLR0915  (all a step has)
    """Make the step in plain torch; how many numbers of the gradient were not finite (CPU only).

    On other devices they are added to `step.nonfinite`, so that nothing waits.
    """
    chance: Any = None
    fade, all_rows, bad = step.fade, step.param, 0
    first, second = step.state["exp_avg"], step.state["exp_avg_sq"]
    chosen = None if fade is None else chosen_rows(fade, len(all_rows), all_rows.device)
    chunks: Sequence[Any] = (...,)
    if all_rows.is_cpu and all_rows.numel() > 2 * CHUNK:
        size = max(1, CHUNK * len(all_rows) // all_rows.numel())
        chunks = [slice(i, i + size) for i in range(0, len(all_rows), size)]
    for rows in chunks:
        exp_avg, exp_avg_sq = codes = first[rows], second[rows]
        coded = exp_avg.dtype == CODES
        if coded:
            exp_avg, exp_avg_sq = decoded(exp_avg, exp_avg_sq)
            at = 0 if rows is ... else rows.start * (all_rows.numel() // len(all_rows))
            chance = chances(exp_avg, step.rounding, at)
        param = all_rows[rows]
        grad, found = finite(step.grad[rows], step.nonfinite)
        bad += found
        if fade is not None and chosen is not None:
            faded = like_rows(chosen[rows], param)
            exp_avg.copy_(torch.where(faded, exp_avg * fade.exp_avg, exp_avg))
            exp_avg_sq.copy_(torch.where(faded, exp_avg_sq * fade.exp_avg_sq, exp_avg_sq))
        axes = None if step.frame is None else axes_of(step.frame, rows)
        seen = None if axes is None else grad.any(1, keepdim=True)
        if step.shrink != 1.0:
            param.mul_(step.shrink)
        if step.decay:
            grad = grad.add(param, alpha=step.decay)
        if axes is not None:
            grad = into_frame(axes, grad)
        if step.hold is not None:
            least = (grad * step.hold.weight).square_()
            least = torch.where(like_rows(step.hold.rows[rows], grad), least, 0.0)
            torch.maximum(exp_avg_sq, least, out=exp_avg_sq)
        if step.plain:
            param.sub_(grad * (step.lr * step.factor))
        else:
            kept = () if seen is None else (exp_avg.clone(), exp_avg_sq.clone())
            exp_avg.lerp_(grad, 1 - step.beta1)
            exp_avg_sq.mul_(step.beta2).addcmul_(grad, grad, value=1 - step.beta2)
            root = exp_avg_sq.sqrt().div_(step.sqrt_correction2).add_(step.eps)
            if step.frame is not None and axes is not None and seen is not None:
                rate = step.frame.rate * step.factor / step.correction1
                moved = out_of_frame(axes, (exp_avg / root).mul_(rate))
                param.sub_(torch.where(seen, moved, 0.0))
                for moment, old in zip((exp_avg, exp_avg_sq), kept, strict=True):
                    moment.copy_(torch.where(seen, moment, old))
            elif isinstance(step.factor, Tensor):  # a device's number, which the host does not know
                param.sub_((exp_avg / root).mul_(step.factor * (step.lr / step.correction1)))
            else:
                param.addcdiv_(exp_avg, root, value=-(step.lr * step.factor / step.correction1))
        if step.mean is not None:
            take_into_mean(step.mean, param, rows, chance)
        if coded and not step.plain:
            encode(exp_avg, exp_avg_sq, *codes, chance)
    return bad


def finite(grad: Tensor, nonfinite: Tensor | None) -> tuple[Tensor, int]:
    """The gradient with zeros for numbers that are not finite; on a CPU how many there were."""
    if grad.is_cpu:
        if math.isfinite(grad.sum().item()):  # a finite sum has finite terms
            return grad, 0
        bad = grad.numel() - int(torch.isfinite(grad).sum())
        return (torch.nan_to_num(grad, 0.0, 0.0, 0.0) if bad else grad), bad
    if nonfinite is not None:
        nonfinite.add_((~torch.isfinite(grad)).sum())
    return torch.nan_to_num(grad, 0.0, 0.0, 0.0), 0


# -- which rows an event fades ---------------------------------------------------------------------


def mixed(number: Any) -> Any:
    """32 bits, each of which depends on all of those of a number: an int, or int64 tensor.

    Two rounds of multiply and shift (Wellons, "hash prospector", 2018: its `lowbias32`).
    """
    number = ((number ^ (number >> 16)) * 0x7FEB352D) & 0xFFFFFFFF
    number = ((number ^ (number >> 15)) * 0x846CA68B) & 0xFFFFFFFF
    return number ^ (number >> 16)


def chosen_rows(fade: Fade, count: int, device: torch.device) -> Tensor:
    """[count] bool: whether an event fades a row. The same on every device."""
    row = torch.arange(count, dtype=torch.int64, device=device)
    return (mixed(row ^ fade.key) >> 8).to(torch.float32) * 2.0**-24 < fade.share


# -- own frames ------------------------------------------------------------------------------------


class Axes(NamedTuple):
    """B = R diag(s) of n Gaussians, Sigma = B B^T, by columns [n], which a CPU is fast at."""

    quaternion: tuple[Tensor, ...]  # w, x, y, z of R, of length 1
    deviations: tuple[Tensor, ...]  # s along each axis


def axes_of(frame: Frame, rows: Any = ...) -> Axes:
    """The axes of the Gaussians, as they are used."""
    w, x, y, z = frame.quats.detach()[rows].unbind(1)
    square = torch.addcmul(torch.addcmul(torch.addcmul(w * w, x, x), y, y), z, z)
    inverse = square.sqrt_().clamp_(min=MIN_QUATERNION).reciprocal_()
    quaternion = w * inverse, x * inverse, y * inverse, z * inverse
    deviations = frame.scales.detach()[rows].exp()
    if frame.longest is not None:
        deviations.clamp_(max=frame.longest)
    a, b, c = deviations.unbind(1)
    least = torch.maximum(torch.maximum(a, b), c).mul_(frame.min_aspect)
    thick = torch.maximum(a, least), torch.maximum(b, least), torch.maximum(c, least)
    return Axes(quaternion, thick)


def into_frame(axes: Axes, vectors: Tensor) -> Tensor:
    """B^T v [n, 3]; zero where that is no number that Adam can square."""
    x, y, z = turn(axes.quaternion, vectors.unbind(1), -1)
    a, b, c = axes.deviations
    found = torch.stack((x.mul_(a), y.mul_(b), z.mul_(c)), 1)
    return _within(LARGEST[vectors.dtype], found)


def out_of_frame(axes: Axes, vectors: Tensor) -> Tensor:
    """B v [n, 3]; zero where that is not finite."""
    (x, y, z), (a, b, c) = vectors.unbind(1), axes.deviations
    found = torch.stack(turn(axes.quaternion, (x * a, y * b, z * c), 1), 1)
    return _within(torch.finfo(vectors.dtype).max, found)


def turn(quaternion: Sequence[Tensor], vector: Sequence[Tensor], direction: int) -> list[Tensor]:
    """R v, or R^T v where the direction is -1, by columns: v + w t + u x t with t = 2 u x v.

    The quaternion is w and u = (x, y, z). The other direction is that of -u.
    """
    w, *u = quaternion
    t, found = cross(u, vector), list(vector)
    for each in t:
        each.mul_(2 * direction)
    across = cross(u, t)
    for i in range(3):
        found[i] = torch.addcmul(found[i], w, t[i]).add_(across[i], alpha=direction)
    return found


def cross(a: Sequence[Tensor], b: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """The cross product of vectors, by columns."""
    return (
        torch.addcmul(a[1] * b[2], a[2], b[1], value=-1),
        torch.addcmul(a[2] * b[0], a[0], b[2], value=-1),
        torch.addcmul(a[0] * b[1], a[1], b[0], value=-1),
    )


def _within(largest: float, numbers: Tensor) -> Tensor:
    """The numbers, with zeros for those that are larger, or NaN."""
    if numbers.is_cpu and (not numbers.numel() or numbers.abs().amax().item() <= largest):
        return numbers
    return torch.where(numbers.abs() <= largest, numbers, 0.0)
