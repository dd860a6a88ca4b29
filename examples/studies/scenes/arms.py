"""The arms of the study: `arms.csv` lists them all, those that can still be trained have code here.

An arm without code is retired: its question is answered, and its records stay.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from splatting.arms import Arm, MakeParts, constant, fixed, histogram
from torch import Tensor

from opt3dgs_optim import (
    Annealing,
    Averaging,
    ConstantMultiplier,
    Curvature,
    Fading,
    FreshMoments,
    OutOfView,
    Part,
    Phase,
    PhaseScheduler,
    SquaredLoss,
    paper_parts,
)
from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.presets import PAPER_WARMUP
from studies.scenes.parts.exploring import NuOfNoise, NuPerPoint, RestartedHistogram, ViewHistogram
from studies.scenes.parts.own_step import OwnStep
from studies.scenes.parts.pooling import Pooling
from studies.scenes.parts.share_kept import ShareKept

BASELINE = "mcmc"
FADED = "faded"  # fading alone
BOTH = "annealed-all-but-means+faded"  # the defaults until iterates were averaged
BOTH_AVERAGED = f"{BOTH}+averaged"
DEFAULTS = f"{FADED}+averaged"  # what `PhaseScheduler(total_steps)` is
STOCK_AVERAGED = "averaged@1/30"
EARLY = (f"{FADED}-to-1/4", f"{BOTH}-to-1/4")  # fading ends after that share of the run
ANNEALED = "annealed-4-opacities-1+faded"  # the defaults until the views rotated
SHORT_LABEL = "annealed-all"
POOLED = f"{FADED}+pooled"
POOLED_AVERAGED = f"{POOLED}+averaged"  # the defaults, pooled
UNHELD = f"{BOTH}-without-out-of-view"
HELD = f"{FADED}+out-of-view"  # where views see little; elsewhere it is `FADED`, bit for bit
STABLE = "awsgld-stable"  # its histogram follows the energy; that of the arms before it did not
# Where points are many, fading kills a great part of them again and again: what may spare them.
UNFADED = {name: f"{BOTH}-{name}-unfaded" for name in ("means", "opacities")}
SHARE_KEPT = f"{BOTH}-share-kept"  # the defaults before Fading counted the points
SMALLER_SHARE = f"{BOTH}-smaller-share"  # retired: how it counted them first
SCALES_ALONE = f"{BOTH}-scales-alone"
OWN_STEP = "own-step+faded"
SELDOM_FADED = f"{BOTH}-100-events"
MORE_AT_ONCE = f"{BOTH}-150-events-of-two-fifths"
OFTEN_FADED = f"{BOTH}-600-events"

# As measured, so that a change of the package's defaults does not change what an arm was.
ANNEALING = Annealing(4.0, 0.4, 1.0, names=("scales", "quats", "opacities", "sh0", "shN"))
ANNEALING_BUT_OPACITIES = Annealing(4.0, 0.4, 1.0, names=("scales", "quats", "sh0", "shN"))
ANNEALING_OF_ALL = Annealing(4.0, 0.4, 1.0, GAUSSIAN)
FADING = Fading(share=0.2, exp_avg=0.2, exp_avg_sq=0.04, events=300)
FADED_BUT_SCALES = (
    replace(FADING, names=("means", "quats", "opacities", "sh0", "shN")),
    OutOfView(),
)
BUT_SCALES = (
    Annealing(4.0, 0.4, 1.0, names=("quats", "opacities", "sh0", "shN")),
    *FADED_BUT_SCALES,
)
FADING_EARLY = Fading(share=0.2, exp_avg=0.2, exp_avg_sq=0.04, events=140, stop=0.25)


@dataclass(frozen=True)
class StudyArm(Arm):
    """One way of training, the arm that it is measured against, and where it branches off."""

    control: str = BASELINE
    switch: float = 1.0  # where exploitation starts
    trunk: str | None = None  # branch off this arm's run at the switch
    adaptive: bool = False  # gsplat's DefaultStrategy in the place of 3DGS-MCMC's
    retired: bool = False  # its code is gone, its records are kept

    @property
    def averages(self) -> str | None:
        """The arm whose last iterates this one averages; None: it is another kind of arm."""
        return self.trunk if self.name.split("@")[0].endswith("averaged") else None

    def make(
        self, iterations: int, switch: float, nu: float | None, gaussians: Mapping[str, Tensor]
    ) -> PhaseScheduler:
        """As `Arm.make`; the switch is the arm's own: trunk and branches share `FitOptions`."""
        return super().make(iterations, self.switch, nu, gaussians)


def of(*parts: Part) -> MakeParts:
    """These parts, which learn nothing."""
    return lambda _iterations, _nu: [*parts]


def with_fading(fading: Part, *others: Part) -> MakeParts:
    """The defaults with this fading, and with others beside it."""
    return of(ANNEALING, fading, OutOfView(), *others)


def whole_trainings() -> dict[str, MakeParts | None]:
    """The parts of the arms that differ by nothing else."""
    faded_but = {
        name: ShareKept(events=300, names=tuple(other for other in GAUSSIAN if other != left))
        for left, name in UNFADED.items()
    }
    return {
        BASELINE: None,
        STABLE: histogram,
        **{f"rates-x{k:g}": of(ConstantMultiplier(k)) for k in (1.5, 2.0, 3.0)},
        "annealed-8-0.4": of(Annealing(8.0, 0.4, 8.0, GAUSSIAN)),
        FADED: of(FADING),
        ANNEALED: of(ANNEALING_OF_ALL, FADING),
        BOTH: with_fading(FADING),
        UNHELD: of(ANNEALING, FADING),
        POOLED: of(FADING, OutOfView(), Pooling()),
        EARLY[0]: of(FADING_EARLY),
        EARLY[1]: with_fading(FADING_EARLY),
        **{name: with_fading(fading) for name, fading in faded_but.items()},
        SHARE_KEPT: with_fading(ShareKept(events=300)),
        SELDOM_FADED: with_fading(ShareKept(events=100)),
        MORE_AT_ONCE: with_fading(replace(FADING, share=0.4, events=150)),
        OFTEN_FADED: with_fading(replace(FADING, events=600)),
        SCALES_ALONE: of(*BUT_SCALES),
        "own-step": fixed(OwnStep),
        OWN_STEP: lambda _iterations, _nu: [OwnStep(), FADING],
        "out-of-view": of(OutOfView()),
        HELD: of(FADING, OutOfView()),
        "nu-per-view": lambda iterations, _nu: [ViewHistogram(_warmup(iterations))],
        "nu-per-point": fixed(NuPerPoint),
        "nu-restarted": lambda iterations, _nu: [RestartedHistogram(_warmup(iterations))],
        "nu-of-noise": lambda iterations, _nu: [NuOfNoise(_warmup(iterations))],
    }


def _warmup(iterations: int) -> int:
    return max(4, round(iterations * PAPER_WARMUP))


def last_phases() -> list[StudyArm]:
    """What changes at the switch, branched off one and the same exploration."""
    kinds = {
        "l1+reset": fixed(FreshMoments),
        "l2": fixed(SquaredLoss),
        "l2+reset": fixed(SquaredLoss, FreshMoments),
        "l2+reset+lqn": fixed(SquaredLoss, FreshMoments, Curvature),
        "l1+reset+lqn": fixed(FreshMoments, Curvature),
        "l1+reset+lqn-all": fixed(FreshMoments, partial(Curvature, names=None)),
        "noise-off": fixed(),
    }
    return [
        StudyArm(
            f"{name}@1/{share}",
            parts=parts,
            switch=1 - 1 / share,
            trunk=BASELINE,
            noise_during=Phase.EXPLORATION if name == "noise-off" else None,
        )
        for share in (30, 10, 4, 2)
        for name, parts in kinds.items()
    ]


def adaptive() -> list[StudyArm]:
    """Clone, split and reset instead of 3DGS-MCMC."""
    kinds = {
        "": None,
        "+faded": of(FADING),
        "+faded-but-scales": of(*FADED_BUT_SCALES),
        "+annealed": of(ANNEALING),
        "+annealed-but-opacities": of(ANNEALING_BUT_OPACITIES),
        "+defaults": with_fading(FADING),
        "+defaults-but-scales": of(*BUT_SCALES),
    }
    return [
        StudyArm(f"adc{kind}", parts=parts, mcmc=False, adaptive=True)
        for kind, parts in kinds.items()
    ]


def averaged() -> list[StudyArm]:
    """The mean of the last iterates; each branches off the same without it."""
    trunks = {
        STOCK_AVERAGED: (BASELINE, ()),
        # As was trained without `OutOfView`, which changes no bit of whole views.
        DEFAULTS: (FADED, (FADING, OutOfView())),
        f"{HELD}+averaged": (HELD, (FADING, OutOfView())),
        BOTH_AVERAGED: (BOTH, (ANNEALING, FADING, OutOfView())),
        POOLED_AVERAGED: (POOLED, (FADING, OutOfView(), Pooling())),
        "adc+averaged": ("adc", ()),
        "adc+faded-but-scales+averaged": ("adc+faded-but-scales", FADED_BUT_SCALES),
        "adc+defaults-but-scales+averaged": ("adc+defaults-but-scales", BUT_SCALES),
    }
    return [
        StudyArm(
            name,
            parts=of(*parts, Averaging()),
            mcmc=not name.startswith("adc"),
            adaptive=name.startswith("adc"),
            switch=29 / 30,
            trunk=trunk,
        )
        for name, (trunk, parts) in trunks.items()
    ]


def groups() -> dict[str, list[StudyArm]]:
    """All arms as `arms.csv` has them, in its order."""
    paper = StudyArm("paper", parts=lambda iterations, _nu: paper_parts(iterations), switch=29 / 30)
    coded = [
        *(StudyArm(name, parts=parts) for name, parts in whole_trainings().items()),
        paper,
        *(StudyArm(f"{n}-constant", parts=constant, needs=n) for n in (STABLE, paper.name)),
        *last_phases(),
        *adaptive(),
        *averaged(),
    ]
    trained = {arm.name: arm for arm in coded}
    made: dict[str, list[StudyArm]] = {}
    with Path(__file__).with_name("arms.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            arm = trained.get(row["arm"]) or StudyArm(row["arm"], retired=True)
            said = replace(arm, what=row["what"], control=row["control"])
            made.setdefault(row["group"], []).append(said)
    return made


GROUPS = groups()
STUDY_ARMS = {arm.name: arm for arms in GROUPS.values() for arm in arms}


def find_study_arm(name: str) -> StudyArm:
    """The arm of that name, to be trained; ValueError that lists the others."""
    found = STUDY_ARMS.get(name)
    if found is None or found.retired:
        what = "unknown" if found is None else "retired: its records are kept, its code is not"
        left = ", ".join(arm.name for arm in STUDY_ARMS.values() if not arm.retired)
        raise ValueError(f"arm {name!r} is {what}; there are {left}")
    return found


def label(arm: str) -> str:
    """An arm's name in tables and plots, where the one in the records is long or out of date."""
    if arm.startswith(BOTH):
        return "annealed" + arm.removeprefix(BOTH)
    arm = arm.replace("adc+defaults", "adc+annealed+faded")
    arm = arm.replace("1.5.3+defaults", "1.5.3+annealed+faded")
    return re.sub("^defaults", SHORT_LABEL, arm.replace(ANNEALED, SHORT_LABEL))
