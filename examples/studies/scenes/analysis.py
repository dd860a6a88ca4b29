"""Gains at equal seconds, their spread over seeds, and the decision rule."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import astuple, dataclass
from statistics import fmean, stdev
from typing import Literal

import numpy as np

from studies.scenes.arms import BASELINE, STUDY_ARMS
from studies.scenes.records import COSTED, Costs, Record, Setting

Verdict = Literal["pays", "does not pay", "undecided"]
MIN_SEEDS = 3
MIN_SCENES = 5  # all of the study's: a part may help one scene and harm the next


@dataclass(frozen=True)
class Gain:
    """An arm against another one, over the scenes together.

    Every number is a mean over scenes; its spread is the standard deviation of that mean over
    seeds (one number per seed).
    """

    arm: str
    control: str
    scenes: tuple[str, ...]
    seeds: int
    psnr: float  # of the arm after its last iteration, dB
    equal_iterations: float  # dB
    equal_seconds: float  # dB
    spread: float  # of equal_seconds, dB; 0 for one seed
    train: float  # gain on training views after the last iteration, dB
    seconds: float  # of the arm, as a share of the control's
    reach: float | None  # seconds until the control's last PSNR, as a share of the control's

    @property
    def verdict(self) -> Verdict:
        """The decision rule: the mean gain exceeds twice its deviation over the seeds."""
        if self.seeds < MIN_SEEDS or len(self.scenes) < MIN_SCENES:
            return "undecided"
        return "pays" if self.equal_seconds > 2 * self.spread else "does not pay"


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

    def cost(self, setting: Setting, arm: str, control: str = BASELINE) -> float:
        """Seconds of an iteration, as a share of the control's; 1 where not both were measured."""
        where = [getattr(setting, name) for name in COSTED]
        ours, theirs = (
            1.0 if name == BASELINE else self._costs.get((*where, name))
            for name in (STUDY_ARMS[each].averages or each for each in (arm, control))
        )
        return 1.0 if ours is None or theirs is None else ours / theirs

    def all_settings(self) -> list[Setting]:
        """In the order of their fields."""
        return sorted({setting for setting, _ in self._of}, key=astuple)

    def settings(
        self, iterations: int, init: str = "sfm", share: float = 1.0, sh_degree: int = 0
    ) -> list[Setting]:
        """The settings of one kind, one per scene.

        Args:
            share: of the scene's full budget of points.
        """
        budget: dict[str, int] = {}
        for setting, _ in self._of:
            budget[setting.scene] = max(budget.get(setting.scene, 0), setting.points)
        return sorted(
            {
                setting
                for setting, _ in self._of
                if setting.iterations == iterations
                and setting.init == init
                and setting.sh_degree == sh_degree
                and setting.points == round(budget[setting.scene] * share)
            },
            key=lambda setting: setting.scene,
        )

    def runs(self, setting: Setting, arm: str) -> dict[int, Record]:
        """Seed -> record."""
        return self._of.get((setting, arm), {})

    def gain(self, settings: list[Setting], arm: str, control: str | None = None) -> Gain | None:
        """The arm against its control, on the scenes and seeds that have both; None without."""
        control = control or STUDY_ARMS[arm].control
        shared = {
            setting: self.runs(setting, arm).keys() & self.runs(setting, control).keys()
            for setting in settings
        }
        scenes = [setting for setting in settings if shared[setting]]
        if not scenes or arm == control:
            return None
        seeds = sorted(set.intersection(*(set(shared[setting]) for setting in scenes)))
        if not seeds:
            return None
        pairs = {
            seed: [(self.runs(s, arm)[seed], self.runs(s, control)[seed]) for s in scenes]
            for seed in seeds
        }
        by_seed = [fmean(_gain_at_seconds(a, b) for a, b in pairs[seed]) for seed in seeds]
        every = [pair for seed in seeds for pair in pairs[seed]]
        reach = [_reach(a, b) for a, b in every]
        reached = [share for share in reach if share is not None]
        return Gain(
            arm,
            control,
            tuple(setting.scene for setting in scenes),
            len(seeds),
            fmean(a.final for a, _ in every),
            fmean(a.final - b.final for a, b in every),
            fmean(by_seed),
            stdev(by_seed) if len(by_seed) > 1 else 0.0,
            fmean(float(a.curve["train_psnr"][-1] - b.curve["train_psnr"][-1]) for a, b in every),
            fmean(a.seconds / b.seconds for a, b in every),
            fmean(reached) if len(reached) == len(reach) else None,
        )

    def gains(self, settings: list[Setting], arms: Iterable[str]) -> list[Gain]:
        """The gains that exist, in the order of `arms`."""
        found = (self.gain(settings, arm) for arm in arms)
        return [gain for gain in found if gain is not None]


def _gain_at_seconds(record: Record, control: Record) -> float:
    """PSNR at the control's last second, or at the record's own last one if that is earlier."""
    return record.at_seconds(control.seconds) - control.final


def _reach(record: Record, control: Record) -> float | None:
    seconds = record.reached(control.final, "seconds")
    return None if seconds is None else seconds / control.seconds


def falls(values: np.ndarray) -> np.ndarray:
    """How far each value is below the best so far, of those of a training in their order."""
    return np.maximum.accumulate(values) - values
