"""How many steps every row has made, kept in line with the rows that a trainer edits."""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple

import torch
from torch import Tensor

ROW_STEPS = "row_steps"  # [N] float32 per parameter, in the state beside torch's moments
SETTLED = 1e6  # steps after which the bias correction is 1 to float32


class _Seen(NamedTuple):
    """What belonged together at a parameter's last step: an edit of one alone shows."""

    param: weakref.ref[Tensor]
    counts: weakref.ref[Tensor]
    moment: weakref.ref[Tensor]  # exp_avg


class RowSteps:
    """Keeps the step counts of the rows in line with the rows, whatever a trainer edits.

    Some trainers edit every tensor of the state by rows, others (INRIA, 3dgs-mcmc) the two moments
    only: then the counts are of other rows, and are estimated anew.
    """

    def __init__(self) -> None:
        self._seen: list[_Seen] = []

    def of(self, param: Tensor, state: dict[str, Any]) -> Tensor:
        """The counts [N] in `state`, made or repaired where they do not fit the moments."""
        counts, moment = state.get(ROW_STEPS), state["exp_avg"]
        if counts is None:
            counts = _estimate(state)
        elif not any(seen.param() is param for seen in self._seen):
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
        return any(seen.counts() is counts and seen.moment() is not moment for seen in self._seen)

    def _remember(self, param: Tensor, counts: Tensor, moment: Tensor) -> None:
        # One entry a tensor. A parameter that has been replaced may still be alive in the trainer;
        # one that is gone has an entry as long as its counts are in the state, left behind.
        self._seen = [
            seen
            for seen in self._seen
            if seen.param() is not param
            and seen.counts() is not None
            and seen.counts() is not counts
        ]
        self._seen.append(_Seen(weakref.ref(param), weakref.ref(counts), weakref.ref(moment)))

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
