"""One line on a terminal that says what is going on; nothing where nobody is looking."""

from __future__ import annotations

import shutil
import sys
from typing import TextIO

CLEAR = "\r\x1b[K"


class StatusLine:
    """Overwrites one line of `stream` (stderr) if it is a terminal; silent otherwise."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._on = self._stream.isatty()

    def show(self, text: str) -> None:
        """Replace the line by `text`, cut to the terminal's width."""
        if self._on:
            width = shutil.get_terminal_size().columns - 1
            self._stream.write(CLEAR + text[:width])
            self._stream.flush()

    def clear(self) -> None:
        """Remove the line."""
        if self._on:
            self._stream.write(CLEAR)
            self._stream.flush()
