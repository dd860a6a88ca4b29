"""Curvature: a per-point L-BFGS direction as the gradient that Adam is fed (eq. 17)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_choice, check_count, check_number
from opt3dgs_optim.clock import Phase
from opt3dgs_optim.lbfgs.backend import BACKENDS, Backend
from opt3dgs_optim.lbfgs.history import MAX_HISTORY, history_shape
from opt3dgs_optim.lbfgs.two_loop import lqn_direction
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training

HISTORY = "curvature.history"


class Curvature(Part):
    """Feed Adam the local quasi-Newton direction of every point while exploiting (eq. 17).

    Each point keeps its last `history_size` curvature pairs, taken between two consecutive steps in
    which its gradient was not exactly zero, and the L-BFGS two-loop recursion turns its gradient
    into a pseudo-gradient. There is no line search: Adam takes the step. A point without a usable
    pair is stepped by plain Adam, bit for bit.

    Memory: 32 * K bytes per point beyond Adam's (K > 3, D = 3, float32), from the switch on.

    Args:
        history_size: K, number of pairs, 1 to 16 (the paper: 5).
        min_cosine: a pair is accepted if s.y > min_cosine |s| |y|.
        graft: give the pseudo-gradient of each point the length of its gradient.
        names: the Gaussian parameters, under gsplat's names; None: every parameter.
        backend: `"auto"` runs points in three dimensions as a CUDA kernel where it can, and all
            else as pure torch; `"cuda"` and `"torch"` insist. See `backend_info`.

    Raises:
        ValueError: an option is outside what is allowed.
        RuntimeError: in a step, `backend="cuda"`, and the kernel cannot run.
    """

    during = Phase.EXPLOITATION
    learns = True

    def __init__(
        self,
        history_size: int = 5,
        *,
        min_cosine: float = 1e-6,
        graft: bool = True,
        names: tuple[str, ...] | None = ("means",),
        backend: Backend = "auto",
    ) -> None:
        call = type(self).__name__
        self.history_size = check_count(call, "history_size", history_size, 1, MAX_HISTORY)
        self.min_cosine = check_number(call, "min_cosine", min_cosine, 0.0, 1.0, open_high=True)
        self.graft = check_choice(call, "graft", graft)
        self.names = names
        self.backend: Backend = check_choice(call, "backend", backend, BACKENDS)
        self._tally: Tensor | None = None  # [2] accepted pairs and candidates of the last step
        self._counted_in: int | None = None

    def __repr__(self) -> str:
        names = "all" if self.names is None else " ".join(self.names)
        return f"Curvature({self.history_size} pairs per point of {names})"

    @property
    def accepted_share(self) -> Tensor | None:
        """Share of the last step's candidate pairs that were accepted, 0-d; None before any."""
        return None if self._tally is None else self._tally[0] / self._tally[1].clamp(min=1)

    def plan(self, step: Step, training: Training) -> None:
        """Store the pairs that this step completes; feed Adam the pseudo-gradient."""
        param = step.param
        if not param.numel():
            return
        rows = len(param) if param.dim() else 1
        position = param.detach().reshape(rows, math.prod(param.shape[1:]))
        gradient = step.grad.reshape(position.shape)
        if step.group["weight_decay"] and not step.group.get("decoupled_weight_decay"):
            gradient = gradient.add(position, alpha=step.group["weight_decay"])
            step.decayed = True  # behind H it would move the minimum
        history = step.keep(step.state, HISTORY, history_shape(position, self.history_size))
        fed, accepted, candidates = lqn_direction(
            position,
            gradient,
            history,
            self.history_size,
            min_cosine=self.min_cosine,
            graft=self.graft,
            backend=self.backend,
        )
        tally = torch.stack([accepted.count_nonzero(), candidates.count_nonzero()])
        if self._tally is not None and step.iteration == self._counted_in:
            tally += self._tally
        self._tally = tally
        self._counted_in = step.iteration
        step.grad = fed.reshape(step.grad.shape)

    def numbers(self, training: Training) -> Mapping[str, float | Tensor]:
        """`accepted`: the share of the candidate pairs that the last step accepted."""
        share = self.accepted_share
        return {} if share is None else {"accepted": share}

    def state_dict(self) -> dict[str, Any]:
        """How many pairs the history has; the pairs are in the optimizers' state."""
        return {"history_size": self.history_size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """ValueError if the number of pairs differs from this part's."""
        if state.get("history_size") != self.history_size:
            raise ValueError(
                f"Curvature.load_state_dict: history_size={state.get('history_size')!r}, but pairs "
                f"of history_size={self.history_size} are needed"
            )
