"""Where a training is: its iteration, its phase, and which share of it is over."""

from __future__ import annotations

import enum
import math
from typing import Any

from opt3dgs_optim.checks import check_count

CALL = "PhaseScheduler"  # the clock that trainers have
SHORTEST_FALL = 10  # iterations


class Phase(enum.Enum):
    """What a training is doing."""

    EXPLORATION = "exploration"
    EXPLOITATION = "exploitation"


class Clock:
    """Optimizers count their own steps: an iteration begins with the first that steps again.

    Args:
        total_steps: iterations of the training; None: no end is planned.
        switch_step: the iteration in which exploitation starts; None: never.

    Attributes:
        iteration: the present one, from 0; -1 before the first step.
        exploiting: whether it is past the switch. exploits_next: whether the next one is.
        progress: the share of a planned training that is over, 0..1.
        open_end: whether no end was planned at first.
        end_step: `total_steps`; parts of the package read it without a call.
        fall_step: the iteration with which the fall to the end begins; None: none is planned.
        fallen: the share of the fall that is over, 0..1.
        switch_at: where exploitation starts: `switch_step`, or without it the present fall.
        counts_positions: whether one of the optimizers holds positions: it alone counts.
        finished: whether the training has been ended early.
    """

    def __init__(self, total_steps: int | None = None, switch_step: int | None = None) -> None:
        self.end_step, self.switch_step = total_steps, switch_step
        self.switch_at = math.inf if switch_step is None else switch_step
        self._switch_back = math.inf
        self.iteration, self.exploiting, self.exploits_next = -1, False, self.switch_at <= 0
        self.progress, self.counts_positions = 0.0, False
        self.open_end, self.fallen, self._ended = total_steps is None, 0.0, False
        self.fall_step: int | None = None
        self.finished = False
        self._positions_at = -1  # the iteration of the positions' last step
        self._positions_open = False  # whether they were stepped first there
        self._begun = -1  # the iteration of the last step: `observe` puts the clock beyond it
        self._resumed = False  # whether the present iteration is over, for all optimizers

    @property
    def phase(self) -> Phase:
        """Of the present iteration."""
        return Phase.EXPLOITATION if self.exploiting else Phase.EXPLORATION

    @property
    def ended(self) -> bool:
        """Whether the last iteration that was planned has been made."""
        return self._ended and self._begun >= self.iteration

    @property
    def total_steps(self) -> int | None:
        """Iterations of the training; None: no end is planned.

        Where none was planned at first, it may be set after a step. The last sixth of so many
        iterations, or what is left of it, is then the fall of `finish_in`.

        Raises:
            ValueError: no count; it is over; the end was planned at first, or has begun; or no step
                has been made.
        """
        return self.end_step

    @total_steps.setter
    def total_steps(self, iterations: int) -> None:
        if iterations == self.end_step:
            return
        call, done = f"{CALL}: total_steps = {iterations!r}", self.iteration + 1
        self._check_open(call)
        end = check_count(CALL, "total_steps", iterations, done + SHORTEST_FALL)
        if not done:  # a checkpoint that is loaded would bring its own end
            raise ValueError(f"{call}: no step has been made yet; give it, PhaseScheduler({end})")
        self._fall_between(max(done, end - max(end // 6, SHORTEST_FALL)), end)

    def finish_in(self, iterations: int) -> None:
        """End a training of no planned length after so many iterations more.

        Over them the steps of the positions become small, nothing is faded, and the last fifth is
        averaged. Have the trainer relocate and densify no more. After the end the training may go
        on, with steps as long as before, and be ended again.

        Args:
            iterations: at least 10; a fifth of those so far is enough.

        Raises:
            ValueError: no count; the end was planned at first; or it has begun.

        Examples:
            >>> import torch
            >>> from opt3dgs_optim import Averaging, PhaseScheduler
            >>> means = torch.nn.Parameter(torch.ones(4, 3))
            >>> optimizers = {"means": torch.optim.Adam([means], lr=0.01, eps=1e-15)}
            >>> phases = PhaseScheduler(parts=[Averaging()])
            >>> optimizers = phases.upgrade(optimizers)
            >>> def train(iterations):
            ...     for _ in range(iterations):
            ...         (means**2).sum().backward()
            ...         optimizers["means"].step()
            ...         optimizers["means"].zero_grad()
            >>> train(50)
            >>> phases.finish_in(10)
            >>> train(10)
            >>> phases.iteration, phases.ended
            (59, True)
        """
        call, done = f"{CALL}.finish_in", self.iteration + 1
        iterations = check_count(call, "iterations", iterations, SHORTEST_FALL)
        self._check_open(call)
        self._fall_between(done, done + iterations)

    def _check_open(self, call: str) -> None:
        """Raise unless an end may be planned now."""
        if not self.open_end:
            raise ValueError(
                f"{call}: total_steps={self.end_step} plans the end; for another length make a new "
                "PhaseScheduler and upgrade the same optimizers, which goes on; for none, "
                "PhaseScheduler()"
            )
        if self._falls() and not (self._ended or self.finished):
            raise ValueError(
                f"{call}: the end has begun, from iteration {self.fall_step} to {self.end_step}; "
                "plan it once; the training may go on after it"
            )

    def _falls(self) -> bool:
        return self.fall_step is not None and self.fall_step <= self.iteration

    def _fall_between(self, start: int, end: int) -> None:
        self.finished = False
        if self._falls():
            self.go_on()
        self.plan_fall(start, end)

    def begin(self, optimizer: Any) -> int:
        """The iteration of a step that an optimizer is about to make.

        Other optimizers may step before the positions, not at all, or several times. Such a step
        begins an iteration only if the positions have stepped in the present one, and did not step
        first there.

        Args:
            optimizer: has `next_iteration`, the one that it steps next, which is put forward, and
                `has_positions`, whether it holds positions.
        """
        present = self.iteration + self._resumed
        iteration = max(optimizer.next_iteration, present, 0)
        if optimizer.has_positions:
            if iteration > self._positions_at:  # of two sets' optimizers the first
                self._positions_open = iteration > self._begun
            self._positions_at = iteration
        elif self.counts_positions and iteration > present:  # it has stepped in the present one
            begins = self._positions_at >= present and not self._positions_open
            if not begins and self.positions_gone():
                self.counts_positions, begins = False, True
            iteration = max(present + begins, 0)
        self._resumed, self._begun = False, iteration
        optimizer.next_iteration = iteration + 1
        if iteration > self.iteration:  # as `put_on`, without a call more in every iteration
            if self.fall_step is not None and iteration >= (self.end_step or 0):
                self.go_on()
            self.go_to(iteration)
            self.advanced()
        return iteration

    def positions_gone(self) -> bool:
        """Whether no optimizer of positions is there any more."""
        return False

    def put_on(self, iteration: int) -> None:
        """Put the clock forward, to where the trainer's own count is."""
        if iteration > self.iteration:
            if self.fall_step is not None and iteration >= (self.end_step or 0):
                self.go_on()
            self._resumed = False
            self.go_to(iteration)
            self.advanced()

    def resume(self, iteration: int) -> None:
        """Go on at an iteration, which is the next one that is made."""
        self.finished = False
        self.go_to(iteration - 1)
        self._positions_at = self._begun = iteration - 1
        self._positions_open, self._resumed = False, True

    def go_to(self, iteration: int) -> None:
        """Be at that iteration."""
        start, end = self.fall_step, self.end_step
        if end is not None:
            self._ended = iteration + 1 >= end
            if start is None:
                self.progress = min(max(iteration / end, 0.0), 1.0)
            else:
                self.fallen = min(max((iteration - start) / (end - start), 0.0), 1.0)
        first, last = self.switch_at, self._switch_back
        self.iteration, self.exploiting = iteration, first <= iteration < last
        self.exploits_next = first <= iteration + 1 < last

    def plan_fall(self, start: int | None, end: int | None) -> None:
        """Have a training of no planned end fall from one iteration to another, or not at all."""
        self.fall_step, self.end_step, self.fallen, self._ended = start, end, 0.0, False
        if self.switch_step is None:
            self.switch_at = math.inf if start is None else start
            self._switch_back = math.inf if end is None else end
        self.exploits_next = self.switch_at <= self.iteration + 1 < self._switch_back

    def go_on(self) -> None:
        """Have no end any more, after one."""
        self.plan_fall(None, None)
        self._ended = True

    def advanced(self) -> None:
        """Called once in each iteration, before its first step."""
