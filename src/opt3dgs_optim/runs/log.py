"""The run log: one JSON object a line, written while a trainer runs, without slowing it down.

Lines are `{"kind": "start" | "step" | "evaluation" | "event", "iteration": ..., "seconds": ...}`
plus whatever the call adds. JSON has no NaN or infinity: they are the strings "nan", "inf", "-inf".
"""

from __future__ import annotations

import os
import platform
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim.checks import check_count
from opt3dgs_optim.runs.lines import RESUMED, encoded, number, read_run

Number = float | Tensor | np.number | np.bool_ | np.ndarray  # of one element
RESERVED = ("kind", "iteration", "seconds", "phase", "event", "metadata")


class _Pending(NamedTuple):
    """A line that waits for numbers on their way from a GPU (or for a line before it)."""

    line: dict[str, Any]
    names: list[str]
    host: Tensor | None = None  # [len(names)] float64, pinned
    ready: Any = None  # torch.cuda.Event, recorded after the copy into `host`


class RunLog(AbstractContextManager["RunLog"]):
    """The course of one training run, appended line by line to the JSON-lines file `path`.

    Every line has the iteration and the run seconds at which it was logged. The clock runs from
    here on, and stands still within `paused`, so that evaluations cost no run time. `read_run`
    reads a log, and `opt3dgs report` compares several.

    A killed process loses at most the line that it was writing and, on a GPU, the few step lines
    whose numbers were still on their way. To go on from a checkpoint, use `resume`.

    A step line costs no synchronisation with the GPU: CUDA scalars are copied to pinned memory in
    stream order, and written at a later call. Evaluations, events, `paused` and `close` do wait for
    the GPU. No autograd graph is kept.

    Args:
        path: the log file, a new one. Missing parent folders are made.
        metadata: what describes the run, as JSON can hold it; numbers may be numpy's. The report
            groups runs by `scene` and `arm`, and pairs those of two arms by `seed`. `command`
            replaces the command line, which is recorded otherwise.
        clock: returns seconds; None is the wall's, `time.perf_counter`. `time.process_time` counts
            the seconds of this process alone: a CPU that is busy with others changes nothing.

    Raises:
        FileExistsError: two runs in one file would be compared as one.
        TypeError: metadata that JSON cannot hold.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from opt3dgs_optim import RunLog
        >>> from opt3dgs_optim.runs import read_run
        >>> about = {"scene": "garden", "arm": "stock", "seed": 0}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with RunLog(f"{folder}/stock-0.jsonl", metadata=about) as log:
        ...         for iteration in range(3):
        ...             loss = torch.tensor(1 / (iteration + 1))  # your training step
        ...             log.step(iteration, loss=loss)
        ...         with log.paused():
        ...             psnr = 25.0  # your evaluation
        ...         log.evaluation(2, psnr=psnr)
        ...     run = read_run(log.path)
        >>> run.metadata["arm"], run.steps["iteration"].tolist(), run.evaluations["psnr"].tolist()
        ('stock', [0, 1, 2], [25.0])
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        metadata: Mapping[str, Any] | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        if Path(path).exists():
            raise FileExistsError(
                f"RunLog: {os.fspath(path)!r} is there already; go on in it with RunLog.resume("
                "path, iteration=...), or choose another path"
            )
        self._open(path, metadata, clock, iteration=0, seconds=0.0)

    def _open(
        self,
        path: str | os.PathLike[str],
        metadata: Mapping[str, Any] | None,
        clock: Callable[[], float] | None,
        *,
        iteration: int,
        seconds: float,
    ) -> None:
        start = _origin() | {"metadata": dict(metadata or {})}
        encoded(start)  # a TypeError comes before there is a file
        self.path, self._clock = Path(path), clock or time.perf_counter
        self._pending: deque[_Pending] = deque()
        self._pauses, self._base = 0, seconds
        self._since: float | None = self._clock()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(self.path, "ab", buffering=0)  # noqa: SIM115 - closed by close()
        # What a kill left of a line is no line.
        self._file.truncate(self.path.read_bytes().rfind(b"\n") + 1)
        self._write(self._line("start", iteration) | start)

    @classmethod
    def resume(
        cls,
        path: str | os.PathLike[str],
        *,
        iteration: int,
        metadata: Mapping[str, Any] | None = None,
        clock: Callable[[], float] | None = None,
    ) -> RunLog:
        """Continue the log `path`, and its clock, from a checkpoint taken at `iteration`.

        What was logged past that iteration stays in the file; a "resumed" event tells readers to
        drop it. `metadata` is added to the log's, and its entries win.

        Raises:
            FileNotFoundError: there is no log at `path`.
            ValueError: `iteration` is negative, or `path` is no run log.
        """
        check_count("RunLog.resume", "iteration", iteration, 0)
        past = [r["seconds"] for r in read_run(path).records if r["iteration"] <= iteration]
        log = cls.__new__(cls)
        seconds = past[-1] if past else 0.0
        log._open(path, metadata, clock, iteration=iteration, seconds=seconds)
        log._write(log._line("event", iteration) | {"event": RESUMED})
        return log

    @property
    def seconds(self) -> float:
        """Run seconds so far by the log's clock, without pauses, of all sessions of this run."""
        # A clock may be set back to before the session began.
        passed = 0.0 if self._since is None else max(self._clock() - self._since, 0.0)
        return self._base + passed

    @property
    def closed(self) -> bool:
        """Whether nothing can be written any more."""
        return self._file.closed

    def step(self, iteration: int, *, phase: str | Enum | None = None, **columns: Number) -> None:
        """Log one optimization step: `log.step(iteration, loss=loss, lr=1e-3)`.

        `columns` are numbers of Python or numpy, or tensors of one element on any device, by a name
        of your own. Not every step needs the same ones. The report shows the means over the run of
        the columns whose name says no loss.

        Raises:
            ValueError: a negative iteration, a reserved name, or a tensor of several elements.
            TypeError: a value that is no number.
        """
        line = self._line("step", iteration)
        if phase is not None:
            line["phase"] = str(phase.value if isinstance(phase, Enum) else phase)
        self._add("RunLog.step", line, columns)
        self._drain(wait=False)

    def evaluation(self, iteration: int, **metrics: Number) -> None:
        """Log metrics of a number each: `log.evaluation(7_000, psnr=27.1, ssim=0.83)`.

        Names are free. The report knows of names with `psnr`, `ssim`, `lpips`, `l1` and the like in
        them whether higher is better; of others it has to be told. Raises as `step`.
        """
        self._add("RunLog.evaluation", self._line("evaluation", iteration), metrics)
        self._drain(wait=True)

    def event(self, kind: str, iteration: int, **fields: Any) -> None:
        """Log that something happened: `log.event("pruned", iteration, points=1_200)`.

        `fields` may hold what `metadata` may, and one-element tensors. Raises as `step`.

        Raises:
            ValueError: the kind is "resumed", by which `resume` tells readers what to leave out.
        """
        if kind == RESUMED:
            raise ValueError(f"RunLog.event: kind={kind!r} is the log's own; choose another")
        _check_names("RunLog.event", fields)
        self._drain(wait=True)
        self._write(self._line("event", iteration) | {"event": kind} | fields)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Let the run's clock stand still, for an evaluation or a checkpoint; may be nested.

        Waits for the GPU on both sides: queued training work counts, the work inside does not.
        """
        if self._pauses == 0:
            _synchronize()
            self._base, self._since = self.seconds, None
        self._pauses += 1
        try:
            yield
        finally:
            self._pauses -= 1
            if self._pauses == 0:
                _synchronize()
                self._since = self._clock()

    def close(self) -> None:
        """Write what is pending and close the file; a second call does nothing."""
        try:
            self._drain(wait=True)
        finally:
            self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _line(self, kind: str, iteration: int) -> dict[str, Any]:
        if self.closed:
            raise ValueError(f"RunLog.{kind}: the log {str(self.path)!r} is closed")
        at = check_count(f"RunLog.{kind}", "iteration", iteration, 0)
        return {"kind": kind, "iteration": at, "seconds": round(self.seconds, 6)}

    def _add(self, call: str, line: dict[str, Any], values: Mapping[str, Any]) -> None:
        """Put host numbers into `line` and send CUDA ones on their way to pinned memory."""
        _check_names(call, values)
        on_gpu = {name: value for name, value in values.items() if _on_gpu(value)}
        line |= {n: number(call, n, value) for n, value in values.items() if n not in on_gpu}
        sent = _to_pinned(list(on_gpu.values())) if on_gpu else ()
        self._pending.append(_Pending(line, list(on_gpu), *sent))

    def _drain(self, *, wait: bool) -> None:
        """Write pending lines in order, up to the first whose numbers have not arrived."""
        while self._pending:
            line, names, host, ready = self._pending[0]
            if host is not None:
                if wait:
                    ready.synchronize()
                elif not ready.query():
                    return
                line |= dict(zip(names, host.tolist(), strict=True))
            self._pending.popleft()
            self._write(line)

    def _write(self, line: Mapping[str, Any]) -> None:
        self._file.write(encoded(line).encode() + b"\n")


def _origin() -> dict[str, Any]:
    """What runs, where and since when; no host name, no folders."""
    machine = f"{platform.platform()}, {os.cpu_count()} CPUs"
    if torch.cuda.is_initialized():
        machine += f", {torch.cuda.get_device_name()}"
    # "--data=/home/me/plush" becomes "--data=plush".
    words = [re.sub(r"[^=]*[/\\](?=[^=]*$)", "", word.rstrip("/\\")) for word in sys.argv]
    return {
        "time": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "command": " ".join(words),
        "machine": f"{machine}, Python {platform.python_version()}, torch {torch.__version__}",
    }


def _synchronize() -> None:
    if torch.cuda.is_initialized():  # anything else would start CUDA
        torch.cuda.synchronize()


def _on_gpu(value: Any) -> bool:
    return isinstance(value, Tensor) and value.is_cuda and value.numel() == 1


def _to_pinned(values: list[Tensor]) -> tuple[Tensor, Any]:
    """Copy CUDA scalars to the host in stream order: (pinned [n] float64, event of completion)."""
    device = values[0].device
    packed = [v.detach().reshape(()).to(device, torch.float64, non_blocking=True) for v in values]
    host = torch.empty(len(values), dtype=torch.float64, device="cpu", pin_memory=True)
    host.copy_(torch.stack(packed), non_blocking=True)
    ready = torch.cuda.Event()
    ready.record(torch.cuda.current_stream(device))
    return host, ready


def _check_names(call: str, values: Mapping[str, Any]) -> None:
    for name in values:
        if name in RESERVED:
            raise ValueError(f"{call}({name}=...): reserved; choose a name not in {RESERVED}")
