"""The trainings by setting, arm and seed; and what one arm gains over another at equal seconds."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from statistics import fmean, stdev

import numpy as np

from studies.scenes.arms import BASELINE, arm_of
from studies.scenes.records import COSTED, MISPOSED, RIGHT, Costs, Record, Setting

METRICS = {"psnr": (1.0, 2), "ssim": (1.0, 4), "lpips": (-1.0, 4)}  # sign of better, digits
MIN_PAIRS = 3  # of scene and seed, for a spread that means something


class Study:
    """The records, by setting, arm and seed; and what an iteration costs, where measured."""

    def __init__(self, records: Iterable[Record], costs: Costs | None = None) -> None:
        self._costs = costs or {}
        self._of: dict[tuple[Setting, str], dict[int, Record]] = defaultdict(dict)
        for record in records:
            self._of[record.setting, record.arm][record.seed] = record

    def records(self) -> list[Record]:
        """All of them."""
        return [record for runs in self._of.values() for record in runs.values()]

    def settings(self) -> list[Setting]:
        """In the order of their fields."""
        return sorted({setting for setting, _ in self._of})

    def arms(self, settings: Iterable[Setting]) -> list[str]:
        """Those with trainings in any of these settings: stock, today's list, the archive."""
        chosen = set(settings)
        found = {arm for setting, arm in self._of if setting in chosen}
        return sorted(found, key=lambda arm: (arm != BASELINE, arm_of(arm).archived, arm))

    def runs(self, setting: Setting, arm: str) -> dict[int, Record]:
        """Seed -> record."""
        return self._of.get((setting, arm), {})

    def cost(self, setting: Setting, arm: str, control: str = BASELINE) -> float:
        """Seconds of an iteration, as a share of the control's; 1 where not both were measured."""
        return self.measured_cost(setting, arm, control) or 1.0

    def measured_cost(self, setting: Setting, arm: str, control: str = BASELINE) -> float | None:
        """As `cost`; None where not both were measured."""
        names = [arm_of(each).averages or each for each in (arm, control)]
        if names[0] == names[1]:
            return 1.0
        where = [getattr(setting, name) for name in COSTED]
        ours, theirs = (
            1.0 if name == BASELINE else self._costs.get((*where, name)) for name in names
        )
        return None if ours is None or theirs is None else ours / theirs


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
        arm, control = arm_of(self.arm), arm_of(self.control)
        return arm.switch if control.needs == self.arm else 1.0

    def of(self, metric: str) -> tuple[float, float]:
        """Gain at equal seconds: mean over the scenes, and its standard error over all pairs.

        `metric` is a key of `METRICS`; (nan, nan) without any pair, or where it was not recorded.
        """
        by_scene = [
            [_gain(*pair, metric, self.until) for pair in pairs] for pairs in self.pairs.values()
        ]
        every = [value for values in by_scene for value in values]
        if not every or np.isnan(every).any():
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

    Bonsai with wrong poses counts only where nothing was trained with the right ones. A branch
    whose trunk was trained again since is not compared with the trunk of now.
    """
    control = control or arm_of(arm).control
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
    if RIGHT in pairs:
        pairs.pop(MISPOSED, None)
    return Difference(arm, control, pairs)


def same_start(one: Record, other: Record) -> bool:
    """Whether two trainings are the same up to where the first of them branches off their trunk.

    True where they have no trunk in common. Trained on another machine the same seed ends up to
    .2 dB elsewhere, more than most last phases change.
    """
    arms = arm_of(one.arm), arm_of(other.arm)
    if len({arm.trunk or arm.name for arm in arms}) > 1:
        return True
    until = min(arm.switch for arm in arms) * one.setting.iterations
    first, second = (r.curve["psnr"][r.curve["iteration"] <= until] for r in (one, other))
    return np.array_equal(first, second)


def _at_any_length(study: Study, record: Record) -> Record:
    """Of an arm that averages in the end, the ends of trainings that are a little shorter.

    What the mean adds in the end is taken to be what it would have added there.
    """
    trunk = arm_of(record.arm).averages
    without = study.runs(record.setting, trunk).get(record.seed) if trunk else None
    if without is None:
        return record
    ends = {m: without.curve[m] + (record.curve[m][-1] - without.curve[m][-1]) for m in METRICS}
    return replace(record, curve=record.curve | ends)
