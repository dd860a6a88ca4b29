"""How a command ends: one line for what is wrong; Ctrl-C without losing what it has."""

from __future__ import annotations

import functools
import signal
import sys
from collections.abc import Callable, Sequence
from signal import SIGINT, SIGTERM

Main = Callable[[Sequence[str] | None], int]


def command(name: str) -> Callable[[Main], Callable[..., int]]:
    """Let a `main(arguments=None)` return 2 after one line of what is wrong, 130 after Ctrl-C."""

    def decorated(main: Main) -> Callable[..., int]:
        @functools.wraps(main)
        def ended(arguments: Sequence[str] | None = None) -> int:
            try:
                return main(arguments)
            except (OSError, ValueError) as error:
                print(f"{name}: {error}", file=sys.stderr)
                return 2
            except KeyboardInterrupt:
                print(
                    "interrupted: the same command goes on from the checkpoints, if it writes any",
                    file=sys.stderr,
                )
                return 130

        return ended

    return decorated


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
