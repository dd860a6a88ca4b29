"""What a report says in numbers: runs grouped by scene and arm, compared with a baseline arm."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from opt3dgs_optim.runs.lines import Run

NO_NUMBERS = ("iteration", "seconds", "phase")  # of the columns, not of interest
KNOWN = ("psnr", "ssim", "train_psnr", "lpips")  # listed first
_last = operator.itemgetter(-1)
LOWER_IS_BETTER = ("lpips", "loss", "error", "mse", "mae", "l1", "l2", "energy", "flip")


@dataclass(frozen=True)
class Stat:
    """Mean and sample standard deviation (None for n = 1) over `n` runs."""

    mean: float
    std: float | None
    n: int

    @staticmethod
    def of(values: Sequence[float]) -> Stat | None:
        """The statistic of `values`, or None if there are none; a NaN among them shows."""
        if len(values) == 0:
            return None
        with np.errstate(all="ignore"):  # inf - inf, squares of 1e200
            std = float(np.std(values, ddof=1)) if len(values) > 1 else None
            return Stat(float(np.mean(values)), std, len(values))


@dataclass
class Arm:
    """The runs of one arm on one scene, and what they come to, by the heading in the table."""

    name: str
    runs: list[Run]
    colour: int  # the same on every scene; 0 is the baseline's
    numbers: dict[str, Stat | None]


@dataclass
class Comparison:
    """All arms on one scene."""

    scene: str | None
    metric: str
    baseline: str | None  # None: it did not run on this scene
    target: float  # the baseline's mean final metric; NaN where it has none that is finite
    arms: list[Arm]


def compare(
    runs: Sequence[Run], metric: str | None = None, baseline: str | None = None
) -> list[Comparison]:
    """Group `runs` by the metadata `scene` and `arm` (else the file's name) and compare.

    `metric` None takes psnr, else the first that is logged; `baseline` None takes "mcmc" if there,
    else the first arm.

    Raises:
        ValueError: no log has that metric, or no run that arm.
    """
    scenes: dict[str | None, dict[str, list[Run]]] = {}
    for run in runs:
        scene = run.metadata.get("scene")
        arms = scenes.setdefault(None if scene is None else str(scene), {})
        arms.setdefault(str(run.metadata.get("arm", run.name)), []).append(run)
    names = list(dict.fromkeys(name for arms in scenes.values() for name in arms))
    metrics = metric_names(runs)
    if metric is None:
        metric = metrics[0] if metrics else KNOWN[0]
    elif metric not in metrics:
        there = ", ".join(metrics) or "no metrics at all"
        raise ValueError(f"--metric {metric!r}: in no log; there are {there}")
    if baseline is None:
        baseline = "mcmc" if "mcmc" in names else names[0]
    elif baseline not in names:
        raise ValueError(f"--baseline {baseline!r}: no such arm; there are {', '.join(names)}")
    order = list(dict.fromkeys([baseline, *names]))
    return [_compare_scene(scene, arms, order, metric) for scene, arms in scenes.items()]


def _compare_scene(
    scene: str | None, runs: dict[str, list[Run]], order: list[str], metric: str
) -> Comparison:
    everything = [run for arm in runs.values() for run in arm]
    metrics = metric_names(everything)
    found = dict.fromkeys(name for run in everything for name in run.steps)
    columns = [name for name in found if name not in NO_NUMBERS and higher_is_better(name)]
    references = runs.get(order[0], [])
    final = _stat(references, metric, _last)
    target = final.mean if final and np.isfinite(final.mean) else np.nan
    arms = []
    for colour, name in enumerate(order):
        if not (own := runs.get(name)):
            continue
        numbers = {f"final {m}": _stat(own, m, _last) for m in metrics}
        seconds = [max((r["seconds"] for r in run.records), default=0.0) for run in own]
        iterations = [max((r["iteration"] for r in run.records), default=0) for run in own]
        rates = [i / s for i, s in zip(iterations, seconds, strict=True) if s > 0]
        numbers |= {"seconds": Stat.of(seconds), "iterations": Stat.of(iterations)}
        numbers |= {"iterations/s": Stat.of(rates)}
        numbers |= {f"mean {c}": _stat(own, c, _finite_mean, "step") for c in columns}
        reached = [t for run in own if (t := _first_time(run, metric, target)) is not None]
        numbers[f"seconds to baseline {metric}"] = Stat.of(reached)
        gains = [] if name == order[0] else _gains(own, references, metric)
        numbers[f"{metric} gain at equal seconds"] = Stat.of(gains)
        arms.append(Arm(name, own, colour, numbers))
    return Comparison(scene, metric, order[0] if references else None, target, arms)


def metric_names(runs: Sequence[Run]) -> list[str]:
    """Every metric the runs evaluated, PSNR, SSIM and training PSNR first."""
    found = dict.fromkeys(name for run in runs for name in run.evaluations)
    named = dict.fromkeys([*KNOWN, *found])
    return [name for name in named if name in found and name not in NO_NUMBERS]


def higher_is_better(metric: str) -> bool:
    """False for names that say error, loss, lpips and the like."""
    return not any(word in metric.lower() for word in LOWER_IS_BETTER)


def _stat(runs: list[Run], name: str, of: Any, kind: str = "evaluation") -> Stat | None:
    """Of what `of` makes of the values of `name`, over the runs that log it."""
    series = [run.series(name, kind)[2] for run in runs]
    return Stat.of([of(values) for values in series if len(values)])


def _finite_mean(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    with np.errstate(over="ignore"):
        return float(values.mean()) if len(values) else float("nan")


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


def _gains(runs: list[Run], references: list[Run], metric: str) -> list[float]:
    """For every seed that both have: the gain at the smaller of the two final times."""
    by_seed = {repr(run.metadata.get("seed")): _curve(run, metric) for run in references}
    gains = []
    for run in runs:
        ours, theirs = _curve(run, metric), by_seed.get(repr(run.metadata.get("seed")))
        if theirs is None or len(ours[0]) == 0 or len(theirs[0]) == 0:
            continue
        time = min(ours[0][-1], theirs[0][-1])
        if time >= max(ours[0][0], theirs[0][0]):
            gains.append(float(np.interp(time, *ours) - np.interp(time, *theirs)))
    return gains
