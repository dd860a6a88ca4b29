"""Means over an epoch of views, from which `pairs="epoch"` takes its curvature pairs."""

from __future__ import annotations

import torch
from torch import Tensor


def accumulate(epoch: Tensor, position: Tensor, gradient: Tensor, visible: Tensor) -> None:
    """Add a step to the running means over an epoch, in place.

    Args:
        epoch: [N, 2 (D + 1)]: mean position (D), steps, mean gradient (D), visible steps.
        position: [N, D].
        gradient: [N, D].
        visible: [N] bool.
    """
    dim = position.shape[1]
    epoch[:, dim] += 1
    epoch[:, 2 * dim + 1] += visible
    # Running means, not sums: rounding stays that of one position, however long the epoch.
    weight = (visible / epoch[:, 2 * dim + 1].clamp(min=1)).unsqueeze(1)
    change = torch.where(visible.unsqueeze(1), position - epoch[:, :dim], 0.0)
    epoch[:, :dim] += weight * change
    change = torch.where(visible.unsqueeze(1), gradient - epoch[:, dim + 1 : -1], 0.0)
    epoch[:, dim + 1 : -1] += weight * change


def epoch_mean(epoch: Tensor, epoch_steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mean position [N, D], mean gradient [N, D], and [N] bool: a whole epoch, seen at least once.

    A row that was zeroed in the middle of the epoch has seen part of the views only: its means are
    those of other views than the next epoch's, and do not make a pair.
    """
    dim = epoch.shape[1] // 2 - 1
    whole = (epoch[:, dim] == epoch_steps) & (epoch[:, 2 * dim + 1] > 0)
    return epoch[:, :dim].clone(), epoch[:, dim + 1 : -1].clone(), whole
