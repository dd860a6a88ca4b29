"""Curvature: a per-point L-BFGS direction as the gradient that Adam is fed (eq. 17)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.backend import BACKENDS, Backend, obstacle
from opt3dgs_optim.checks import check_choice, check_count, check_keys, check_number
from opt3dgs_optim.course import Course
from opt3dgs_optim.lbfgs.history import MAX_HISTORY, history_shape, laid_out, new_history
from opt3dgs_optim.lbfgs.two_loop import foresight, lqn_direction
from opt3dgs_optim.names import check_names
from opt3dgs_optim.part import Group, Kept, Part, Phase, State, Window
from opt3dgs_optim.state import rows_of

HISTORY = "history"
PROBE_STEPS = 10  # exploitation steps between two looks at what the pairs foretell
MIN_PROBES = 5
MIN_ACCEPTED = 0.1  # share of the candidate pairs
# Pairs that are mostly the difference between views reach 0.03 to 0.07, exact ones of a quadratic
# with condition 100 reach 0.2.
MIN_FORESIGHT = 0.1
FORESIGHT = 2  # which number of the evidence is the sum of the foresight
MAX_SEEN = torch.finfo(torch.float32).max  # of each number of the evidence


def points_of(param: Tensor) -> Tensor:
    """A parameter [N, ..] as points [N, D]; a number alone is one point."""
    # Not -1: of no rows, torch could not tell how many coordinates they would have.
    return param.detach().reshape(rows_of(param), math.prod(param.shape[1:]))


@dataclass(frozen=True)
class KeptHistory(Kept):
    """The curvature pairs of every point, laid out as `lbfgs.history` says."""

    history_size: int = 0

    def shape_for(self, param: Tensor) -> tuple[int, ...]:
        return history_shape(points_of(param), self.history_size)

    def make(self, param: Tensor) -> Tensor:
        return new_history(points_of(param), self.history_size, contiguous=param.is_cuda)


class Curvature(Part):
    """Feed Adam the local quasi-Newton direction of every point while exploiting (eq. 17).

    Each point keeps its last `history_size` curvature pairs, taken between two consecutive steps in
    which its gradient was not exactly zero, and the L-BFGS two-loop recursion turns its gradient
    into a pseudo-gradient. There is no line search: Adam takes the step. A point without a usable
    pair is stepped by plain Adam, bit for bit.

    Memory: 32 K bytes per point beyond Adam's (K > 3, D = 3, float32), from the switch on.

    Args:
        history_size: K, number of pairs, 1 to 16 (the paper: 5).
        min_cosine: a pair is accepted if s.y > min_cosine |s| |y|.
        graft: give the pseudo-gradient of each point the length of its gradient.
        names: the Gaussian parameters, under gsplat's or INRIA's names.
        backend: `"auto"` runs points in three dimensions as a CUDA kernel where it can, and all
            else as pure torch; `"cuda"` and `"torch"` insist. See `backend_info`.

    Raises:
        ValueError: an option is outside what is allowed; in a step, a parameter is complex.
        RuntimeError: in a step, `backend="cuda"`, and the kernel cannot run.
    """

    during = Phase.EXPLOITATION
    needs_units = True  # a pair is a difference of positions and one of gradients

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
        self.names = None if names is None else check_names(call, names)
        self.backend: Backend = check_choice(call, "backend", backend, BACKENDS)
        self.keeps = (KeptHistory(HISTORY, history_size=self.history_size),)
        self._step = -1  # of the tally
        self._tally = torch.zeros(2, device="cpu")  # [accepted, candidates] of the last step
        # Those and [foresight, points looked at], of all steps.
        self._seen = torch.zeros(4, dtype=torch.float32, device="cpu")
        self._probes = 0
        # For which iterations, and in which pass over them, these were counted.
        self._counted_in: Window | None = None
        self._pass: int | None = None

    def __repr__(self) -> str:
        share = self.accepted_share
        accepted = "" if share is None else f", accepted share {float(share):.3g}"
        names = "all" if self.names is None else " ".join(self.names)
        return f"Curvature({self.history_size} pairs per point of {names}{accepted})"

    @property
    def accepted_share(self) -> Tensor | None:
        """Share of the last step's candidate pairs that were accepted, 0-d; None before any."""
        return None if self._step < 0 else self._tally[0] / self._tally[1].clamp(min=1)

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: State, course: Course
    ) -> Tensor:
        """Store the pairs that this step completes; return the pseudo-gradient."""
        if param.is_complex():
            raise ValueError("Curvature: complex parameters have no real curvature pairs")
        if param.numel() == 0:
            return grad
        position = points_of(param)
        gradient = grad.reshape(position.shape)
        history = self._history(state, position)
        if course.adaptive:
            self._begin_to_count(course)
            self._seen = self._seen.to(grad.device)
            if course.num_observed % PROBE_STEPS == 0:
                self._seen[2:] += foresight(history, self.history_size, position, gradient)
                self._probes += 1
        given = position, gradient, history, self.history_size
        options = {"min_cosine": self.min_cosine, "graft": self.graft, "backend": self.backend}
        fed, accepted, candidates = lqn_direction(*given, **options)
        tally = torch.stack([accepted.count_nonzero(), candidates.count_nonzero()])
        first = course.steps != self._step
        self._tally = tally if first else self._tally.to(tally.device) + tally
        self._step = course.steps
        if course.adaptive:
            self._seen[:2] += tally
        return fed.reshape(grad.shape)

    def _begin_to_count(self, course: Course) -> None:
        """Forget what was seen in another exploitation: of a shorter run, or of an earlier pass."""
        window, known = course.window_of_part(self), self._counted_in
        if known not in (None, window) or self._pass not in (None, course.rewinds):
            self._seen, self._probes = torch.zeros_like(self._seen), 0
        self._counted_in, self._pass = window, course.rewinds

    def _history(self, state: Any, position: Tensor) -> Tensor:
        """The points' history, laid out for what will compute on it."""
        like = position.device, position.dtype, position.shape[1], self.history_size
        asked = position.is_cuda or self.backend == "cuda"
        kernel = asked and obstacle(self.backend, *like) is None
        history = state[HISTORY]
        laid = laid_out(history, contiguous=kernel)
        if laid is not history:
            state.exchange(HISTORY, laid)
        return laid

    def numbers(self, course: Course) -> Mapping[str, float | Tensor]:
        """`accepted`: the share of the candidate pairs that the last step accepted."""
        share = self.accepted_share
        return {} if share is None else {"accepted": share}

    def state_dict(self) -> dict[str, Any]:
        """What `adaptive` judges by; the pairs are in the optimizers' state."""
        counted = {"seen": self._seen.tolist(), "probes": self._probes}
        window = None if self._counted_in is None else list(self._counted_in)
        return {"history_size": self.history_size, "window": window, **counted}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`.

        Raises:
            ValueError: it is damaged; nothing is changed then.
        """
        call = "Curvature.load_state_dict"
        check_keys(call, state, ("seen", "probes"))
        seen = state["seen"]
        if not isinstance(seen, (list, tuple)) or len(seen) != len(self._seen):
            raise ValueError(f"{call}: seen={seen!r}, but {len(self._seen)} numbers are needed")
        for i, number in enumerate(seen):  # the foresight alone may be below 0
            low = -MAX_SEEN if i == FORESIGHT else 0.0
            check_number(call, f"seen[{i}]", number, low, MAX_SEEN)
        probes = check_count(call, "probes", state["probes"], 0)
        # Of D coordinates, D pairs take as much room as D + 1. Earlier versions did not say.
        size = check_count(call, "history_size", state.get("history_size", self.history_size), 1)
        if size != self.history_size:
            raise ValueError(
                f"{call}: history_size={size}, but pairs of history_size={self.history_size} are "
                "needed"
            )
        window = state.get("window")  # earlier versions did not say
        if window is not None and not (
            isinstance(window, (list, tuple)) and [*map(type, window)] == [int, int]
        ):
            raise ValueError(f"{call}: window={window!r}, but None or two iterations are needed")
        self._seen = torch.tensor(seen, dtype=torch.float32, device="cpu")
        self._probes, self._pass = probes, None
        self._counted_in = None if window is None else (window[0], window[1])

    def evidence(self, course: Course) -> Tensor:
        """[4]: pairs accepted, candidates, sum of their foresight, points looked at."""
        self._begin_to_count(course)
        return self._seen

    def useless(self, evidence: list[float], course: Course) -> str | None:
        """Where few pairs are accepted, or those that are know no more than the gradient does."""
        accepted, candidates, foretold, points = evidence
        if candidates == 0 or self._probes < MIN_PROBES:
            return None
        share, mean = accepted / candidates, foretold / max(points, 1.0)
        if share < MIN_ACCEPTED:
            return f"{share:.3f} of the candidate pairs were accepted (threshold {MIN_ACCEPTED})"
        if mean < MIN_FORESIGHT:
            return (
                f"the pairs foretell the next ones by a cosine of only {mean:.3f} more than the "
                f"gradient does (threshold {MIN_FORESIGHT}; accepted share {share:.2f})"
            )
        return None
