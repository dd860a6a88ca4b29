"""Adam on the visible rows only, with a step count, and so a bias correction, of every row.

gsplat's `SelectiveAdam` and INRIA's `SparseGaussianAdam` leave rows alone that no camera saw, and
have no bias correction. Here a row counts its own steps: it goes where it would go alone.
"""

from __future__ import annotations

import math
import weakref
from typing import Any

import torch
from torch import Tensor

ROW_STEPS = "row_steps"  # [N] float32 per parameter, in the state beside torch's moments
SETTLED = 1e6  # steps after which the bias correction is 1 to float32


class RowSteps:
    """Keeps the step counts of the rows in line with the rows, whatever a trainer edits.

    Some trainers edit every tensor of the state by rows, others (INRIA, 3dgs-mcmc) the two moments
    only: then the counts are of other rows, and are estimated anew.
    """

    def __init__(self) -> None:
        # of every parameter: itself, its counts and its first moment at the last step
        self._seen: list[tuple[weakref.ref[Tensor], ...]] = []

    def of(self, param: Tensor, state: dict[str, Any]) -> Tensor:
        """The counts [N] in `state`, made or repaired where they do not fit the moments."""
        counts, moment = state.get(ROW_STEPS), state["exp_avg"]
        if counts is None:
            counts = _estimate(state)
        elif not any(entry[0]() is param for entry in self._seen):
            # The object of the moments is another one but that of the counts is not: the trainer
            # has edited the first and left the second.
            edited_without_ours = self._left_behind(counts, moment)
            if edited_without_ours or counts.shape != moment.shape[:1]:
                counts = _estimate(state)
            else:
                counts = torch.where(_empty_rows(moment), 0.0, counts)
        state[ROW_STEPS] = counts
        self._remember(param, counts, moment)
        return counts

    def _left_behind(self, counts: Tensor, moment: Tensor) -> bool:
        return any(at() is counts and other() is not moment for _, at, other in self._seen)

    def _remember(self, param: Tensor, counts: Tensor, moment: Tensor) -> None:
        # One entry a tensor. A parameter that has been replaced may still be alive in the trainer;
        # one that is gone has an entry as long as its counts are in the state, left behind.
        self._seen = [
            (of, at, moments)
            for of, at, moments in self._seen
            if of() is not param and at() is not None and at() is not counts
        ]
        self._seen.append((weakref.ref(param), weakref.ref(counts), weakref.ref(moment)))

    def trust(self, param: Tensor, state: dict[str, Any]) -> None:
        """Take the counts in `state` as those of the present rows (a loaded checkpoint)."""
        counts, moment = state.get(ROW_STEPS), state.get("exp_avg")
        if counts is not None and moment is not None and counts.shape == moment.shape[:1]:
            self._remember(param, counts, moment)


def _empty_rows(moment: Tensor) -> Tensor:
    return (moment == 0).reshape(moment.shape[0], -1).all(dim=1)


def _estimate(state: dict[str, Any]) -> Tensor:
    """Counts from the steps of the whole parameter: 0 for rows without moments."""
    moment = state["exp_avg_sq"]
    steps = state["step"].to(device=moment.device, dtype=torch.float32)
    # No shared steps but moments: the optimizer had no bias correction (gsplat's SelectiveAdam).
    steps = torch.where(steps > 0, steps, SETTLED)
    return torch.where(_empty_rows(moment), 0.0, steps)


def check_visible(call: str, visible: Tensor, num_points: int | None) -> Tensor:
    """`visible` as a flat bool mask; ValueError where it cannot be one."""
    mask = visible.detach().reshape(-1)
    if not isinstance(visible, Tensor) or visible.dim() == 0 or mask.is_complex():
        raise ValueError(f"{call}.step: visible={visible!r}, but a mask of shape [N] is needed")
    if num_points is not None and num_points != mask.numel():
        raise ValueError(
            f"{call}.step: num_points={num_points}, but the mask has {mask.numel()} rows"
        )
    return mask if mask.dtype == torch.bool else mask != 0


def shaped(rows: Tensor, like: Tensor) -> Tensor:
    """[N] as [N, 1, ..] for broadcasting over `like`."""
    return rows.reshape(-1, *[1] * (like.dim() - 1))


@torch.no_grad()
def masked_adam(
    param: Tensor,
    grad: Tensor,
    state: dict[str, Any],
    counts: Tensor,
    visible: Tensor,
    *,
    lr: float | Tensor,
    beta1: float,
    beta2: float,
    eps: float,
    weight_decay: float = 0.0,
    decoupled: bool = False,
    amsgrad: bool = False,
    maximize: bool = False,
) -> None:
    """torch's Adam on the rows in `visible`; nothing of the others changes, whatever their grad.

    Args:
        param: [N, ..], changed in place, as are `state` and `counts`.
        grad: [N, ..].
        state: `exp_avg`, `exp_avg_sq`, `step` and, with amsgrad, `max_exp_avg_sq`.
        counts: [N] float, steps of every row so far.
        visible: [N] bool.
        lr: the step size, negative too.
        beta1, beta2, eps, weight_decay, decoupled, amsgrad, maximize: as in `torch.optim.AdamW`.
    """
    rows = shaped(visible, param)
    first, second = state["exp_avg"], state["exp_avg_sq"]
    grad = torch.where(rows, -grad if maximize else grad, 0.0)
    if weight_decay and not decoupled:
        grad = torch.where(rows, grad + weight_decay * param, 0.0)
    if weight_decay and decoupled:
        param.copy_(torch.where(rows, param * (1 - lr * weight_decay), param))
    counts.add_(visible)
    state["step"].add_(1)
    first.copy_(torch.where(rows, torch.lerp(first, grad, 1 - beta1), first))
    squared = torch.addcmul(second * beta2, grad, grad, value=1 - beta2)
    second.copy_(torch.where(rows, squared, second))
    if amsgrad:
        largest = state["max_exp_avg_sq"]
        second = largest.copy_(torch.where(rows, torch.maximum(largest, second), largest))
    # 1 - beta^t of every row; expm1, because in float32 1 - 0.999 has four digits left.
    correction1 = shaped(_bias_correction(counts, beta1), param).to(param.dtype)
    correction2 = shaped(_bias_correction(counts, beta2), param).to(param.dtype)
    step = lr * (first / correction1) / ((second / correction2).sqrt() + eps)
    param.copy_(torch.where(rows, param - step, param))


def _bias_correction(counts: Tensor, beta: float) -> Tensor:
    if beta == 0:
        return torch.ones_like(counts)
    # Rows that were never visible would divide by zero; they do not move anyway.
    return -torch.expm1(counts.clamp(min=1) * math.log(beta))
