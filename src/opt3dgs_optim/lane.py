"""A parameter of an optimizer between two steps: what acts on it, and what is kept for its rows."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.course import Course
from opt3dgs_optim.moments import CODES
from opt3dgs_optim.part import Part, Phase, overrides
from opt3dgs_optim.step import GRIDS, Step

MOMENTS = ("exp_avg", "exp_avg_sq")  # torch's names
MEAN, BEGAN = "averaging.mean", "averaging.began"  # ours, of the rows
RESIDUE = "averaging.residue"  # in the place of the mean, beside moments of 16 bits
OF_MEAN = (MEAN, RESIDUE, BEGAN)
KEPT = (*OF_MEAN, "curvature.history")  # what a checkpoint may hold for rows beside moments


class Lane:
    """One parameter of an optimizer: what acts on it, and how its last step has left it.

    Attributes:
        name, set: which Gaussian parameter it is, and of which set of Gaussians.
        acting: by `Course.exploiting`: the parts with a `plan`, with a `before`, with an `after`.
        grid: of its mean at 16 bits; None: it has none of these.
        counter: where its device counts numbers that are not finite; None on a CPU.
        stepped_in: the iteration of its last step; -1: none.
        framed: whether its moments are those of the own frame; None: it has none yet.
        keeps: whether parts keep something for its rows.
        noted: what they keep, by name, with the version of the tensor after the last step.
        version: of the Parameter then.
    """

    def __init__(
        self,
        group: dict[str, Any],
        param: Tensor,
        slot: tuple[str, str | None],
        parts: tuple[Part, ...],
        counter: Tensor | None,
    ) -> None:
        self.group, self.param, self.counter = group, param, counter
        self.set, self.name = slot
        mine = [p for p in parts if p.names is None or (self.name and self.name in p.names)]
        self.acting = tuple(
            tuple(
                [p for p in mine if overrides(p, hook) and p.during in (None, phase)]
                for hook in ("plan", "before", "after")
            )
            for phase in (Phase.EXPLORATION, Phase.EXPLOITATION)
        )
        self.grid = GRIDS.get(self.name or "")
        self.stepped_in = -1
        self.framed: bool | None = None
        self.keeps = False
        self.noted: dict[str, tuple[Tensor, int]] = {}
        self.version = param._version

    def keep(
        self, state: dict[str, Any], key: str, shape: tuple[int, ...], dtype: Any = None
    ) -> Tensor:
        """What is kept for the rows under a name; a row of zeros: nothing is kept for it."""
        tensor, self.keeps = state.get(key), True
        if tensor is None or tensor.shape != shape:
            tensor = state[key] = torch.zeros(
                shape, dtype=dtype or self.param.dtype, device=self.param.device
            )
        return tensor

    def mean_of(self, state: dict[str, Any]) -> tuple[Tensor, Tensor]:
        """The running mean, and with which count the mean of each row began.

        Beside moments of 16 bits the mean has as many, see `step.take_into_residue`, except that of
        positions, for which no grid can be named: they are in the units of the scene.
        """
        coded = self.grid is not None and state["exp_avg"].dtype is CODES
        key, param = RESIDUE if coded else MEAN, self.param
        mean, began = state.get(key), state.get(BEGAN)
        if mean is None or began is None or began.numel() != param.size(0):  # rows are others now
            for each in OF_MEAN:
                state.pop(each, None)
            mean = self.keep(state, key, tuple(param.shape), CODES if coded else None)
            began = self.keep(state, BEGAN, tuple(param.shape[:1]))
        self.keeps = True
        return mean, began

    def drop_moved(self, state: dict[str, Any], new: bool, written: bool) -> None:
        """Drop what is kept for rows that are others now, if the Parameter is new.

        Trainers that edit rows edit every tensor of the state so (gsplat's family), or none but
        Adam's moments (INRIA's): what they have left as it was belongs to other rows. gsplat's
        relocation writes rows of the old Parameter, and edits the state of others: `written`.
        """
        rows = len(self.param) if self.param.dim() else 1
        for key in KEPT:
            now, was = state.get(key), self.noted.get(key)
            if now is None:
                continue
            as_it_was = was is not None and now is was[0] and now._version == was[1]
            if len(now) != rows or (new and (as_it_was or written)):
                for each in OF_MEAN if key in OF_MEAN else (key,):  # they belong together
                    state.pop(each, None)

    def finish(self, step: Step, course: Course) -> None:
        """What comes after the arithmetic: parts of one's own, and a note of what is left.

        By the note, edits of rows show at the next step.
        """
        for part in self.acting[course.exploiting][2]:
            part.after(step, course)
        if self.keeps:
            self.version, state = self.param._version, step.state
            for key in KEPT:
                if (kept := state.get(key)) is not None:
                    self.noted[key] = kept, kept._version
