"""What the package says: warnings at the user's line, lines of a log, each once in a training."""

from __future__ import annotations

import logging
import multiprocessing
import os
import sys
import warnings
import weakref
from typing import Any

import torch

LOGGER = logging.getLogger("opt3dgs_optim")  # what the package says of itself


def warn_user(message: str) -> None:
    """Warn at the line outside of this package and torch from which the call came."""
    inside = tuple(os.path.dirname(each) + os.sep for each in (__file__, torch.__file__))
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_code.co_filename.startswith(inside):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)


def say(message: str) -> None:
    """Tell the user, by the logger, or on stderr where logging has no handler."""
    LOGGER.info(message)
    if not LOGGER.hasHandlers():
        bars = getattr(sys.modules.get("tqdm"), "tqdm", None)  # a trainer's would share the line
        getattr(bars, "write", print)(message, file=sys.stderr)


class Messages:
    """What has been said in a training: each thing once, though six optimizers have it to say."""

    def __init__(self) -> None:
        self._said: set[str] = set()

    def warn_once(self, kind: str, message: str) -> None:
        """Say something that is wrong; `kind` is what is said once."""
        if kind not in self._said:
            self._said.add(kind)
            warn_user(message)

    def say_once(self, message: str) -> None:
        """Say what has happened."""
        if message not in self._said:
            self._said.add(message)
            say(message)


class End:
    """Whether a training ended early, which is told when its scheduler goes, or at exit.

    Attributes:
        total_steps: of the training; None: its end is not planned yet.
        mean_at: the first iteration after which the mean is in the parameters' place; infinity: it
            is not planned yet; None: there is none, without `Averaging` or in so short a training.
        passed: the end after which a training of no planned end has gone on.
        asked: whether `upgrade` was called.
        upgraded: whether optimizers were, and the training was not resumed since: a checkpoint may
            be loaded to be looked at.
        held: how many of them there are still.
        done: iterations, if any was made here.
    """

    def __init__(self, open_end: bool) -> None:
        self.open_end = open_end
        self.total_steps: int | None = None
        self.mean_at: float | None = None
        self.passed: int | None = None
        self.asked = self.upgraded = self.finished = self._gone = False
        self.held = self.done = 0
        self._error = id(getattr(sys, "last_value", None))  # of before, in an interpreter

    def line(self) -> str | None:
        """The warning; None: nothing is wrong."""
        if self.finished or (not self.asked and multiprocessing.parent_process()):
            return None  # a child makes the schedulers of modules once more
        if not self.asked:
            return (
                "opt3dgs_optim: a PhaseScheduler was made, but its upgrade(optimizers) was not "
                "called, so that it has done nothing"
            )
        if self.upgraded and not self.done and not self._gone:
            return (
                "opt3dgs_optim: the optimizers that were upgraded have made no step; upgrade those "
                "that the training steps, below the lines that make them or load a checkpoint"
            )
        if self.mean_at is None or not self.done or self.done > self.mean_at:
            return None
        where = f" of {self.total_steps or 'no planned end'}"
        cure = (
            "make total_steps the number of steps, upgrade optimizers that are made anew, and call "
            "phases.finish() where a training ends within its last thirtieth"
        )
        if self.passed is not None and self.total_steps is None:
            where = f", after the end that was planned at {self.passed}"
            cure = "have the loop save and stop where phases.ended is true"
        elif self.open_end:
            cure = "call phases.finish_in(n) n iterations before it ends"
        return (
            f"opt3dgs_optim: the training ended at iteration {self.done}{where}, so that the "
            f"parameters are the last iterate and no mean; {cure}"
        )

    def say(self, line: str | None = None) -> None:
        """Log this line, or that of the end; nothing where an error has ended the program."""
        line = line or self.line()
        if line is not None and id(getattr(sys, "last_value", None)) == self._error:
            LOGGER.warning(line)

    def hold(self, optimizer: Any) -> None:
        """Have one more, and say at once if all of them are gone before their first step."""
        self.held, self._gone = self.held + 1, False
        weakref.finalize(optimizer, self._let_go).atexit = False

    def _let_go(self) -> None:
        self.held -= 1
        if not self.held and self.upgraded and not self.done:
            self._gone = True
            self.say(
                "opt3dgs_optim: the optimizers that were upgraded are gone before their first "
                "step; upgrade those that are made in their place"
            )
