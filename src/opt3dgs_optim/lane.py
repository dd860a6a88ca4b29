"""A parameter of an optimizer between two steps: what acts on it, and what is kept for its rows."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.part import Part, Phase, overrides

MOMENTS = ("exp_avg", "exp_avg_sq")  # torch's names
MEAN, BEGAN = "averaging.mean", "averaging.began"  # ours, of the rows
KEPT = (MEAN, BEGAN, "curvature.history")  # what a checkpoint may hold for rows beside moments


class Lane:
    """One parameter of an optimizer: what acts on it, and what was left for it at the last step.

    Attributes:
        name, set: which Gaussian parameter it is, and of which set of Gaussians.
        last: the iteration of its last step; -1: none.
        framed: whether its moments are those of the own frame; None: it has none yet.
    """

    def __init__(self, group: dict[str, Any], param: Tensor, slot: tuple[str, str | None]) -> None:
        self.group, self.param = group, param
        self.set, self.name = slot
        self.last = -1
        self.framed: bool | None = None
        self.keeps = False  # whether parts keep something for its rows
        self.left: dict[str, tuple[Tensor, int]] = {}
        self.version = param._version  # of the Parameter, after the step
        self.plans: dict[Phase, list[Part]] = {}
        self.before: list[Part] = []
        self.after: list[Part] = []

    def ask(self, parts: tuple[Part, ...]) -> Lane:
        """Take the parts that act on this parameter."""
        mine = [p for p in parts if p.names is None or (self.name and self.name in p.names)]
        for phase in Phase:
            self.plans[phase] = [
                p for p in mine if overrides(p, "plan") and p.during in (None, phase)
            ]
        self.before = [p for p in mine if overrides(p, "before")]
        self.after = [p for p in mine if overrides(p, "after")]
        return self

    def rows(self, state: dict[str, Any], key: str, shape: tuple[int, ...]) -> tuple[Tensor, bool]:
        """What is kept for the rows under a name, and whether rows may be new since the last step.

        A row of zeros is one for which nothing is kept.
        """
        tensor, was, self.keeps = state.get(key), self.left.get(key), True
        if tensor is None or tensor.shape != shape:
            tensor = state[key] = torch.zeros(
                shape, dtype=self.param.dtype, device=self.param.device
            )
            return tensor, True
        if was is None:  # loaded
            return tensor, True
        if tensor is not was[0] or tensor._version != was[1]:
            return tensor, True
        return tensor, False

    def drop_moved(self, state: dict[str, Any], new: bool, written: bool) -> None:
        """Drop what is kept for rows that are others now, if the Parameter is new.

        Trainers that edit rows edit every tensor of the state so (gsplat's family), or none but
        Adam's moments (INRIA's): what they have left as it was belongs to other rows. gsplat's
        relocation writes rows of the old Parameter, and edits the state of others: `written`.
        """
        rows = len(self.param) if self.param.dim() else 1
        for key in KEPT:
            now, was = state.get(key), self.left.get(key)
            if now is None:
                continue
            as_it_was = was is not None and now is was[0] and now._version == was[1]
            if len(now) != rows or (new and (as_it_was or written)):
                del state[key]

    def leave(self, state: dict[str, Any]) -> None:
        """Note what the step has left, by which edits of rows show at the next one."""
        self.version = self.param._version
        self.left = {key: (state[key], state[key]._version) for key in KEPT if key in state}
