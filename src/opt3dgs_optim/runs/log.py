"""The run log: one JSON object a line, written while a trainer runs, without slowing it down.

Lines are `{"kind": "start" | "step" | "evaluation" | "event", "iteration": ..., "seconds": ...}`
plus whatever the call adds. JSON has no NaN or infinity: they are the strings "nan", "inf", "-inf".
"""

from __future__ import annotations

import json
import operator
import os
import platform
import re
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from datetime import datetime, timezone
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple, SupportsIndex

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim.checks import LOGGER, check_count, warn_user
from opt3dgs_optim.runs.lines import (
    RESUMED,
    LineFile,
    encoded,
    number,
    read_run,
    with_plain_keys,
)

Number = float | Tensor | np.number | np.bool_ | np.ndarray  # of one element
RESERVED = ("kind", "iteration", "seconds", "phase", "event", "metadata")


class _Pending(NamedTuple):
    """A line that waits for numbers on their way from a GPU (or for a line before it)."""

    line: dict[str, Any]
    names: Sequence[str] = ()
    host: Tensor | None = None  # [len(names)] float64, pinned
    ready: Any = None  # torch.cuda.Event, recorded after the copy into `host`


class RunLog(AbstractContextManager["RunLog"]):
    """The course of one training run, appended line by line to the JSON-lines file `path`.

    Every line has the iteration and the run seconds at which it was logged. The clock runs from
    here on, and stands still within `paused`, so that evaluations cost no run time. `read_run`
    reads a log, and `opt3dgs report` compares several.

    A killed process loses at most the line that it was writing and, on a GPU, the few step lines
    whose numbers were still on their way. An existing log is continued, and so is its clock. To go
    on from a checkpoint, use `resume`.

    A step line costs no synchronisation with the GPU: CUDA scalars are copied to pinned memory in
    stream order, and written at a later call. Evaluations, events, `paused` and `close` do wait for
    the GPU. No autograd graph is kept.

    Args:
        path: the log file. Missing parent folders are made.
        metadata: what describes the run, as JSON can hold it; numbers may be numpy's. The report
            groups runs by `scene` and `arm`, and pairs those of two arms by `seed`: a run without a
            seed is paired with none. `command` replaces the command line, which is recorded
            otherwise.
        clock: returns seconds; None is the wall's, `time.perf_counter`. `time.process_time` counts
            the seconds of this process alone: a CPU that is busy with others changes nothing.

    Raises:
        ValueError: `path` exists and is no run log.
        TypeError: metadata that JSON cannot hold, or a clock that cannot be called.
        BlockingIOError: another RunLog has the file open (noticed where files can be locked).

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
        if clock is not None and not callable(clock):
            raise TypeError(f"RunLog: clock={clock!r}, must be a function that returns seconds")
        described = json.loads(encoded(with_plain_keys(dict(metadata or {}))))
        self.path, self._clock = Path(path), clock or time.perf_counter
        self._pending: deque[_Pending] = deque()
        self._mirrors: list[Any] = []
        self._pauses = 0
        self._file = LineFile(self.path)
        try:
            last = read_run(self.path).records[-1:]
            self._base: float = last[0]["seconds"] if last else 0.0
            self._continued_at: int | None = last[0]["iteration"] if last else None
            self._since: float | None = self._clock()
            start = self._line("start", last[0]["iteration"] if last else 0)
            self._file.append(start | _origin() | {"metadata": described})
        except BaseException:
            self._file.close()
            raise

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
            ValueError: `iteration` is negative. Otherwise errors are those of the class.
        """
        if not Path(path).is_file():
            raise FileNotFoundError(f"RunLog.resume: no run log at {os.fspath(path)!r}")
        check_count("RunLog.resume", "iteration", iteration, 0, 2**53 - 1)
        log = cls(path, metadata=metadata, clock=clock)
        past = [r["seconds"] for r in read_run(path).records[:-1] if r["iteration"] <= iteration]
        log._base, log._since = past[-1] if past else 0.0, log._clock()
        log._continued_at = None  # the event says it
        log._event(RESUMED, iteration, {})
        return log

    def mirror(self, writer: Any) -> None:
        """Send every number that is logged from now on to TensorBoard or Weights & Biases too.

        Tags are `step/NAME` and `evaluation/NAME`, run seconds among them. Numbers go out with
        their line. A writer that raises gets nothing more, and the logger `opt3dgs_optim` says so.

        Args:
            writer: has `add_scalar(tag, value, step)`, as `torch.utils.tensorboard`'s
                `SummaryWriter`, or `log({tag: value}, step=step)`, as what `wandb.init` returns.

        Raises:
            TypeError: it has neither.
        """
        if not callable(getattr(writer, "add_scalar", getattr(writer, "log", None))):
            raise TypeError(f"RunLog.mirror({writer!r}): must have add_scalar() or log()")
        self._mirrors.append(writer)

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

    def step(
        self, iteration: SupportsIndex, *, phase: str | Enum | None = None, **columns: Number
    ) -> None:
        """Log one optimization step: `log.step(iteration, loss=loss, lr=1e-3)`.

        `columns` are numbers of Python or numpy, or tensors of one element on any device, by a name
        of your own. Not every step needs the same ones. The report shows the means over the run of
        the columns whose name says no loss.

        Raises:
            ValueError: a negative iteration, a reserved name, a tensor of several elements, or an
                integer beyond float64's range.
            TypeError: a value that is no number.
        """
        line = self._line("step", iteration)
        last, self._continued_at = self._continued_at, None
        if last is not None and line["iteration"] < last:
            warn_user(
                f"RunLog.step: iteration {line['iteration']} in a log that has {last} already, so "
                "that two runs stand in one file; use RunLog.resume to go on from a checkpoint, or "
                "another path"
            )
        if phase is not None:
            line["phase"] = str(phase.value if isinstance(phase, Enum) else phase)
        self._pending.append(_pack("RunLog.step", line, columns))
        self._drain(wait=False)

    def evaluation(self, iteration: SupportsIndex, **metrics: Number) -> None:
        """Log metrics of a number each: `log.evaluation(7_000, psnr=27.1, ssim=0.83)`.

        Names are free. The report knows of names with `psnr`, `ssim`, `lpips`, `l1` and the like in
        them whether higher is better; of others it has to be told. Raises as `step`.
        """
        line = self._line("evaluation", iteration)
        self._pending.append(_pack("RunLog.evaluation", line, metrics))
        self._drain(wait=True)

    def event(self, kind: str, iteration: SupportsIndex, **info: Any) -> None:
        """Log that something happened: `log.event("pruned", iteration, points=1_200)`.

        `info` may hold what `metadata` may, and one-element tensors. Raises as `step`.

        Raises:
            ValueError: the kind is "resumed", by which `resume` tells readers what to leave out.
        """
        if kind == RESUMED:
            raise ValueError(f"RunLog.event: kind={kind!r} is the log's own; choose another")
        _check_names("RunLog.event", info)
        self._event(kind, iteration, info)

    def _event(self, kind: str, iteration: SupportsIndex, info: Mapping[str, Any]) -> None:
        line = self._line("event", iteration) | {"event": kind} | with_plain_keys(info)
        self._pending.append(_Pending(line))
        self._drain(wait=True)

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
        """Write what is pending and release the file; a second call does nothing."""
        try:
            self._drain(wait=True)
        finally:
            self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _line(self, kind: str, iteration: SupportsIndex) -> dict[str, Any]:
        if self._file.closed:
            raise ValueError(f"RunLog.{kind}: the log {str(self.path)!r} is closed")
        at = check_count(f"RunLog.{kind}", "iteration", operator.index(iteration), 0, 2**53 - 1)
        return {"kind": kind, "iteration": at, "seconds": round(self.seconds, 6)}

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
            self._file.append(line)
            if line["kind"] != "event":
                self._send(line)

    def _send(self, line: dict[str, Any]) -> None:
        for writer in list(self._mirrors):
            names = sorted(line.keys() - {"kind", "iteration", "phase"})
            values = {f"{line['kind']}/{name}": float(line[name]) for name in names}
            try:
                if hasattr(writer, "add_scalar"):
                    for tag, value in values.items():
                        writer.add_scalar(tag, value, line["iteration"])
                else:
                    writer.log(values, step=line["iteration"])
            except Exception as error:  # whatever it is, the training is worth more
                self._mirrors.remove(writer)
                LOGGER.warning("RunLog.mirror: %r failed and gets no more: %r", writer, error)


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


def _pack(call: str, line: dict[str, Any], values: Mapping[str, Any]) -> _Pending:
    """Put host numbers into `line` and send CUDA ones on their way to pinned memory."""
    _check_names(call, values)
    on_gpu = {name: value for name, value in values.items() if _on_gpu(value)}
    line |= {n: number(call, n, value) for n, value in values.items() if n not in on_gpu}
    sent = _to_pinned(list(on_gpu.values())) if on_gpu else ()
    return _Pending(line, list(on_gpu), *sent)


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
        if name in RESERVED or not name.isprintable():
            raise ValueError(
                f"{call}({name!a}=...): reserved; choose a printable name not in {RESERVED}"
            )
