"""Adam on the visible rows only, with a step count, and so a bias correction, of every row.

gsplat's `SelectiveAdam` and INRIA's `SparseGaussianAdam` leave rows alone that no camera saw, and
have no bias correction. Here a row counts its own steps: it goes where it would go alone.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor


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
