"""The lines of a run log: strict JSON values, whole-line appends, one writer at a time."""

from __future__ import annotations

import contextlib
import json
import math
import operator
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

START = b'{"kind":"start"'  # how the first line of every session begins
DEEPEST = 32  # lists in lists; far below Python's limit for calls in calls
NO_TEXT = re.compile("[\0\ud800-\udfff]")  # what no file name, page or terminal takes


class LineFile:
    """An append-only file of lines, locked against a second writer where files can be locked.

    Raises:
        BlockingIOError: the file is open in another LineFile, here or in another process.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._owner = os.getpid()
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
        """Write one JSON line in one system call (more only if the kernel cuts it short)."""
        data = json.dumps(line, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        if data.startswith(START) and self.path.read_bytes()[-1:] not in (b"", b"\n"):
            data = b"\n" + data  # the last session was killed within a line
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) or 0 :]

    def sync(self) -> None:
        """Force what was written to the disk."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        if fcntl and not self._file.closed and os.getpid() == self._owner:
            # A forked data loader shares the lock: release it for both, but only from the owner.
            with contextlib.suppress(OSError):
                fcntl.flock(self._file, fcntl.LOCK_UN)
        self._file.close()


def index(call: str, iteration: int) -> int:
    """`iteration` as an int >= 0; ValueError or TypeError otherwise."""
    try:
        value = operator.index(iteration)
    except TypeError:
        raise TypeError(f"{call}(iteration={iteration!r}): must be an integer >= 0") from None
    if not 0 <= value < 2**53:
        raise ValueError(f"{call}(iteration={value}): must be an integer >= 0, below 2**53")
    return value


def number(call: str, name: str, value: Any) -> float | int | str:
    """A host number as strict JSON holds it; NaN and infinities become strings."""
    if isinstance(value, Tensor) or hasattr(value, "item"):  # also numpy scalars
        if isinstance(value, Tensor) and value.numel() != 1:
            raise ValueError(
                f"{call}({name}=tensor of shape {tuple(value.shape)}): must have one element"
            )
        value = value.item()
    if isinstance(value, int):  # and bool: False is 0, True is 1
        if abs(value) >= 2**1023:
            raise ValueError(f"{call}({name}=...): an integer above 2**1023 is no float64")
        return int(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    raise TypeError(f"{call}({name}={value!r}): must be a number or a one-element tensor")


def text(value: str) -> str:
    """`value` with a replacement character for each NUL and lone surrogate."""
    return NO_TEXT.sub("\ufffd", value)


def plain(call: str, value: Any, depth: int = 0) -> Any:
    """`value` (metadata, event details) as strict JSON holds it; TypeError if it cannot."""
    if depth > DEEPEST:
        raise ValueError(f"{call}: lists or mappings nested deeper than {DEEPEST}")
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, (str, os.PathLike)):
        return text(os.fsdecode(value))
    if isinstance(value, Mapping):
        return {text(str(key)): plain(call, item, depth + 1) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(call, item, depth + 1) for item in value]
    try:
        return number(call, "value", value)
    except TypeError:
        raise TypeError(
            f"{call}: {value!r} is no string, number, boolean, None, path, list or mapping"
        ) from None
