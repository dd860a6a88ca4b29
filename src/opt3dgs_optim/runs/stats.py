"""What a report says in numbers: runs grouped by scene and arm, compared with a baseline arm."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from opt3dgs_optim.runs.lines import Run

NO_NUMBERS = ("iteration", "seconds", "phase")  # of the columns, not of interest
KNOWN = ("psnr", "ssim", "train_psnr", "lpips")  # listed first
HIGHER = {"psnr", "ssim", "fps", "accuracy", "iou"}
LOWER = {"lpips", "dssim", "l1", "l2", "mse", "rmse", "mae", "loss", "error", "energy"}
WORD = re.compile(r"[^\W_]+")  # letters and digits
_last: Callable[[np.ndarray], float] = operator.itemgetter(-1)


def higher_is_better(metric: str) -> bool | None:
    """Whether higher values of a metric are better; None where the words of its name do not say so.

    `val_psnr` is a PSNR, and `val1_points` no L1 error. Of `ssim_loss` nothing is known.
    """
    words = set(WORD.findall(metric.lower()))
    higher, lower = bool(words & HIGHER), bool(words & LOWER)
    return None if higher == lower else higher


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
        std = float(np.std(values, ddof=1)) if len(values) > 1 else None
        return Stat(float(np.mean(values)), std, len(values))


@dataclass
class Arm:
    """The runs of one arm on one scene, and what they come to, by the heading in the table."""

    name: str
    runs: list[Run]
    colour: int  # the same on every scene; 0 is the baseline's
    numbers: dict[str, Stat | None]
    num_paired: int  # of the runs, those with a run of the baseline of the same seed


@dataclass
class Comparison:
    """All arms on one scene."""

    scene: str | None
    metric: str
    higher_is_better: bool
    baseline: str | None  # None: it did not run on this scene
    target: float  # the baseline's mean final metric; NaN where it has none
    arms: list[Arm]


def compare(
    runs: Sequence[Run],
    metric: str | None = None,
    baseline: str | None = None,
    higher: bool | None = None,
) -> list[Comparison]:
    """Group `runs` by the metadata `scene` and `arm` (else the file's name) and compare.

    Args:
        runs: of any number of scenes, arms and seeds.
        metric: to compare by; None takes psnr if it is logged, else the first whose direction is
            known from its name, else the first.
        baseline: reference arm; None takes "mcmc" if there, else the first.
        higher: whether higher values of the metric are better; None: by its name.

    Raises:
        ValueError: no log has that metric, no run that arm, or the metric's name does not say
            which values are better.
    """
    scenes: dict[str | None, dict[str, list[Run]]] = {}
    for run in runs:
        scene = run.metadata.get("scene")
        arms = scenes.setdefault(None if scene is None else str(scene), {})
        arms.setdefault(str(run.metadata.get("arm", run.name)), []).append(run)
    names = list(dict.fromkeys(name for arms in scenes.values() for name in arms))
    metrics = metric_names(runs)
    if metric is None:
        judged = [name for name in metrics if higher_is_better(name) is not None]
        metric = next(iter([*judged, *metrics]), KNOWN[0])
    elif metric not in metrics:
        raise ValueError(f"--metric {metric!r}: in no log; there are {', '.join(metrics)}")
    if baseline is None:
        baseline = "mcmc" if "mcmc" in names else names[0]
    elif baseline not in names:
        raise ValueError(f"--baseline {baseline!r}: no such arm; there are {', '.join(names)}")
    order = list(dict.fromkeys([baseline, *names]))
    better = higher_is_better(metric) if higher is None else higher
    if better is None:
        raise ValueError(
            f"--metric {metric!r}: its name does not say which values are better; pass "
            "--better higher or --better lower"
        )
    return [_compare_scene(scene, arms, order, metric, better) for scene, arms in scenes.items()]


def _compare_scene(
    scene: str | None,
    runs: dict[str, list[Run]],
    order: list[str],
    metric: str,
    better: bool,
) -> Comparison:
    everything = [run for arm in runs.values() for run in arm]
    metrics = metric_names(everything)
    logged = dict.fromkeys(name for run in everything for name in run.steps)
    # The mean of a loss over a training says nothing.
    columns = [c for c in logged if c not in NO_NUMBERS and higher_is_better(c) is not False]
    references = runs.get(order[0], [])
    final = _stat(references, metric, _last)
    target = np.nan if final is None else final.mean
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
        pairs = [] if name == order[0] else _pairs(own, references)
        reached = [_first_time(run, metric, target, better) for run in own]
        gains = [_gain(run, partners, metric, better) for run, partners in pairs]
        numbers[f"seconds to baseline {metric}"] = Stat.of([t for t in reached if t is not None])
        numbers[f"{metric} gain at equal seconds"] = Stat.of([g for g in gains if g is not None])
        arms.append(Arm(name, own, colour, numbers, len(pairs)))
    return Comparison(scene, metric, better, order[0] if references else None, target, arms)


def metric_names(runs: Sequence[Run]) -> list[str]:
    """Every metric the runs evaluated, PSNR, SSIM and training PSNR first."""
    found = dict.fromkeys(name for run in runs for name in run.evaluations)
    return [name for name in dict.fromkeys([*KNOWN, *found]) if name in found.keys() - NO_NUMBERS]


def _stat(
    runs: list[Run], name: str, of: Callable[[np.ndarray], float], kind: str = "evaluation"
) -> Stat | None:
    """Of what `of` makes of the values of `name`, over the runs that log it."""
    series = [run.series(name, kind)[2] for run in runs]
    return Stat.of([of(values) for values in series if len(values)])


def _finite_mean(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def _curve(run: Run, metric: str, better: bool) -> tuple[np.ndarray, np.ndarray]:
    """(seconds, metric turned so that more is better)."""
    _, seconds, values = run.series(metric)
    return seconds, values if better else -values


def _first_time(run: Run, metric: str, target: float, better: bool) -> float | None:
    """Seconds until the metric first reaches `target`, linear between evaluations."""
    seconds, values = _curve(run, metric, better)
    goal = target if better else -target
    reached = np.flatnonzero(values >= goal)
    if len(reached) == 0:
        return None
    i = int(reached[0])
    if i == 0 or not np.isfinite(values[i - 1 : i + 1]).all():
        return float(seconds[i])
    return float(np.interp(goal, values[i - 1 : i + 1], seconds[i - 1 : i + 1]))


def _pairs(runs: list[Run], references: list[Run]) -> list[tuple[Run, list[Run]]]:
    """Each run that has a seed of the reference's runs, and those of them with that seed."""
    by_seed: dict[str, list[Run]] = {}
    for run in references:
        if (seed := run.metadata.get("seed")) is not None:
            by_seed.setdefault(str(seed), []).append(run)
    return [(r, by_seed[s]) for r in runs if (s := str(r.metadata.get("seed"))) in by_seed]


def _gain(run: Run, partners: list[Run], metric: str, better: bool) -> float | None:
    """The mean difference to the partners, each at the smaller of the two final times, or None."""
    ours, gains = _curve(run, metric, better), []
    for partner in partners:
        theirs = _curve(partner, metric, better)
        if len(ours[0]) == 0 or len(theirs[0]) == 0:
            continue
        time = min(ours[0][-1], theirs[0][-1])
        if time >= max(ours[0][0], theirs[0][0]):
            gains.append(float(np.interp(time, *ours) - np.interp(time, *theirs)))
    return float(np.mean(gains)) if gains else None
