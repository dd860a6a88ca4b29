"""The lines of a run log: strict JSON, appended whole, by one writer at a time."""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

START = b'{"kind":"start"'  # how the first line of every session begins
NON_FINITE = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}  # Python's names: ours


class LineFile:
    """An append-only file of lines, locked against a second writer where files can be locked.

    Raises:
        BlockingIOError: the file is open in another LineFile, here or in another process.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 - closed by close()
        try:
            if fcntl is not None:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise BlockingIOError(
                f"RunLog({str(self.path)!r}): another RunLog is writing this file; close that one "
                "or give each run its own path"
            ) from None
        except OSError:  # a file system without locks: nothing to check with
            pass

    @property
    def closed(self) -> bool:
        return self._file.closed

    def append(self, line: Mapping[str, Any]) -> None:
        """Write one line in one system call (more only if the kernel cuts it short)."""
        data = encoded(line).encode() + b"\n"
        if data.startswith(START) and self.path.read_bytes()[-1:] not in (b"", b"\n"):
            data = b"\n" + data  # the last session was killed within a line
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) or 0 :]

    def close(self) -> None:
        """Release the file; a data loader that was forked meanwhile shares the lock."""
        if fcntl and not self._file.closed:
            with contextlib.suppress(OSError):
                fcntl.flock(self._file, fcntl.LOCK_UN)
        self._file.close()


def encoded(value: Any) -> str:
    """`value` as strict JSON, NaN and infinities as strings; TypeError if JSON cannot hold it."""
    try:
        return json.dumps(value, separators=(",", ":"), allow_nan=False, default=_plain)
    except ValueError:  # a number that is not finite
        loose = json.dumps(value, default=_plain)
        return encoded(json.loads(loose, parse_constant=NON_FINITE.__getitem__))


def _plain(value: Any) -> Any:
    return os.fspath(value) if isinstance(value, os.PathLike) else number("RunLog", "", value)


def number(call: str, name: str, value: Any) -> float | int:
    """A number, or that in a tensor or array of one element, on the host."""
    if hasattr(value, "item"):
        if math.prod(value.shape) != 1:
            raise ValueError(
                f"{call}({name}=tensor of {tuple(value.shape)}): must have one element"
            )
        value = value.item()
    if not isinstance(value, (int, float)):
        raise TypeError(f"{call}({name}={value!r}): must be a number or a one-element tensor")
    return value
