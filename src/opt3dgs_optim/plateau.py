"""Whether more iterations still help, by the losses that a training has seen."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

WINDOW = 2_000  # iterations whose losses are compared with those of as many before
BLOCK = 100  # iterations whose mean loss is one number
LITTLE = 0.05  # decibels that are not worth as many iterations again


def gain(before: Sequence[float], now: Sequence[float]) -> tuple[float, float]:
    """By how many decibels losses are below earlier ones, and the standard error of that.

    A photometric loss is in the unit of the error's amplitude, so that it is 20 log10 of a ratio.

    Args:
        before, now: mean losses of blocks of iterations, two or more of each.

    Returns:
        NaN and NaN where a loss is not above 0, or not finite.
    """
    found = []
    for losses in (before, now):
        mean = math.fsum(losses) / len(losses)
        variance = math.fsum((x - mean) ** 2 for x in losses) / (len(losses) - 1)
        found.append((mean, math.sqrt(variance / len(losses))))
    (old, old_error), (new, new_error) = found
    if not (old > 0 and new > 0 and math.isfinite(old) and math.isfinite(new)):
        return math.nan, math.nan
    relative = math.hypot(old_error / old, new_error / new)
    return 20 * math.log10(old / new), 20 / math.log(10) * relative


class Plateau:
    """Compares the losses of the last iterations with those of as many before."""

    def __init__(self) -> None:
        self._block: list[Tensor] = []
        self._means: list[Tensor] = []  # of blocks, on the loss's device until a window is full
        self._before: list[float] = []
        self._said = False

    def line(self, loss: Tensor, iterations: int) -> str | None:
        """Take the loss of an iteration, 0-d; say once, of a window, that it gained little."""
        gained = self._gained(loss)
        if gained is None or self._said:
            return None
        self._said = True
        return (
            f"opt3dgs_optim: the {WINDOW:,} iterations up to {iterations:,} gained {gained:.2f} dB "
            f"in the loss; phases.finish_in({iterations // 5}) ends the training"
        )

    def _gained(self, loss: Tensor) -> float | None:
        """Decibels that a full window has gained, if they are surely less than `LITTLE`."""
        self._block.append(loss)
        if len(self._block) < BLOCK:
            return None
        self._means.append(torch.stack(self._block).mean())
        self._block = []
        if len(self._means) < WINDOW // BLOCK:
            return None
        before, self._before = self._before, torch.stack(self._means).tolist()
        self._means = []
        if not before:
            return None
        found, error = gain(before, self._before)
        return found if found + error < LITTLE else None
