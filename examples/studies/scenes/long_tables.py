"""Tables of the trainings whose held-out views rotate with the seed: three metrics side by side."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import fmean, stdev

from studies.scenes.analysis import Study
from studies.scenes.arms import BASELINE, STUDY_ARMS, label
from studies.scenes.records import Record, Setting

METRICS = {"psnr": (1.0, 2), "ssim": (1.0, 4), "lpips": (-1.0, 4)}  # sign of better, digits
MIN_PAIRS = 3  # of scene and seed, for a spread that means something


@dataclass(frozen=True)
class Difference:
    """An arm less its control, training by training: the same scene, seed and held-out views."""

    arm: str
    control: str
    pairs: dict[str, list[tuple[Record, Record]]]  # scene -> by seed

    @property
    def count(self) -> int:
        """Pairs of trainings."""
        return sum(map(len, self.pairs.values()))

    def of(self, metric: str, equal_seconds: bool = True) -> tuple[float, float]:
        """Mean over the scenes, and its standard error over all pairs; (nan, nan) without any.

        Args:
            metric: a key of `METRICS`.
            equal_seconds: compare when the first of the two has finished, in CPU seconds; else
                after the last iteration.
        """
        by_scene = [
            [_gain(a, b, metric, equal_seconds) for a, b in pairs] for pairs in self.pairs.values()
        ]
        every = [value for values in by_scene for value in values]
        if not every:
            return float("nan"), float("nan")
        mean = fmean(map(fmean, by_scene))
        spread = stdev(every) / len(every) ** 0.5 if len(every) > 1 else float("nan")
        return mean, spread

    @property
    def seconds(self) -> float:
        """The arm's, as a share of the control's."""
        return fmean(a.seconds / b.seconds for pairs in self.pairs.values() for a, b in pairs)

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


def _gain(arm: Record, control: Record, metric: str, equal_seconds: bool) -> float:
    at = min(arm.seconds, control.seconds) if equal_seconds else float("inf")
    return arm.at_seconds(at, metric) - control.at_seconds(at, metric)


def difference(
    study: Study, settings: Iterable[Setting], arm: str, control: str | None = None
) -> Difference:
    """The arm against its control on all scenes and seeds that have both."""
    control = control or STUDY_ARMS[arm].control
    pairs = {}
    for setting in settings:
        ours, theirs = study.runs(setting, arm), study.runs(setting, control)
        shared = sorted(ours.keys() & theirs.keys())
        if shared:
            pairs[setting.scene] = [(ours[seed], theirs[seed]) for seed in shared]
    return Difference(arm, control, pairs)


def differences_table(study: Study, settings: Sequence[Setting], arms: Iterable[str]) -> str:
    """One line per arm that has been trained: what it gains over its control."""
    lines = [
        "| arm | against | scenes, trainings | PSNR | SSIM | LPIPS | seconds | by the rule |",
        "|---|---|---|---:|---:|---:|---:|---|",
    ]
    for arm in arms:
        found = difference(study, settings, arm)
        if not found.count or found.arm == found.control:
            continue
        lines.append(
            f"| `{label(arm)}` | `{label(found.control)}` | {len(found.pairs)}, {found.count} "
            f"| {' | '.join(cells_of(found))} | x{found.seconds:.2f} | {found.verdict} |"
        )
    return "\n".join(lines)


def cells_of(found: Difference) -> list[str]:
    """What is gained in the three metrics when the first of the two has finished."""
    return [_signed(*found.of(metric), digits) for metric, (_, digits) in METRICS.items()]


def metrics_table(study: Study, settings: Sequence[Setting], arms: Iterable[str]) -> str:
    """PSNR / SSIM / LPIPS of every arm on every scene, means over the seeds."""
    lines = [
        f"| arm | {' | '.join(setting.scene for setting in settings)} |",
        f"|---|{'---|' * len(settings)}",
    ]
    for arm in arms:
        cells = [_cell(list(study.runs(setting, arm).values())) for setting in settings]
        if any(cell != "-" for cell in cells):
            lines.append(f"| `{label(arm)}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def reach_table(study: Study, long: Sequence[Setting], arms: Sequence[str], short: int) -> str:
    """When an arm has the PSNR that stock has after its last iteration, as a share of its seconds.

    Args:
        short: iterations of the trainings that were that long from their start, whose last PSNR
            stands beside.
    """
    lines = [
        f"| scene | stock, {long[0].iterations:,} iterations | arm | reaches stock's PSNR after "
        f"| trained for {short:,} iterations only |",
        "|---|---|---|---|---|",
    ]
    for setting in long:
        stock = study.runs(setting, BASELINE)
        quick = [s for s in study.all_settings() if s == _of_length(setting, short)]
        for arm in arms:
            ours = study.runs(setting, arm)
            seeds = sorted(stock.keys() & ours.keys())
            if not seeds:
                continue
            shares = [ours[s].seconds_to(stock[s].final) for s in seeds]
            reached = [
                share / stock[s].seconds
                for s, share in zip(seeds, shares, strict=True)
                if share is not None
            ]
            said = (
                f"x{fmean(reached):.2f} of its seconds" if len(reached) == len(seeds) else "never"
            )
            beside = "-"
            brief = study.runs(quick[0], arm) if quick else {}
            both = sorted(brief.keys() & stock.keys())
            if both:
                gain = fmean(brief[s].final - stock[s].final for s in both)
                share = fmean(brief[s].seconds / stock[s].seconds for s in both)
                beside = f"{gain:+.2f} dB in x{share:.2f} of its seconds"
            final = fmean(stock[s].final for s in seeds)
            row = f"| {setting.scene} | {final:.2f} dB, {len(seeds)} seeds | `{label(arm)}`"
            lines.append(f"{row} | {said} | {beside} |")
    return "\n".join(lines)


def _of_length(setting: Setting, iterations: int) -> Setting:
    return replace(setting, iterations=iterations)


def _cell(records: Sequence[Record]) -> str:
    if not records:
        return "-"
    values = [fmean(float(r.curve[m][-1]) for r in records) for m in METRICS]
    psnr, ssim, lpips = values
    seeds = f" ({len(records)} seeds)" if len(records) > 1 else ""
    return f"{psnr:.2f} / {ssim:.3f} / {lpips:.3f}{seeds}"


def _signed(mean: float, spread: float, digits: int) -> str:
    around = "" if math.isnan(spread) else f" ± {spread:.{digits}f}"
    return f"{mean:+.{digits}f}{around}"
