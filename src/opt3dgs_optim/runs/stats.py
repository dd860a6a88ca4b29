"""What a report says in numbers: runs grouped by scene and arm, compared with a baseline arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from opt3dgs_optim.runs.read import Run

KNOWN = ("psnr", "ssim", "train_psnr", "lpips")  # listed first
MEMORY = ("peak_cuda_bytes", "peak_host_bytes")
NO_NUMBERS = ("iteration", "seconds", "phase", *MEMORY)  # of the columns, not of interest
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
    """The runs of one arm on one scene, and what they come to."""

    name: str
    runs: list[Run]
    colour: int  # the same on every scene; 0 is the baseline's
    finals: dict[str, Stat | None] = field(default_factory=dict)  # last value of every metric
    numbers: dict[str, Stat | None] = field(default_factory=dict)  # seconds, iterations, ...
    to_baseline: Stat | None = None  # seconds to the baseline's final metric; n runs got there
    gain: Stat | None = None  # over the baseline at equal seconds, positive is better
    paired: bool = False  # whether `gain` pairs equal seeds


@dataclass
class Comparison:
    """All arms on one scene."""

    scene: str | None
    metric: str
    baseline: str | None  # None: it did not run on this scene
    target: float | None  # the baseline's mean final metric
    arms: list[Arm]
    notes: list[str]


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
    colours = {name: i for i, name in enumerate(dict.fromkeys([baseline, *names]))}
    return [
        _compare_scene(scene, [Arm(n, arms[n], colours[n]) for n in colours if n in arms], metric)
        for scene, arms in scenes.items()
    ]


def _compare_scene(scene: str | None, arms: list[Arm], metric: str) -> Comparison:
    reference = arms[0] if arms[0].colour == 0 else None
    names = metric_names([run for arm in arms for run in arm.runs])
    for arm in arms:
        arm.finals = {name: _stat(arm.runs, name, lambda values: values[-1]) for name in names}
        arm.numbers = _numbers(arm.runs)
    final = reference.finals.get(metric) if reference else None
    target = final.mean if final and np.isfinite(final.mean) else None
    for arm in arms:
        if target is not None:
            reached = [_first_time(run, metric, target) for run in arm.runs]
            arm.to_baseline = Stat.of([seconds for seconds in reached if seconds is not None])
        if reference and arm is not reference:
            arm.gain, arm.paired = _gain(arm.runs, reference.runs, metric)
    baseline = reference.name if reference else None
    return Comparison(scene, metric, baseline, target, arms, _notes(arms, metric))


def metric_names(runs: Sequence[Run]) -> list[str]:
    """Every metric the runs evaluated, PSNR, SSIM and training PSNR first."""
    found = dict.fromkeys(key for run in runs for key in run.evaluations if key not in NO_NUMBERS)
    return [name for name in KNOWN if name in found] + [n for n in found if n not in KNOWN]


def step_names(runs: Sequence[Run]) -> list[str]:
    """The columns of the step lines that are no loss: what the parts say of themselves."""
    found = dict.fromkeys(key for run in runs for key in run.steps if key not in NO_NUMBERS)
    return [name for name in found if higher_is_better(name)]


def higher_is_better(metric: str) -> bool:
    """False for names that say error, loss, lpips and the like."""
    return not any(word in metric.lower() for word in LOWER_IS_BETTER)


def _numbers(runs: list[Run]) -> dict[str, Stat | None]:
    seconds = [max((r["seconds"] for r in run.records), default=0.0) for run in runs]
    iterations = [max((r["iteration"] for r in run.records), default=0) for run in runs]
    rates = [i / s for i, s in zip(iterations, seconds, strict=True) if s > 0]
    numbers = {"seconds": Stat.of(seconds), "iterations": Stat.of(iterations)}
    numbers |= {"iterations_per_second": Stat.of(rates)}
    numbers |= {name: _stat(runs, name, np.max) for name in MEMORY}
    return numbers | {f"mean_{n}": _stat(runs, n, np.mean, "step") for n in step_names(runs)}


def _stat(runs: list[Run], name: str, of: Any, kind: str = "evaluation") -> Stat | None:
    """Over the runs that log a number: `of` its values, in steps of the finite ones."""
    series = [run.series(name, kind)[2] for run in runs]
    if kind == "step":
        series = [values[np.isfinite(values)] for values in series]
    with np.errstate(over="ignore"):
        return Stat.of([float(of(values)) for values in series if len(values)])


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


def _gain(runs: list[Run], references: list[Run], metric: str) -> tuple[Stat | None, bool]:
    """Gain at the smaller of the final times; paired by seed where every run has its partner."""
    by_seed = {repr(r.metadata["seed"]): r for r in references if "seed" in r.metadata}
    seeds = [repr(run.metadata["seed"]) for run in runs if "seed" in run.metadata]
    if len(set(seeds)) == len(runs) and all(seed in by_seed for seed in seeds):
        pairs = [(run, by_seed[seed]) for run, seed in zip(runs, seeds, strict=True)]
        gains = [_difference([run], [partner], metric) for run, partner in pairs]
        return Stat.of([gain.mean for gain in gains if gain]), True
    return _difference(runs, references, metric), False


def _difference(runs: list[Run], references: list[Run], metric: str) -> Stat | None:
    """Difference of the means at the last second that all runs share; None before some begins."""
    curves = [_curve(run, metric) for run in (*runs, *references)]
    if any(len(seconds) == 0 for seconds, _ in curves):
        return None
    time = min(seconds[-1] for seconds, _ in curves)
    if any(time < seconds[0] for seconds, _ in curves):
        return None
    values = [float(np.interp(time, *curve)) for curve in curves]
    a, b = Stat.of(values[: len(runs)]), Stat.of(values[len(runs) :])
    assert a is not None
    assert b is not None
    std = None if a.std is None or b.std is None else float(np.hypot(a.std, b.std))
    return Stat(a.mean - b.mean, std, a.n)


def _notes(arms: list[Arm], metric: str) -> list[str]:
    """What a reader must know before trusting the table."""
    notes = []
    for arm in arms:
        for run in arm.runs:
            values = run.series(metric)[2]
            odd = int((~np.isfinite(values)).sum())
            if all(r["kind"] == "start" for r in run.records):
                note = "empty run, nothing logged"
            elif len(values) == 0:
                note = f"no evaluation of {metric}"
            elif odd:
                note = f"{metric} not finite in {odd} evaluations"
            elif len(values) == 1:
                note = f"a single evaluation of {metric}"
            else:
                continue
            notes.append(f"{run.name} ({arm.name}): {note}")
    return notes
