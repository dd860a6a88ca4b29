"""Tables of the trainings whose held-out views rotate with the seed: three metrics side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, stdev

import numpy as np

from studies.pages import table
from studies.scenes.analysis import Study, falls
from studies.scenes.arms import BASELINE, DEFAULTS, STUDY_ARMS, label
from studies.scenes.records import Record, Setting

METRICS = {"psnr": (1.0, 2), "ssim": (1.0, 4), "lpips": (-1.0, 4)}  # sign of better, digits
SIZES = {"images_4": "quarter", "images_2": "half"}
MIN_ARMS = 3  # in a line of a table that compares them
MIN_PAIRS = 3  # of scene and seed, for a spread that means something


@dataclass(frozen=True)
class Difference:
    """An arm less its control, training by training: the same scene, seed and held-out views.

    A multiplier and a constant of its mean are compared where the arm's exploitation begins.
    Equal seconds are equal costs: of an iteration's cost, measured in turns (`costs.py`), since
    the trainings' own clocks ran at different hours beside different work. An arm whose
    iterations cost 5 % more is looked at after 1/1.05 of them. Where the cost was not measured it
    counts as the control's.
    """

    arm: str
    control: str
    pairs: dict[str, list[tuple[Record, Record, float]]]  # scene -> by seed; and the arm's cost

    @property
    def count(self) -> int:
        """Pairs of trainings."""
        return sum(map(len, self.pairs.values()))

    @property
    def until(self) -> float:
        """The share of the run after which they are compared."""
        arm, control = STUDY_ARMS[self.arm], STUDY_ARMS[self.control]
        return arm.switch if control.needs == self.arm else 1.0

    def of(self, metric: str) -> tuple[float, float]:
        """Gain at equal seconds: mean over the scenes, and its standard error over all pairs.

        `metric` is a key of `METRICS`; (nan, nan) without any pair.
        """
        by_scene = [
            [_gain(*pair, metric, self.until) for pair in pairs] for pairs in self.pairs.values()
        ]
        every = [value for values in by_scene for value in values]
        if not every:
            return float("nan"), float("nan")
        mean = fmean(map(fmean, by_scene))
        spread = stdev(every) / len(every) ** 0.5 if len(every) > 1 else float("nan")
        return mean, spread

    @property
    def cost(self) -> float:
        """Seconds of an iteration, as a share of the control's."""
        return fmean(cost for pairs in self.pairs.values() for _, _, cost in pairs)

    @property
    def verdict(self) -> str:
        """By the rule: one of the three metrics gains, and none loses, by twice its spread."""
        if self.count < MIN_PAIRS:
            return "too few"
        better, worse = [], []
        for metric, (sign, _) in METRICS.items():
            mean, spread = self.of(metric)
            better += [metric] * (sign * mean > 2 * spread)
            worse += [metric] * (sign * mean < -2 * spread)
        if worse:
            return f"loses {', '.join(m.upper() for m in worse)}"
        return "pays" if better else "no difference"


def _gain(arm: Record, control: Record, cost: float, metric: str, until: float) -> float:
    total = until * arm.setting.iterations
    ours = arm.at_iteration(total * min(1.0, 1.0 / cost), metric)
    return ours - control.at_iteration(total * min(1.0, cost), metric)


def difference(
    study: Study, settings: Iterable[Setting], arm: str, control: str | None = None
) -> Difference:
    """The arm against its control on all scenes and seeds that have both.

    A branch whose trunk was trained again since is not compared with the trunk of now.
    """
    control = control or STUDY_ARMS[arm].control
    pairs = {}
    for setting in settings:
        ours, theirs = study.runs(setting, arm), study.runs(setting, control)
        both = sorted(ours.keys() & theirs.keys())
        shared = [seed for seed in both if same_start(ours[seed], theirs[seed])]
        if shared:
            cost = study.cost(setting, arm, control)
            pairs[setting.scene] = [
                (_at_any_length(study, ours[seed]), _at_any_length(study, theirs[seed]), cost)
                for seed in shared
            ]
    return Difference(arm, control, pairs)


def same_start(one: Record, other: Record) -> bool:
    """Whether two trainings are the same up to where the first of them branches off their trunk.

    True where they have no trunk in common. Trained on another machine the same seed ends up to
    .2 dB elsewhere, more than most last phases change.
    """
    arms = STUDY_ARMS[one.arm], STUDY_ARMS[other.arm]
    if len({arm.trunk or arm.name for arm in arms}) > 1:
        return True
    until = min(arm.switch for arm in arms) * one.setting.iterations
    first, second = (r.curve["psnr"][r.curve["iteration"] <= until] for r in (one, other))
    return np.array_equal(first, second)


def _at_any_length(study: Study, record: Record) -> Record:
    """Of an arm that averages in the end, the ends of trainings that are a little shorter.

    What the mean adds in the end is taken to be what it would have added there.
    """
    trunk = STUDY_ARMS[record.arm].averages
    without = study.runs(record.setting, trunk).get(record.seed) if trunk else None
    if without is None:
        return record
    ends = {m: without.curve[m] + (record.curve[m][-1] - without.curve[m][-1]) for m in METRICS}
    return replace(record, curve=record.curve | ends)


def differences_table(study: Study, settings: Sequence[Setting], arms: Iterable[str]) -> str:
    """One line per arm that has been trained: what it gains over its control."""
    rows = []
    for found in (difference(study, settings, arm) for arm in arms):
        if found.count and found.arm != found.control:
            names = f"`{label(found.arm)}`", f"`{label(found.control)}`"
            counts = f"{len(found.pairs)}, {found.count}"
            rows.append((*names, counts, *cells_of(found), f"x{found.cost:.2f}", found.verdict))
    heads = ("arm", "against", "scenes, trainings", "PSNR", "SSIM", "LPIPS", "cost", "by the rule")
    return table(heads, "lllrrrrl", rows)


def cells_of(found: Difference) -> list[str]:
    """What is gained in the three metrics when the first of the two has finished."""
    return [_signed(*found.of(metric), digits) for metric, (_, digits) in METRICS.items()]


def metrics_table(
    study: Study,
    settings: Sequence[Setting],
    arms: Iterable[str],
    *,
    head: Callable[[Setting], str] = lambda setting: setting.scene,
    seed: int | None = None,
) -> str:
    """PSNR / SSIM / LPIPS of every arm in every setting.

    Args:
        head: what stands above a setting's column.
        seed: of this one, with the last number of Gaussians, which differs; None: means over all.
    """
    rows = []
    for arm in arms:
        runs = [study.runs(setting, arm) for setting in settings]
        found = [[r for key, r in by_seed.items() if seed in (None, key)] for by_seed in runs]
        if any(found):
            cells = [_cell(records, gaussians=seed is not None) for records in found]
            rows.append((f"`{label(arm)}`", *cells))
    return table(["arm", *map(head, settings)], "l", rows)


def headline_table(study: Study, long: Sequence[Setting], short: int) -> str:
    """Stock beside the defaults at both lengths: what a reader sees first.

    Means over the seeds that all of a scene's trainings have, since a seed has held-out views of
    its own.
    """
    lengths = (long[0].iterations, short) if long else ()
    whats = {"stock": BASELINE, "**defaults**": DEFAULTS}
    columns: list[list[str]] = []
    for setting in long:
        of = [
            study.runs(replace(setting, iterations=count), arm)
            for count in lengths
            for arm in whats.values()
        ]
        shared = set.intersection(*map(set, of))
        columns.append([_cell([runs[seed] for seed in shared], seeds=False) for runs in of])
    heads = [f"{what}, {count:,}" for count in lengths for what in whats]
    rows = list(zip(heads, *columns, strict=True))
    return table(["iterations", *(setting.scene for setting in long)], "l", rows)


def scenes_gain_table(study: Study, settings: Sequence[Setting], arm: str, control: str) -> str:
    """One line per scene and size: control and arm at their ends, and the gain at equal seconds.

    All over the seeds that both have.
    """
    rows = []
    for setting in settings:
        found = difference(study, [setting], arm, control)
        for pairs in found.pairs.values():
            stock, ours = _cell([b for _, b, _ in pairs]), _cell([a for a, _, _ in pairs])
            rows.append((setting.scene, _crowd(setting), stock, ours, cells_of(found)[0]))
    names = f"`{label(control)}`", f"`{label(arm)}`"
    return table(("scene", "Gaussians, images", *names, "gain, dB"), "llllr", rows)


def sizes_table(study: Study, settings: Sequence[Setting], arms: Sequence[str]) -> str:
    """One line per scene, points, size and length with three of the arms: seed 0."""
    rows = []
    for setting in settings:
        runs = [study.runs(setting, arm) for arm in arms]
        found = [[seeds[0]] if 0 in seeds else [] for seeds in runs]
        if sum(map(len, found)) >= MIN_ARMS:
            what = f"{_crowd(setting)}, {setting.iterations:,}"
            rows.append((setting.scene, what, *map(_cell, found)))
    heads = ("scene", "Gaussians, images, iterations", *(f"`{label(arm)}`" for arm in arms))
    return table(heads, "l", rows)


def averaging_table(study: Study, settings: Sequence[Setting], arms: Sequence[str]) -> str:
    """What the mean of the last iterates adds to the last one of the same trainings."""
    rows = []
    for setting in settings:
        for arm in arms:
            trunk = STUDY_ARMS[arm].averages or arm
            found = difference(study, [setting], arm, trunk)
            if found.count:
                what = f"{_crowd(setting)}, {setting.iterations:,}"
                counts = f"`{label(trunk)}`", str(found.count)
                rows.append((setting.scene, what, *counts, *cells_of(found)))
    heads = ("scene", "Gaussians, images, iterations", "on", "seeds", "PSNR", "SSIM", "LPIPS")
    return table(heads, "lllrrrr", rows)


def falls_table(study: Study, settings: Sequence[Setting], arms: Sequence[str]) -> str:
    """How far the training PSNR was below its best before, at most, over evaluations and seeds."""
    rows = []
    for setting in settings:
        runs = [study.runs(setting, arm).values() for arm in arms]
        found = [[falls(run.curve["train_psnr"]).max() for run in of] for of in runs]
        if any(found[1:]):
            cells = [f"{max(largest):.2f}" if largest else "-" for largest in found]
            rows.append((setting.scene, *cells))
    return table(["scene", *(f"`{label(arm)}`" for arm in arms)], "lr", rows)


def reach_table(study: Study, long: Sequence[Setting], arm: str, shorter: Sequence[int]) -> str:
    """When an arm has the PSNR that stock has after its last iteration, as a share of its seconds.

    Args:
        shorter: lengths of trainings that were that long from their start, whose last PSNR stands
            beside; all at the first length's cost of an iteration.
    """
    total, rows = long[0].iterations if long else 0, []
    for setting in long:
        stock, runs = study.runs(setting, BASELINE), study.runs(setting, arm)
        found = difference(study, [setting], arm, BASELINE)
        for pairs in found.pairs.values():
            # The iterates, of an arm that ends at their mean.
            reached = [runs[ours.seed].reached(theirs.final) for ours, theirs, _ in pairs]
            known = [iteration for iteration in reached if iteration is not None]
            said, beside = "never", []
            if len(known) == len(reached):
                said = f"x{fmean(known) * found.cost / total:.2f} of its seconds"
            cost = study.cost(replace(setting, iterations=shorter[0]), arm)
            for count in shorter:
                quick = study.runs(replace(setting, iterations=count), arm)
                gains = [quick[s].final - stock[s].final for s in quick.keys() & stock.keys()]
                share = count / total * cost
                beside.append(f"{fmean(gains):+.2f} dB in x{share:.2f}" if gains else "-")
            ends = f"{fmean(theirs.final for _, theirs, _ in pairs):.2f} dB ({len(pairs)})"
            rows.append((setting.scene, ends, said, *beside))
    heads = ["scene", f"stock, {total:,} iterations", f"`{label(arm)}` has that PSNR after"]
    return table([*heads, *(f"trained for {n:,} iterations only" for n in shorter)], "l", rows)


def _cell(records: Sequence[Record], *, gaussians: bool = False, seeds: bool = True) -> str:
    if not records:
        return "-"
    values = [fmean(float(r.curve[m][-1]) for r in records) for m in METRICS]
    psnr, ssim, lpips = values
    of = f" ({len(records)} seeds)" if seeds and len(records) > 1 else ""
    count = fmean(float(r.curve["num_points"][-1]) for r in records)
    beside = f", {count:,.0f} Gaussians" if gaussians else ""
    return f"{psnr:.2f} / {ssim:.3f} / {lpips:.3f}{beside}{of}"


def _crowd(setting: Setting) -> str:
    """The most Gaussians, the images' size, and the harmonics' degree."""
    degree = f", degree {setting.sh_degree}" * (setting.sh_degree > 0)
    return f"{setting.points:,}, {SIZES.get(setting.size, setting.size)}{degree}"


def _signed(mean: float, spread: float, digits: int) -> str:
    around = "" if math.isnan(spread) else f" ± {spread:.{digits}f}"
    return f"{mean:+.{digits}f}{around}"
