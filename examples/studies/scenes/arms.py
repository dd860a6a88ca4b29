"""The arms of the study: every way of training that is compared, in one list.

To add an arm, add it to `LIST`: its name, what it is, and the parts of the package that the
trainer's optimizers get. `mcmc` is what it is measured against, unless `control` names another arm.
Every arm that ends with the training's own last step can also be trained as `NAME+averaged`: its
last thirtieth again, with the iterates averaged.

An arm whose question is answered is taken out of this list and into `docs/results/study/arms.csv`:
its records and its line in the tables stay, its code goes.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

from splatting.arms import Arm, MakeParts, constant
from torch import Tensor

from opt3dgs_optim import (
    Annealing,
    Averaging,
    ConstantMultiplier,
    Fading,
    OutOfView,
    OwnFrame,
    Part,
    PhaseScheduler,
    paper_parts,
)
from studies.scenes.records import FOLDER

BASELINE, ADAPTIVE = "mcmc", "adc"
AVERAGED = "+averaged"
LAST_THIRTIETH = 29 / 30
DEFAULTS = f"faded{AVERAGED}"  # the arm that `PhaseScheduler(total_steps)` is
OTHERS = ("scales", "quats", "opacities", "sh0", "shN")  # than the positions
BUT_SCALES = ("quats", "opacities", "sh0", "shN")
# As measured, so that a change of the package's defaults does not change what an arm was.
FADING = Fading(share=0.2, exp_avg=0.2, exp_avg_sq=0.04, events=300)
FADING_OTHERS = replace(FADING, names=OTHERS)
ANNEALING_BUT_SCALES = Annealing(4.0, 0.4, 1.0, names=BUT_SCALES)
OWN_FRAME, OWN = "frame-0.1-not-thin", OwnFrame(0.1, final=0.01, min_aspect=0.1)
OWN_FRAME_ARM = f"{OWN_FRAME}+faded{AVERAGED}"  # what the defaults would be with `OwnFrame`
FADING_BUT_SCALES = replace(FADING, names=("means", *BUT_SCALES))


@dataclass(frozen=True)
class StudyArm(Arm):
    """One way of training, the arm that it is measured against, and where it branches off."""

    control: str = BASELINE
    switch: float = 1.0  # where exploitation starts, as a share of the training
    trunk: str | None = None  # the arm whose training this one goes on from at the switch
    adaptive: bool = False  # gsplat's DefaultStrategy in the place of 3DGS-MCMC's
    archived: bool = False  # its records are kept, its code is not

    @property
    def averages(self) -> str | None:
        """The arm whose last iterates this one averages; None: it is another kind of arm."""
        return self.trunk if self.name.endswith(AVERAGED) else None

    def make(
        self, iterations: int, switch: float, nu: float | None, gaussians: Mapping[str, Tensor]
    ) -> PhaseScheduler:
        """As `Arm.make`; the switch is the arm's own: trunk and branches share `FitOptions`."""
        return super().make(iterations, self.switch, nu, gaussians)


def of(*parts: Part) -> MakeParts:
    """These parts, which learn nothing and may serve several trainings."""
    return lambda _iterations, _nu: [*parts]


def on_positions(factor: float) -> Part:
    """A constant factor on the positions' steps: annealing from that factor to the same."""
    return Annealing(factor, factor, factor, names=("means",))


def adaptive(name: str, what: str, parts: MakeParts | None = None) -> StudyArm:
    """An arm with clone, split, prune and reset in the place of 3DGS-MCMC."""
    return StudyArm(name, what, parts, mcmc=False, control=ADAPTIVE, adaptive=True)


LIST = (
    StudyArm(BASELINE, "3DGS-MCMC as published, torch's Adam"),
    StudyArm("rates-x2", "all steps times 2", of(ConstantMultiplier(2.0))),
    StudyArm("rates-x3", "all steps times 3", of(ConstantMultiplier(3.0))),
    StudyArm("positions-x3", "the positions' steps times 3", of(on_positions(3.0))),
    StudyArm(
        "paper",
        "everything, the paper's settings",
        lambda iterations, _nu: paper_parts(iterations),
        switch=LAST_THIRTIETH,
    ),
    StudyArm("paper-constant", "a constant multiplier, `paper`'s mean", constant, needs="paper"),
    StudyArm("faded", "moments of random points faded", of(FADING)),
    StudyArm(
        OWN_FRAME,
        "own frame, 0.1 of a deviation a step, an axis counts as a tenth of the longest at least",
        of(OWN),
    ),
    StudyArm(
        f"{OWN_FRAME}+faded",
        "as its control, all but the positions faded, points out of view held",
        of(OWN, FADING_OTHERS, OutOfView()),
        control=OWN_FRAME,
    ),
    adaptive(ADAPTIVE, "3DGS with adaptive density control as published, torch's Adam"),
    adaptive(
        "adc+annealed+faded-but-scales",
        "annealed and faded, the positions not annealed, the scales left alone",
        of(ANNEALING_BUT_SCALES, FADING_BUT_SCALES, OutOfView()),
    ),
    adaptive(f"adc+{OWN_FRAME}", "own frame, as without clone and split", of(OWN)),
)
ADAPTIVE_OWN_FRAME = f"adc+{OWN_FRAME}{AVERAGED}"
ADAPTIVE_DEFAULTS = f"adc+annealed+faded-but-scales{AVERAGED}"  # what `DEFAULTS_ADC` is
TRAINED = {arm.name: arm for arm in LIST}


def averaged(arm: StudyArm) -> StudyArm:
    """The arm's branch that averages its last iterates."""
    made = arm.parts or of()
    # Without `OutOfView` in the trunk: it changes no bit where views see much.
    held: list[Part] = [OutOfView()] if arm.name == "faded" else []
    return replace(
        arm,
        name=f"{arm.name}{AVERAGED}",
        what="as its control, and the last 1/30 of the iterates averaged",
        parts=lambda iterations, nu: [*made(iterations, nu), *held, Averaging()],
        control=arm.name,
        switch=LAST_THIRTIETH,
        trunk=arm.name,
    )


@cache
def archive() -> dict[str, StudyArm]:
    """The arms of `arms.csv`; in `NAME@1/30` the number is where it branches off."""
    with (FOLDER / "arms.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        row["arm"]: StudyArm(
            row["arm"],
            row["what"],
            control=row["control"],
            switch=1.0 - 1.0 / _last(row["arm"]) if row["trunk"] else 1.0,
            trunk=row["trunk"] or None,
            archived=True,
        )
        for row in rows
    }


def _last(name: str) -> int:
    """30 of an arm that is another one but for its last thirtieth."""
    return int(name.rpartition("@1/")[2]) if "@1/" in name else 30


def arm_of(name: str) -> StudyArm:
    """The arm of that name, listed, archived, or from records of another study's list."""
    if name in archive():
        return archive()[name]
    base = name.removesuffix(AVERAGED)
    like = ADAPTIVE if base.startswith(ADAPTIVE) else BASELINE
    arm = TRAINED.get(base) or StudyArm(base, control=like, archived=True)
    return arm if base == name else averaged(arm)


def find_study_arm(name: str) -> StudyArm:
    """The arm of that name, to be trained; ValueError that lists the others."""
    arm = arm_of(name)
    if arm.archived or (arm.averages and TRAINED[arm.averages].switch < 1.0):
        what = "archived: its records are kept, its code is not" if name in archive() else "unknown"
        raise ValueError(
            f"arm {name!r} is {what}; there are {', '.join(TRAINED)}, and each +averaged"
        )
    return arm
