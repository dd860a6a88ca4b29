"""Where a training is: its iteration, its phase, and which share of it is over."""

from __future__ import annotations

import enum
import math
from typing import Any


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
        open_end: whether no end was planned. Then `total_steps` is None, but in a fall.
        fall_step: the iteration with which the fall to the end begins; None: there is none.
        fallen: the share of the fall that is over, 0..1.
        switch_at: where exploitation starts: `switch_step`, or without it the present fall.
        counts_means: whether one of the optimizers holds positions: it alone counts.
    """

    def __init__(self, total_steps: int | None = None, switch_step: int | None = None) -> None:
        self.total_steps, self.switch_step = total_steps, switch_step
        self.switch_at = math.inf if switch_step is None else switch_step
        self._switch_back = math.inf
        self.iteration, self.exploiting, self.exploits_next = -1, False, self.switch_at <= 0
        self.progress, self.counts_means = 0.0, False
        self.open_end, self.fallen, self._ended = total_steps is None, 0.0, False
        self.fall_step: int | None = None
        self._means_at = -1  # the iteration of the positions' last step
        self._means_open = False  # whether they were stepped first there
        self._begun = -1  # the iteration of the last step: `observe` puts the clock beyond it
        self._resumed = False  # whether the present iteration is over, for all optimizers

    @property
    def phase(self) -> Phase:
        """Of the present iteration."""
        return Phase.EXPLOITATION if self.exploiting else Phase.EXPLORATION

    @property
    def ended(self) -> bool:
        """Whether the last iteration that was planned has been made."""
        return self._ended

    def begin(self, optimizer: Any) -> int:
        """The iteration of a step that an optimizer is about to make.

        Other optimizers may step before the positions, not at all, or several times. Such a step
        begins an iteration only if the positions have stepped in the present one, and did not step
        first there.

        Args:
            optimizer: has `next_iteration`, the one that it steps next, which is put forward, and
                `has_means`, whether it holds positions.
        """
        present = self.iteration + self._resumed
        iteration = max(optimizer.next_iteration, present, 0)
        if optimizer.has_means:
            if iteration > self._means_at:  # of two sets' optimizers the first
                self._means_open = iteration > self._begun
            self._means_at = iteration
        elif self.counts_means and iteration > present:  # it has stepped in the present one
            begins = self._means_at >= present and not self._means_open
            iteration = max(present + begins, 0)
        self._resumed, self._begun = False, iteration
        optimizer.next_iteration = iteration + 1
        if iteration > self.iteration:
            if self.fall_step is not None and iteration >= (self.total_steps or 0):
                self.go_on()
            self.go_to(iteration)
            self.advanced()
        return iteration

    def put_on(self, iteration: int) -> None:
        """Put the clock forward, to where the trainer's own count is."""
        if iteration > self.iteration:
            if self.fall_step is not None and iteration >= (self.total_steps or 0):
                self.go_on()
            self._resumed = False
            self.go_to(iteration)
            self.advanced()

    def resume(self, iteration: int) -> None:
        """Go on at an iteration, which is the next one that is made."""
        self.go_to(iteration - 1)
        self._means_at = self._begun = iteration - 1
        self._means_open, self._resumed = False, True

    def go_to(self, iteration: int) -> None:
        """Be at that iteration."""
        start, end = self.fall_step, self.total_steps
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
        self.fall_step, self.total_steps, self.fallen, self._ended = start, end, 0.0, False
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
