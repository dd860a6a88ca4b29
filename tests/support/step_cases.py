"""Steps of a parameter with all that they can have, by plain torch and by the kernels."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor

from opt3dgs_optim import triton
from opt3dgs_optim.mean import Mean, like_rows, mean_of_residue
from opt3dgs_optim.moments import CODES, MOMENTS, NEAREST, decoded, encode
from opt3dgs_optim.step import (
    Fade,
    Frame,
    Hold,
    Step,
    mixed,
    take_step,
)

PARTS = (Fade, Frame, Hold)
SHAPES = ((257, 3), (31, 4), (1000,), (19, 15, 3))


def case(
    shape: tuple[int, ...],
    generator: torch.Generator,
    *,
    steps: int = 10,
    fade: bool = False,
    frame: bool = False,
    hold: bool = False,
    mean: bool = False,
    put: bool = False,
    plain: bool = False,
    factor: Any = 1.0,
    shrink: float = 1.0,
    decay: float = 0.0,
    bad: int = 0,
    coded: bool = False,
) -> Step:
    """A step of a parameter amid a training, with what is asked for, from random numbers.

    Args:
        steps: of Adam, with this one. bad: how many numbers of the gradient are not finite.
        coded: whether the moments are codes of 16 bits.
    """

    def draw(*size: int) -> Tensor:
        return torch.randn(size, generator=generator)

    rows = shape[0]
    param, grad = draw(*shape), draw(*shape) * 10.0 ** (draw(*shape) * 2).clamp(-6, 6)
    exp_avg, exp_avg_sq = 0.1 * draw(*shape), draw(*shape).square()
    if frame:
        grad[1::5] = 0.0  # out of view
    grad.view(-1)[:bad] = torch.tensor([float("nan"), float("inf"), -float("inf")])[
        torch.arange(min(bad, grad.numel())) % 3
    ]
    if coded:
        codes = torch.zeros(2, *shape, dtype=CODES)
        encode(exp_avg, exp_avg_sq, codes[0], codes[1], NEAREST)
        exp_avg, exp_avg_sq = codes[0], codes[1]
        exp_avg[:1] = exp_avg_sq[:1] = 0  # a row without history
    step = Step(param, grad, None, "", {}, {"exp_avg": exp_avg, "exp_avg_sq": exp_avg_sq}, 0, -1)
    step.factor, step.plain = factor, plain
    if fade:
        step.fade = Fade(0x9E3779B1, 0.3, 0.2, 0.04)
    if frame:
        step.frame = Frame(0.1, 0.1, draw(rows, 4), draw(rows, 3) - 3, draw().sub(3).exp())
    if hold:
        step.hold = Hold(draw(rows) < 0, 7.0)
    step.lr, step.shrink, step.decay = 1e-2, shrink, decay
    step.correction1, step.sqrt_correction2 = 1 - 0.9**steps, (1 - 0.999**steps) ** 0.5
    step.nonfinite, step.rounding = torch.zeros(1, dtype=torch.int32), mixed(steps)
    if mean:
        began, grid = torch.randint(0, steps, (rows,), generator=generator).to(torch.float32), 1.0
        kept = (param + 0.1 * draw(*shape)).mul_(like_rows(began > 0, param))  # others begin now
        if coded and not frame:
            grid = 2.0**-12
            kept = (kept / grid).to(torch.int32).to(CODES)
        sums = kept.dtype != CODES and shape[1:] == (3,)  # as positions have it
        rest = 1e-8 * draw(*shape) if sums else None
        step.mean = Mean(put, steps, kept, began, grid, rest)
    return step


def moved(value: Any, place: Callable[[Tensor], Tensor]) -> Any:
    """A step, or what it has, with all tensors where `place` puts them."""
    if isinstance(value, Tensor):
        return place(value)
    if isinstance(value, dict):
        return {key: moved(each, place) for key, each in value.items()}
    if is_dataclass(value):
        each = {field.name: getattr(value, field.name) for field in fields(value)}
        return replace(cast(Any, value), **moved(each, place))
    return type(value)(*(moved(each, place) for each in value)) if type(value) in PARTS else value


def tensors(step: Step) -> list[Tensor]:
    """What a step changes."""
    moments = [step.state["exp_avg"], step.state["exp_avg_sq"]]
    if moments[0].dtype == CODES:
        moments = list(decoded(*moments))
    found = [step.param, *moments]
    if step.mean is None:
        return found
    mean = step.mean.tensor
    if mean.dtype == CODES:
        mean = mean_of_residue(step.param, mean, step.mean.grid)
    rest = [] if step.mean.rest is None else [step.mean.rest]
    return [*found, mean, *rest, step.mean.began]


def launched(step: Step) -> Step:
    """The step, made by the kernels where it lies."""
    assert triton.fits(step), step
    triton.launch(step)
    return step


def both(
    options: dict[str, Any],
    shape: tuple[int, ...],
    seed: int = 0,
    by: Callable[[Step], Step] = launched,
) -> tuple[Any, Any]:
    """The same case, stepped by plain torch, and by the kernels."""
    ours, theirs = (case(shape, torch.Generator().manual_seed(seed), **options) for _ in range(2))
    bad = take_step(ours)
    assert ours.nonfinite is not None
    ours.nonfinite += bad
    return ours, by(theirs)


def difference(options: dict[str, Any], shape: tuple[int, ...], seed: int = 0) -> float:
    """The largest difference, as a share of a number's size (of 1 for smaller ones).

    In the own frame, of the longest of the row's three: they are sums that may cancel.
    Infinite where one is not finite and the other is, or other numbers were counted as not finite.
    """
    step, step2 = both(options, shape, seed)
    assert step.nonfinite is not None
    assert step2.nonfinite is not None
    if not torch.equal(step.nonfinite, step2.nonfinite):
        return float("inf")
    worst = 0.0
    for ours, theirs in zip(tensors(step), tensors(step2), strict=True):
        if not ours.numel():
            continue
        known = torch.isfinite(ours)
        if not torch.equal(known, torch.isfinite(theirs)):
            return float("inf")
        size = torch.where(known, ours, 0.0).abs()
        size = size.amax(1, keepdim=True) if step.frame is not None and ours.dim() > 1 else size
        away = (ours - theirs).abs() / size.clamp(min=1.0)
        worst = max(worst, float(away[known].max()) if known.any() else 0.0)
    return worst


def combinations() -> Iterator[tuple[dict[str, Any], tuple[int, ...]]]:
    """Steps with everything that can meet in one."""
    for shape, (fade, hold, mean) in itertools.product(
        SHAPES, itertools.product((False, True), repeat=3)
    ):
        yield {"fade": fade, "hold": hold, "mean": mean, "bad": 5, "shrink": 0.999}, shape
    for mean, decay in itertools.product((False, True), (0.0, 0.01)):
        options = {"mean": mean, "put": mean, "decay": decay, "bad": 2}
        yield {"frame": True, **options}, (257, 3)
        yield {"factor": torch.tensor(0.7), **options}, (257, 4)


def coded_combinations() -> Iterator[tuple[dict[str, Any], tuple[int, ...]]]:
    """Steps on codes of 16 bits, and means of them, with what can meet in one."""
    for shape, kind in (
        ((257, 3), {}),
        ((19, 15, 3), {"hold": True, "fade": True, "bad": 5}),
        ((257, 3), {"frame": True, "bad": 2}),
    ):
        for mean, put in ((False, False), (True, False), (True, True)):
            yield {"coded": True, "mean": mean, "put": put, **kind}, shape


def codes_apart(ours: Step, theirs: Step) -> Iterator[Tensor]:
    """By how many codes, or places of a mean of 16 bits, each number of two steps is apart."""
    for one, other in zip(*(numbers_and_codes(step)[1] for step in (ours, theirs)), strict=True):
        away = (one.to(torch.int32) - other.to(torch.int32)).abs()
        yield torch.minimum(away, 2**16 - away)  # the codes of second moments have no sign


def numbers_and_codes(step: Step) -> tuple[list[Tensor], list[Tensor]]:
    """What a step on codes changes."""
    mean = step.mean
    kept = [] if mean is None else [mean.tensor, mean.began]
    if mean is not None and mean.rest is not None:
        kept.append(mean.rest)
    changed = [step.param, *(step.state[key] for key in MOMENTS), *kept]
    codes = [each for each in changed if each.dtype == CODES]
    return [each for each in changed if each.dtype != CODES], codes


def interprets() -> bool:
    """Whether this Triton's interpreter writes into tensors of a CPU: beside numpy 2, from 3.2."""
    step = case((triton.ROWS_BLOCK + 1,), torch.Generator().manual_seed(0))
    before = [each.clone() for each in tensors(step)]
    triton.launch(step)
    # Anything: a kernel that leaves something out is a wrong one, not an old interpreter.
    return not all(map(torch.equal, before, tensors(step)))
