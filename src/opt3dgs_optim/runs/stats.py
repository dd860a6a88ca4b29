"""What a report says in numbers: runs grouped by scene and arm, compared with a baseline arm."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from opt3dgs_optim.plateau import BLOCK, WINDOW, gain
from opt3dgs_optim.runs.lines import Run

COUNTS = ("iteration", "seconds")  # of the columns, no values of the trainer's
HIGHER = {"psnr", "ssim", "fps", "accuracy", "iou"}
LOWER = {"lpips", "dssim", "l1", "l2", "mse", "rmse", "mae", "loss", "error", "energy"}


def higher_is_better(metric: str) -> bool | None:
    """Whether higher values of a metric are better; None where the words of its name do not say so.

    `val_psnr` is a PSNR, and `val1_points` no L1 error. Of `ssim_loss` nothing is known.
    """
    words = set(re.findall(r"[^\W_]+", metric.lower()))
    higher, lower = bool(words & HIGHER), bool(words & LOWER)
    return None if higher == lower else higher


@dataclass(frozen=True)
class Stat:
    """Mean and its standard error (None for n = 1) over `n` runs."""

    mean: float
    error: float | None
    n: int

    @staticmethod
    def of(values: Sequence[float]) -> Stat | None:
        """The statistic of `values`, or None if there are none; a NaN among them shows."""
        n = len(values)
        error = float(np.std(values, ddof=1) / np.sqrt(n)) if n > 1 else None
        return Stat(float(np.mean(values)), error, n) if n else None


@dataclass
class Arm:
    """The runs of one arm on one scene, and what they come to, by the heading in the table."""

    name: str
    runs: list[Run]
    colour: int  # the same on every scene; 0 is the baseline's
    numbers: dict[str, Stat | None]


@dataclass
class Comparison:
    """All arms on one scene ("": of the runs without one)."""

    scene: str
    metric: str
    baseline: str
    target: float  # the baseline's mean final metric; NaN where it has none
    arms: list[Arm]


def compare(
    runs: Sequence[Run], metric: str | None = None, baseline: str | None = None
) -> list[Comparison]:
    """Group `runs` by the metadata `scene` and `arm` (else the log's name) and compare.

    `metric` and `baseline` are `report.write_report`'s.

    Raises:
        ValueError: there are no runs, none with that arm or metric, or two of one scene, arm and
            seed; the metric's name does not say which values are better.
    """
    if not runs:
        raise ValueError("no runs: pass run logs, or folders with *.jsonl in them")
    scenes: dict[str, dict[str, list[Run]]] = {}
    for run in runs:
        arm = str(run.metadata.get("arm", run.name))
        own = scenes.setdefault(str(run.metadata.get("scene", "")), {}).setdefault(arm, [])
        if _seed(run) in {_seed(other) for other in own} - {None}:
            raise ValueError(f"arm {arm!r} has two runs of seed {_seed(run)}; one is {run.name!r}")
        own.append(run)
    names = list(dict.fromkeys(name for arms in scenes.values() for name in arms))
    baseline = baseline or ("stock" if "stock" in names else names[0])
    if baseline not in names:
        raise ValueError(f"--baseline {baseline!r}: no such arm; there are {', '.join(names)}")
    metrics = _logged(runs, "evaluations")
    judged = [name for name in metrics if higher_is_better(name) is not None]
    metric = metric or ("psnr" if "psnr" in judged else next(iter(judged), "psnr"))
    if metric not in judged:
        raise ValueError(
            f"--metric {metric!r}: not among those that a run has evaluated and whose name says "
            f"which values are better: {', '.join(judged) or 'there are none'}"
        )
    order = list(dict.fromkeys([baseline, *names]))
    return [_compare_scene(scene, arms, order, metric) for scene, arms in scenes.items()]


def _compare_scene(
    scene: str, runs: dict[str, list[Run]], order: list[str], metric: str
) -> Comparison:
    everything = [run for own in runs.values() for run in own]
    metrics = _logged(everything, "evaluations")
    # The mean of a loss over a training says nothing.
    columns = [c for c in _logged(everything, "steps") if higher_is_better(c) is not False]
    references = {_seed(run): run for run in runs.get(order[0], []) if _seed(run) is not None}
    final = _final(runs.get(order[0], []), metric)
    target = np.nan if final is None else final.mean
    arms = []
    for colour, name in [(i, name) for i, name in enumerate(order) if name in runs]:
        own = runs[name]
        numbers = {f"final {each}": _final(own, each) for each in metrics}
        for heading, key in (("seconds", "seconds"), ("iterations", "iteration")):
            last = [max((r[key] for r in run.records), default=0) for run in own]
            numbers[heading] = Stat.of(last)
        for column in columns:
            logged = [run.series(column, "step")[2] for run in own]
            finite = [values[np.isfinite(values)] for values in logged]
            numbers[f"mean {column}"] = Stat.of([float(v.mean()) for v in finite if len(v)])
        reached = [_first_time(run, metric, target) for run in own]
        pairs = [(run, references[_seed(run)]) for run in own if _seed(run) in references]
        gains = [_gain(*pair, metric) for pair in pairs if name != order[0]]
        numbers[f"seconds to baseline {metric}"] = Stat.of([t for t in reached if t is not None])
        numbers[f"{metric} gain at equal seconds"] = Stat.of([g for g in gains if g is not None])
        arms.append(Arm(name, own, colour, numbers))
    return Comparison(scene, metric, order[0], target, arms)


def _seed(run: Run) -> str | None:
    seed = run.metadata.get("seed")
    return None if seed is None else str(seed)


def _logged(runs: Sequence[Run], kind: str) -> list[str]:
    """The names of what the trainer logged, in its order."""
    names = dict.fromkeys(name for run in runs for name in getattr(run, kind))
    return [name for name in names if name not in COUNTS]


def _final(runs: Sequence[Run], metric: str) -> Stat | None:
    series = [run.series(metric)[2] for run in runs]
    return Stat.of([float(values[-1]) for values in series if len(values)])


def _curve(run: Run, metric: str) -> tuple[np.ndarray, np.ndarray]:
    """(seconds, metric turned so that more is better)."""
    _, seconds, values = run.series(metric)
    return seconds, values if higher_is_better(metric) else -values


def _first_time(run: Run, metric: str, target: float) -> float | None:
    """Seconds until the metric first reaches `target`, linear between evaluations."""
    seconds, values = _curve(run, metric)
    goal = target if higher_is_better(metric) else -target
    reached = np.flatnonzero(values >= goal)
    if len(reached) == 0:
        return None
    i = int(reached[0])
    if i == 0 or not np.isfinite(values[i - 1 : i + 1]).all():
        return float(seconds[i])
    return float(np.interp(goal, values[i - 1 : i + 1], seconds[i - 1 : i + 1]))


def _gain(run: Run, reference: Run, metric: str) -> float | None:
    """The difference to `reference` at the smaller of the two final times; None: no such time."""
    ours, theirs = _curve(run, metric), _curve(reference, metric)
    if len(ours[0]) == 0 or len(theirs[0]) == 0:
        return None
    time = min(ours[0][-1], theirs[0][-1])
    if time < max(ours[0][0], theirs[0][0]):
        return None
    return float(np.interp(time, *ours) - np.interp(time, *theirs))


def gain_at_end(run: Run) -> tuple[float, float] | None:
    """Decibels that the loss gained in the last iterations, and their standard error.

    None where the run's steps have no `loss`, not that of every iteration, or one
    that is not above 0.
    """
    iterations, _, losses = run.series("loss", "step")
    last = losses[-2 * WINDOW :]
    if len(last) < 2 * WINDOW or iterations[-1] - iterations[-2 * WINDOW] >= 2 * WINDOW:
        return None
    before, now = np.split(last.reshape(-1, BLOCK).mean(1), 2)
    found = gain(before.tolist(), now.tolist())
    return None if math.isnan(found[0]) else found
