"""What the package says: warnings at the user's line, lines of a log, each once in a training."""

from __future__ import annotations

import logging
import os
import sys
import warnings

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
    """Tell the user, by the logger, or on stderr where nothing has been set up to show INFO."""
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
    """

    def __init__(self, open_end: bool) -> None:
        self.open_end = open_end
        self.total_steps: int | None = None
        self.mean_at: float | None = None
        self.upgraded = False  # and not resumed: a checkpoint may be loaded to be looked at
        self.done = 0  # iterations, if any was made here
        self.finished = False

    def line(self) -> str | None:
        """The warning; None: nothing is wrong."""
        if self.finished:
            return None
        if self.upgraded and not self.done:
            return (
                "opt3dgs_optim: the optimizers that were upgraded have made no step; upgrade those "
                "that the training steps, after they have been made"
            )
        if self.mean_at is None or not self.done or self.done > self.mean_at:
            return None
        if self.open_end:
            return (
                f"opt3dgs_optim: the training ended at iteration {self.done} of "
                f"{self.total_steps or 'no planned end'}, so that the parameters are the last "
                "iterate and no mean; call phases.finish_in(n) n iterations before it ends"
            )
        return (
            f"opt3dgs_optim: the training ended at iteration {self.done} of {self.total_steps}, so "
            "that the parameters are the last iterate and no mean; make total_steps the number of "
            "steps, upgrade optimizers that are made anew, and call phases.finish() where a "
            "training ends early"
        )

    def say(self) -> None:
        """Log the line, if there is one."""
        if (line := self.line()) is not None:
            LOGGER.warning(line)
