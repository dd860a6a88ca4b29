"""What a report says in numbers: runs grouped by scene and arm, compared with a baseline arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from opt3dgs_optim.runread import Run

__all__ = ["Arm", "Comparison", "Stat", "compare", "higher_is_better", "memory_of", "metric_names"]

NOT_METRICS = ("kind", "iteration", "seconds", "peak_cuda_bytes", "peak_host_bytes")
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
        with np.errstate(invalid="ignore"):  # inf - inf
            mean = float(np.mean(values))
            std = float(np.std(values, ddof=1)) if len(values) > 1 else None
        return Stat(mean, std, len(values))


@dataclass
class Arm:
    """The runs of one arm on one scene, and what they come to."""

    name: str
    runs: list[Run]
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
    baseline: str | None
    target: float | None  # the baseline's mean final metric
    arms: list[Arm]
    notes: list[str] = field(default_factory=list)


def compare(runs: Sequence[Run], metric: str, baseline: str | None) -> list[Comparison]:
    """Group `runs` by the metadata `scene` and `arm` (else the file's name) and compare.

    `baseline` names the reference arm; None takes "mcmc" if there, else the first arm.

    Raises:
        ValueError: no run has the arm `baseline`.
    """
    scenes: dict[str | None, dict[str, list[Run]]] = {}
    for run in runs:
        scene = run.metadata.get("scene")
        arms = scenes.setdefault(None if scene is None else str(scene), {})
        arms.setdefault(str(run.metadata.get("arm", run.name)), []).append(run)
    known = sorted({name for arms in scenes.values() for name in arms})
    if baseline is not None and baseline not in known:
        raise ValueError(f"--baseline {baseline!r}: no such arm; there are {', '.join(known)}")
    return [_compare_scene(scene, arms, metric, baseline) for scene, arms in scenes.items()]


def _compare_scene(
    scene: str | None, grouped: dict[str, list[Run]], metric: str, baseline: str | None
) -> Comparison:
    arms = [Arm(name, runs) for name, runs in grouped.items()]
    name = baseline or ("mcmc" if "mcmc" in grouped else arms[0].name)
    reference = next((arm for arm in arms if arm.name == name), None)
    if reference:  # listed first
        arms = [reference, *(arm for arm in arms if arm is not reference)]
    names = metric_names([run for arm in arms for run in arm.runs])
    for arm in arms:
        arm.finals = {m: Stat.of([v for r in arm.runs for v in _final(r, m)]) for m in names}
        arm.numbers = _numbers(arm.runs)
    final = reference.finals.get(metric) if reference else None
    target = final.mean if final and np.isfinite(final.mean) else None
    for arm in arms:
        if target is not None:
            reached = [_first_time(run, metric, target) for run in arm.runs]
            arm.to_baseline = Stat.of([t for t in reached if t is not None])
        if reference and arm is not reference:
            arm.gain, arm.paired = _gain(arm.runs, reference.runs, metric)
    return Comparison(
        scene, metric, name if reference else None, target, arms, _notes(arms, metric)
    )


def metric_names(runs: Sequence[Run]) -> list[str]:
    """Every metric the runs evaluated, PSNR, SSIM and training PSNR first."""
    found = dict.fromkeys(key for run in runs for key in run.evaluations if key not in NOT_METRICS)
    known = [name for name in ("psnr", "ssim", "train_psnr", "lpips") if name in found]
    return known + [name for name in found if name not in known]


def higher_is_better(metric: str) -> bool:
    """False for names that say error, loss, lpips and the like."""
    return not any(word in metric.lower() for word in LOWER_IS_BETTER)


def _final(run: Run, metric: str) -> list[float]:
    values = run.series(metric)[2]
    return [float(values[-1])] if len(values) else []


def _numbers(runs: list[Run]) -> dict[str, Stat | None]:
    seconds = [max((r["seconds"] for r in run.records), default=0.0) for run in runs]
    iterations = [max((r["iteration"] for r in run.records), default=0) for run in runs]
    memory = [memory_of(run) for run in runs]
    return {
        "seconds": Stat.of(seconds),
        "iterations": Stat.of(iterations),
        "iterations_per_second": Stat.of(
            [i / s for i, s in zip(iterations, seconds, strict=True) if s > 0]
        ),
        "peak_memory_bytes": Stat.of([m[1] for m in memory if m]),
        "mean_nu": Stat.of([v for run in runs for v in _step_mean(run, "nu")]),
        "accepted_share": Stat.of([v for run in runs for v in _step_mean(run, "accepted")]),
    }


def memory_of(run: Run) -> tuple[str, float] | None:
    """("cuda" or "host", peak bytes) of a run, None if not logged."""
    for where in ("cuda", "host"):
        values = run.series(f"peak_{where}_bytes")[2]
        if len(values):
            return where, float(values.max())
    return None


def _step_mean(run: Run, name: str) -> list[float]:
    """The mean over the finite values in the step lines, as a list of at most one."""
    values = run.series(name, "step")[2]
    values = values[np.isfinite(values)]
    return [float(values.mean())] if len(values) else []


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
    share = (goal - values[i - 1]) / (values[i] - values[i - 1])
    return float(seconds[i - 1] + share * (seconds[i] - seconds[i - 1]))


def _at(run: Run, metric: str, time: float) -> float | None:
    """The metric at `time` seconds, linear between evaluations; None before the first."""
    seconds, values = _curve(run, metric)
    return float(np.interp(time, seconds, values)) if len(seconds) and time >= seconds[0] else None


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
    """Difference of the means at the last second that all runs share."""
    last = [_curve(run, metric)[0][-1:] for run in (*runs, *references)]
    if any(len(end) == 0 for end in last):
        return None
    time = float(np.min(last))
    ours = [_at(run, metric, time) for run in runs]
    theirs = [_at(run, metric, time) for run in references]
    a = Stat.of([value for value in ours if value is not None])
    b = Stat.of([value for value in theirs if value is not None])
    if a is None or b is None or a.n < len(runs) or b.n < len(references):
        return None
    std = None if a.std is None or b.std is None else float(np.hypot(a.std, b.std))
    return Stat(a.mean - b.mean, std, a.n)


def _notes(arms: list[Arm], metric: str) -> list[str]:
    """What a reader must know before trusting the table."""
    notes = []
    for arm in arms:
        for run in arm.runs:
            values = run.series(metric)[2]
            if not any(r["kind"] != "start" for r in run.records):
                notes.append(f"{run.name} ({arm.name}): empty run, nothing logged")
            elif len(values) == 0:
                notes.append(f"{run.name} ({arm.name}): no evaluation of {metric}")
            elif not np.isfinite(values).all():
                count = int((~np.isfinite(values)).sum())
                notes.append(f"{run.name} ({arm.name}): {metric} not finite in {count} evaluations")
            elif len(values) == 1:
                notes.append(f"{run.name} ({arm.name}): a single evaluation of {metric}")
    return notes
