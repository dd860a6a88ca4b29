"""Whether more iterations still help, by the losses that a training has seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

WINDOW = 2_000  # iterations, at least, whose losses are compared with those of as many before
SHARE = 1 / 5  # of the iterations so far; fewer know too little where views differ much
BLOCK = 100  # iterations whose mean loss is one number
LITTLE = 0.05  # decibels that are not worth as many iterations as WINDOW


def gain(before: Sequence[float], now: Sequence[float]) -> tuple[float, float]:
    """By how many decibels losses are below earlier ones, and the standard error of that.

    A photometric loss is in the unit of the error's amplitude, so that it is 20 log10 of a ratio.

    Args:
        before, now: mean losses of blocks of iterations, two or more of each.

    Returns:
        NaN and NaN where a loss is not above 0, or not finite.
    """
    if not all(map(math.isfinite, [*before, *now])):
        return math.nan, math.nan
    found = []
    for losses in (before, now):
        mean = math.fsum(losses) / len(losses)
        variance = math.fsum((x - mean) ** 2 for x in losses) / (len(losses) - 1)
        found.append((mean, math.sqrt(variance / len(losses))))
    (old, old_error), (new, new_error) = found
    if not (old > 0 and new > 0):
        return math.nan, math.nan
    relative = math.hypot(old_error / old, new_error / new)
    return 20 * math.log10(old / new), 20 / math.log(10) * relative


class Plateau:
    """Compares the losses of the last iterations with those of as many before."""

    def __init__(self) -> None:
        self._last = -1  # the iteration of the last loss
        self._sum: Any = 0.0
        self._count = 0  # losses in the sum
        self._means: list[Any] = []  # of blocks, on the loss's device until a window is full
        self._blocks: list[float] = []  # all that were read
        self._said = False

    def line(self, loss: Tensor, iteration: int) -> str | None:
        """Take the loss of an iteration, 0-d; say once, of a window, that it gained little.

        Of several losses of one iteration the first counts. Where iterations have none it begins
        anew.
        """
        if self._said or iteration == self._last:
            return None
        if iteration != self._last + 1:
            self._sum, self._count, self._means, self._blocks = 0.0, 0, [], []
        self._last = iteration
        self._sum, self._count = self._sum + loss, self._count + 1
        if self._count < BLOCK:
            return None
        self._means.append(self._sum / BLOCK)
        self._sum, self._count = 0.0, 0
        if len(self._means) < WINDOW // BLOCK:
            return None
        self._blocks += torch.stack(self._means).tolist()
        self._means = []
        size = max(int(SHARE * len(self._blocks)), WINDOW // BLOCK)
        if len(self._blocks) < 2 * size:
            return None
        gained, error = gain(self._blocks[-2 * size : -size], self._blocks[-size:])
        # Where it rises, the loss has become another.
        self._said = abs(gained) + error < LITTLE * size * BLOCK / WINDOW
        if not self._said:
            return None
        return (
            f"opt3dgs_optim: the {size * BLOCK:,} iterations up to {iteration + 1:,} gained "
            f"{gained:.2f} dB in the loss; phases.finish_in({(iteration + 1) // 5}) ends the "
            "training"
        )
