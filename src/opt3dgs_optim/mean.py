"""The running mean of the last iterates: where it lies, how an iterate goes into it, how it is put.

Beside moments of 32 bits it is a tensor like the parameter. Beside moments of 16 bits it is int16,
the lower bits of its place on a fixed grid. The mean of positions is float32 in both: their unit is
the scene's, and no grid fits all scenes. Far from the origin a position has few digits for its
fractions, so that a second tensor has what rounding leaves of its mean (Kahan 1965).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.moments import CODES

MEAN, BEGAN = "averaging.mean", "averaging.began"  # in the optimizer's state, of the rows
RESIDUE = "averaging.residue"  # in the place of the mean, beside moments of 16 bits
REST = "averaging.rest"  # of the mean of positions: what float32 has no digits for
OF_MEAN = (MEAN, RESIDUE, REST, BEGAN)
# The grids of means of 16 bits, see `take_into_residue`. They reach for 2, 2, 16, 2 and 1, further
# than parameters go in the last thirtieth at a hundred times the usual rates.
GRIDS = {"scales": 2**-14, "quats": 2**-14, "opacities": 2**-11, "sh0": 2**-14, "shN": 2**-15}
MAX_PLACE = 2.0**23  # on a grid, from which on float32 has no fractions
MAX_AWAY = 24_576.0  # places of a mean from its iterate; a step may have another 8,192


@dataclass(slots=True)
class Mean:
    """The running mean of a parameter, and what this step does with it."""

    put: bool  # whether it takes the parameter's place
    count: float  # of iterates, with this one, since the training began
    tensor: Tensor  # [N, ...] like the parameter, or int16: see `take_into_residue`
    began: Tensor  # [N] the `count` with which a row's mean began; 0: not yet
    grid: float = 1.0  # of a mean of int16
    rest: Tensor | None = None  # [N, 3] of positions, beside the mean


def mean_of(
    param: Tensor, state: dict[str, Any], name: str | None, put: bool, count: float
) -> Mean:
    """The running mean of a parameter, in the form that goes with its moments; made if need be.

    Args:
        param: [N, ...]. state: the optimizer's of it.
        name: gsplat's name of the Gaussian parameter, or None.
        put, count: as in `Mean`.
    """
    grid = GRIDS.get(name or "") if state["exp_avg"].dtype is CODES else None
    key = MEAN if grid is None else RESIDUE
    mean, began, rest = state.get(key), state.get(BEGAN), state.get(REST)
    numbers = param.numel()
    if (
        mean is None or began is None or mean.numel() != numbers
        or (name == "means" and (rest is None or rest.numel() != numbers))
    ):  # fmt: skip
        drop_means([state])
        mean = torch.zeros_like(param, dtype=None if grid is None else CODES)
        began = torch.zeros(param.shape[:1], dtype=param.dtype, device=param.device)
        rest = torch.zeros_like(param) if name == "means" else None
        kept = {key: mean, BEGAN: began, REST: rest}
        state.update({k: v for k, v in kept.items() if v is not None})
    elif mean.dtype is not CODES and grid is not None:
        mean = state[key] = mean.to(CODES)  # an edit of rows, and torch's loading, make it float32
    return Mean(put, count, mean, began, grid or 1.0, rest)


def drop_means(states: Iterable[dict[str, Any]]) -> None:
    """Have no running means."""
    for state in states:
        for key in OF_MEAN:
            state.pop(key, None)


def kept_in(state: Mapping[str, Any]) -> list[str]:
    """What is kept for rows beside Adam's moments, by name: means, and what parts keep."""
    return [key for key in state if "." in key]


def drop_kept(state: dict[str, Any]) -> None:
    """Have nothing kept for rows beside Adam's moments."""
    for key in kept_in(state):
        del state[key]


def like_rows(numbers: Tensor, param: Tensor) -> Tensor:
    """Numbers of rows [N] that broadcast with a parameter [N, ...]; of one number [] alone."""
    return numbers.view((*numbers.shape, *[1] * (param.dim() - numbers.dim())))


def take_into_mean(
    mean: Mean, param: Tensor, rows: Any = ..., chance: Tensor | None = None
) -> None:
    """Take an iterate, these rows of the parameter, into the mean.

    An iterate that is not finite leaves its mean alone; a mean that is not begins with it. A row
    that has `began` with 0 begins now. `chance` is of a mean of int16, see `take_into_residue`.
    """
    tensor, began = mean.tensor[rows], mean.began[rows]
    began.masked_fill_(began == 0, mean.count)
    weight = like_rows(1.0 / (mean.count + 1 - began), param)
    if tensor.dtype == CODES:
        assert chance is not None
        take_into_residue(mean.put, param, tensor, weight, mean.grid, chance)
        return
    if mean.rest is not None:
        take_with_rest(mean.put, param, tensor, mean.rest[rows], weight.to(param.dtype))
        return
    if param.is_cpu and math.isfinite((param.sum() + tensor.sum()).item()):
        tensor.lerp_(param, weight.to(param.dtype))
        if mean.put:
            param.copy_(tensor)
        return
    known = torch.isfinite(param)
    start = torch.where(torch.isfinite(tensor), tensor, param)
    # The old mean in the place of a number that is not finite moves nothing.
    tensor.copy_(torch.where(known, start.lerp(torch.where(known, param, start), weight), tensor))
    if mean.put:
        param.copy_(torch.where(known, tensor, param))


def take_with_rest(put: bool, param: Tensor, mean: Tensor, rest: Tensor, weight: Tensor) -> None:
    """`take_into_mean` where the mean is the sum of two tensors, exact to one rounding."""
    known = torch.isfinite(param)
    lost = ~torch.isfinite(mean)
    start, more = torch.where(lost, param, mean), torch.where(lost, 0.0, rest)
    more = more + ((param - start) - more) * weight
    moved = start + more
    mean.copy_(torch.where(known, moved, mean))
    rest.copy_(torch.where(known, more - (moved - start), rest))
    if put:
        param.copy_(torch.where(known, mean, param))


def take_into_residue(
    put: bool, param: Tensor, residue: Tensor, weight: Tensor, grid: float, chance: Tensor
) -> None:
    """`take_into_mean` in 16 bits: the lower bits of the mean's place on a grid.

    The mean is read as the one of the places with these bits that is nearest to the iterate. Each
    place is rounded by chance; after a thousand iterates they are off by seven. A mean further away
    than `MAX_AWAY` places follows its iterate. Numbers beyond `MAX_PLACE` places have no mean. A
    trainer that moves a number by more than 32,768 places at once, in the last thirtieth, has to
    tell by `reset_rows`.

    Args:
        put: whether the mean takes the parameter's place.
        param: the iterate [n, ...] float32.
        residue: [n, ...] int16.
        weight: of the iterate in the mean.
        grid: the distance of two places.
        chance: of the rounding, as of `moments.chances`.
    """
    known, lower, rest, away = places_of(param, residue, grid)
    away = (away * (1.0 - weight)).clamp_(-MAX_AWAY, MAX_AWAY)
    chance = ((chance >> 16) & 0xFFFF).to(torch.float32) * 2.0**-16
    moved = lower + (rest + away + chance).floor_().to(torch.int32)
    residue.copy_(torch.where(known, moved.to(CODES), residue))
    if put:
        param.copy_(torch.where(known, param + away * grid, param))


def places_of(param: Tensor, residue: Tensor, grid: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Where iterates, and their means of int16, lie on a grid.

    Returns:
        Whether the number has a mean, bool; its place, whole as int32, and the rest of it; how many
        places its mean is from it. All [n, ...].
    """
    place = param / grid
    known = place.abs() < MAX_PLACE
    place = torch.where(known, place, 0.0)
    lower = place.to(torch.int32)
    rest = place - lower
    return known, lower, rest, (residue.to(torch.int32) - lower).to(CODES).to(torch.float32) - rest


def mean_of_residue(param: Tensor, residue: Tensor, grid: float) -> Tensor:
    """The mean that int16 keep beside its iterate; the iterate where there is none."""
    known, _, _, away = places_of(param, residue, grid)
    return torch.where(known, param + away * grid, param)


def put_mean(param: Tensor, state: Mapping[str, Tensor], name: str | None) -> bool:
    """Put a parameter's mean in its place, if it has one; whether it has."""
    mean, residue, grid = state.get(MEAN), state.get(RESIDUE), GRIDS.get(name or "")
    if residue is not None and grid is not None and residue.shape == param.shape:
        mean = mean_of_residue(param, residue.to(CODES), grid)
    if mean is None or mean.shape != param.shape:
        return False
    known = torch.isfinite(param) & like_rows(state[BEGAN] > 0, param)
    param.copy_(torch.where(known, mean, param))
    return True
