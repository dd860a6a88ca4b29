"""The run log: one JSON object a line, written while a trainer runs, without slowing it down.

Lines are `{"kind": "start" | "step" | "evaluation", "iteration": ..., "seconds": ...}` plus what
the call adds. JSON has no NaN or infinity: they are the strings "nan", "inf", "-inf".
"""

from __future__ import annotations

import json
import math
import os
import platform
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from opt3dgs_optim.checks import check_count, check_energy
from opt3dgs_optim.device import Reading
from opt3dgs_optim.runs.lines import read_run

Number = float | Tensor | np.number | np.bool_  # of one element


class _Pending(NamedTuple):
    """A line that waits for numbers on their way from a GPU (or for a line before it)."""

    line: dict[str, Any]
    names: list[str]
    reading: Reading | None = None  # of these names' numbers


class RunLog(AbstractContextManager["RunLog"]):
    """The log of one training run, appended line by line to the JSON-lines file `path`.

    Every line has the iteration and the run seconds at which it was logged. The clock runs from
    here on, and stands still within `paused`, so that evaluations cost no run time. `read_run`
    reads a log, and `opt3dgs report` compares several.

    A killed process loses at most the line that it was writing and, on a GPU, the few step lines
    whose numbers were still on their way.

    A step line costs no synchronisation with the GPU: CUDA scalars are copied to pinned memory in
    stream order, and written at a later call. Evaluations, `paused` and `close` do wait for the
    GPU. No autograd graph is kept.

    Args:
        path: the log file, a new one unless the run resumes. Missing parent folders are made.
        metadata: what describes the run, as JSON; what JSON cannot hold, such as paths, as a `str`.
            The report groups runs by `scene` and `arm`, and pairs runs of two arms by `seed`.
        resume: the iteration of the checkpoint from which the run and its clock go on, in the log
            at `path`. Readers leave out what was logged past that iteration. `metadata` is added to
            the log's, and its entries win.
        clock: returns seconds. `time.process_time` counts this process alone: a CPU that is busy
            with others changes nothing.

    Raises:
        FileExistsError: two runs in one file would be compared as one.
        FileNotFoundError: there is no log to resume.
        ValueError: metadata that is NaN or infinite; `resume` is no iteration, or `path`
            no run log.

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
        resume: int | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.path, self._clock, self._base = Path(path), clock, 0.0
        if resume is not None:
            check_count("RunLog", "resume", resume, 0)
            past = [r["seconds"] for r in read_run(path).records if r["iteration"] <= resume]
            self._base = past[-1] if past else 0.0
        elif self.path.exists():
            raise FileExistsError(
                f"RunLog: {os.fspath(path)!r} is there already; go on in it with "
                "resume=ITERATION, or choose another path"
            )
        self._pending: deque[_Pending] = deque()
        self._since: float | None = self._clock()  # None: paused
        start = self._line("start", resume or 0) | _origin() | {"metadata": dict(metadata or {})}
        text = _encoded(start)  # an error comes before there is a file
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(self.path, "ab", buffering=0)  # noqa: SIM115 - closed by close()
        # What a kill left of a line is no line.
        self._file.truncate(self.path.read_bytes().rfind(b"\n") + 1)
        self._file.write(text)

    @property
    def seconds(self) -> float:
        """Run seconds so far by the log's clock, without pauses, of all sessions of this run."""
        return self._base + (0.0 if self._since is None else self._clock() - self._since)

    def step(self, iteration: int, **columns: Number) -> None:
        """Log one optimization step: `log.step(iteration, loss=loss, lr=1e-3)`.

        `columns` are Python or numpy numbers, or tensors of one element on any device, under names
        of your own. Not every step needs the same ones. The report shows each column's mean over
        the run, except for losses (by name).

        Raises:
            ValueError: a negative iteration, a name of the log's own, what is not one number, or
                the log is closed.
        """
        self._add(self._line("step", iteration), columns, wait=False)

    def evaluation(self, iteration: int, **metrics: Number) -> None:
        """Log metrics of a number each: `log.evaluation(7_000, psnr=27.1, ssim=0.83)`.

        Names are free. The report compares by those with `psnr`, `ssim`, `lpips`, `l1` and the like
        in them. Raises as `step`.
        """
        self._add(self._line("evaluation", iteration), metrics, wait=True)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Let the run's clock stand still, for an evaluation or a checkpoint; may be nested.

        Waits for the GPU on both sides: queued training work counts, the work inside does not.
        """
        outermost = self._since is not None
        if outermost:
            _synchronize()
            self._base, self._since = self.seconds, None
        try:
            yield
        finally:
            if outermost:
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
        at = check_count(f"RunLog.{kind}", "iteration", iteration, 0)
        return {"kind": kind, "iteration": at, "seconds": round(self.seconds, 6)}

    def _add(self, line: dict[str, Any], values: Mapping[str, Any], *, wait: bool) -> None:
        """Put host numbers into `line`, send CUDA ones on their way, and write what can be."""
        call, sent = f"RunLog.{line['kind']}", {}
        for name, value in values.items():
            if name in line:
                raise ValueError(f"{call}: {name} is a name of the log's own; choose another")
            one = check_energy(call, name, value, torch.float64)
            if _on_gpu(value):
                sent[name] = one
            else:
                line[name] = _plain(float(one))
        reading = _reading_of([*sent.values()]) if sent else None
        self._pending.append(_Pending(line, [*sent], reading))
        self._drain(wait=wait)

    def _drain(self, *, wait: bool) -> None:
        """Write pending lines in order, up to the first whose numbers have not arrived."""
        while self._pending:
            line, names, reading = self._pending[0]
            if reading is not None:
                if (found := reading.take(wait)) is None:
                    return
                line |= zip(names, map(_plain, found), strict=True)
            self._pending.popleft()
            self._file.write(_encoded(line))


def _plain(value: float) -> float | str:
    return value if math.isfinite(value) else str(value)


def _encoded(line: Mapping[str, Any]) -> bytes:
    # A trainer's configuration has paths.
    text = json.dumps(line, separators=(",", ":"), allow_nan=False, default=str)
    return text.encode() + b"\n"


def _origin() -> dict[str, Any]:
    """Since when and on what the run goes; no host name."""
    machine = f"{platform.platform()}, {os.cpu_count()} CPUs, torch {torch.__version__}"
    if torch.cuda.is_initialized():
        machine += f", {torch.cuda.get_device_name()}"
    return {"time": datetime.now(timezone.utc).isoformat(timespec="seconds"), "machine": machine}


def _synchronize() -> None:
    if torch.cuda.is_initialized():  # anything else would start CUDA
        torch.cuda.synchronize()


def _on_gpu(value: Any) -> bool:
    return isinstance(value, Tensor) and value.is_cuda


def _reading_of(values: list[Tensor]) -> Reading:
    """Numbers of a GPU, [n] float64, on their way."""
    reading = Reading(torch.stack([value.to(torch.float64) for value in values]))
    reading.ask()
    return reading
