"""Ctrl-C and termination signals: how a long command is stopped without losing what it has."""

from __future__ import annotations

import signal
from signal import SIGINT, SIGTERM


def stop_at_once() -> None:
    """Let both signals raise KeyboardInterrupt; a shell's background job ignores Ctrl-C's."""
    for kind in (SIGINT, SIGTERM):
        signal.signal(kind, signal.default_int_handler)


class StopRequest:
    """Ctrl-C or a termination signal asks for a stop after the iteration; a second one insists."""

    requested = False

    def __enter__(self) -> StopRequest:
        self._old = {kind: signal.signal(kind, self._ask) for kind in (SIGINT, SIGTERM)}
        return self

    def _ask(self, _kind: int, _frame: object) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True

    def __exit__(self, *_: object) -> None:
        for kind, old in self._old.items():
            signal.signal(kind, old)
