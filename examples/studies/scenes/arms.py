"""The arms of the study: each part alone, its control, and what goes beyond the paper."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from splatting.arms import Arm, MakeParts, constant, fixed, histogram
from torch import Tensor

from opt3dgs_optim import (
    Annealing,
    ConstantMultiplier,
    Curvature,
    Fading,
    FreshMoments,
    Part,
    Phase,
    PhaseScheduler,
    Pooling,
    SquaredLoss,
    paper_parts,
)
from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.presets import PAPER_WARMUP
from studies.scenes.parts.chosen_fading import ChosenFading
from studies.scenes.parts.exploring import NuOfNoise, NuPerPoint, RestartedHistogram, ViewHistogram
from studies.scenes.parts.keep_unseen import KeepUnseen
from studies.scenes.parts.own_step import OwnStep
from studies.scenes.parts.share_kept import ShareKept

BASELINE = "mcmc"
FADED = "faded"  # fading alone
MEANS_LEFT = "annealed-all-but-means+faded"
DEFAULTS = MEANS_LEFT  # what `PhaseScheduler(total_steps)` is
EARLY = (f"{FADED}-to-1/4", f"{DEFAULTS}-to-1/4")  # fading ends after that share of the run
ALL_ANNEALED = "annealed-4-0.4+faded"
ANNEALED = "annealed-4-opacities-1+faded"  # the defaults until the views rotated
SHORT_LABEL = "annealed+faded"
POOLED = f"{ANNEALED}+pooled"
DEFAULTS_POOLED = f"{DEFAULTS}+pooled"
STABLE = "awsgld-stable"  # its histogram follows the energy; that of the arms before it did not
UNFADED_OPACITIES = f"{ANNEALED}-opacities-unfaded"
V_ONLY = f"{ANNEALED}-v-only"
# Where points are many, fading kills a great part of them again and again: what may spare them.
UNFADED = {name: f"{MEANS_LEFT}-{name}-unfaded" for name in ("means", "opacities")}
SHARE_KEPT = f"{MEANS_LEFT}-share-kept"  # the defaults before Fading counted the points
OWN_STEP = "own-step+faded"
SELDOM_FADED = f"{MEANS_LEFT}-100-events"
GROW_GRAD = 2e-4  # gsplat's own threshold
EVENT_STEPS = 10  # iterations for one event of fading in a run of 3,000, where it was chosen


def annealing(peak: float, final: float, opacity_peak: float = 1.0) -> Annealing:
    """Of all parameters: that the positions are left alone came later."""
    return Annealing(peak, final, opacity_peak, GAUSSIAN)


def fading_but(left: str) -> Fading:
    """Of all parameters but one."""
    return ShareKept(events=300, names=tuple(name for name in GAUSSIAN if name != left))


# As measured, so that a change of the package's defaults does not change what an arm was.
ANNEALING = annealing(4.0, 0.4)
ANNEALING_OF_REST = Annealing(4.0, 0.4, 1.0, names=("scales", "quats", "opacities", "sh0", "shN"))
FADING = Fading(share=0.2, exp_avg=0.2, exp_avg_sq=0.04, events=300)
FADING_EARLY = Fading(share=0.2, exp_avg=0.2, exp_avg_sq=0.04, events=140, stop=0.25)
# What the arms beyond the paper are made of, by the arm's name; what a table calls them; and the
# names of the arms that add a last phase.
TRUNKS: dict[str, list[Part]] = {
    "annealed-8-0.4": [annealing(8.0, 0.4, opacity_peak=8.0)],
    "faded": [FADING],
    ANNEALED: [ANNEALING, FADING],
    POOLED: [ANNEALING, FADING, Pooling()],
}
WORDS = {"annealed-8-0.4": "annealed", "faded": "faded", ANNEALED: "both", POOLED: "pooled"}
LABELS = {"annealed": "annealed-8-0.4", "defaults": ANNEALED, "pooled": POOLED}


@dataclass(frozen=True)
class StudyArm(Arm):
    """One way of training, the arm that it is measured against, and where it branches off."""

    control: str = BASELINE
    switch: float = 1.0  # where exploitation starts
    trunk: str | None = None  # branch off this arm's run at the switch
    # The gradient above which gsplat's DefaultStrategy, in the place of 3DGS-MCMC's, clones and
    # splits; 0: it is not in its place.
    adaptive: float = 0.0
    retired: bool = False  # its code is gone, its records are kept

    def make(
        self, iterations: int, switch: float, nu: float | None, gaussians: Mapping[str, Tensor]
    ) -> PhaseScheduler:
        """As `Arm.make`; the switch is the arm's own: trunk and branches share `FitOptions`."""
        return super().make(iterations, self.switch, nu, gaussians)


def of(*parts: Part) -> MakeParts:
    """These parts, which learn nothing."""
    return lambda _iterations, _nu: [*parts]


def core() -> list[StudyArm]:
    """Whole trainings that only the trainer's learning rates, nu or the moments distinguish."""
    rates = [
        StudyArm(f"rates-x{k:g}", f"all steps times {k:g}", of(ConstantMultiplier(k)))
        for k in (1.5, 2.0, 3.0)
    ]
    annealed = [
        StudyArm(
            f"annealed-{peak:g}-{final:g}",
            f"all steps times {peak:g} falling to {final:g}",
            of(annealing(peak, final, opacity_peak=peak)),
        )
        for peak, final in ((4.0, 0.4), (8.0, 0.4), (8.0, 0.1), (16.0, 0.4))
    ]
    both = of(annealing(4.0, 0.4, opacity_peak=4.0), FADING)
    paper = "a constant multiplier, the paper's mean nu"
    return [
        StudyArm(BASELINE, "stock 3DGS-MCMC, torch's Adam"),
        StudyArm("awsgld", "with the flat-histogram multiplier", retired=True),
        StudyArm("constant", "a constant multiplier, its mean nu", retired=True),
        StudyArm(STABLE, "with the flat-histogram multiplier that follows the energy", histogram),
        StudyArm(
            f"{STABLE}-constant", "a constant multiplier, its mean nu", constant, needs=STABLE
        ),
        *rates,
        *annealed,
        StudyArm("faded", "moments of random points faded", of(FADING)),
        StudyArm(ALL_ANNEALED, "annealed from 4, and faded", both, control="annealed-8-0.4"),
        StudyArm(
            ANNEALED,
            "the same, but opacities annealed from 1",
            of(*TRUNKS[ANNEALED]),
            control=ALL_ANNEALED,
        ),
        StudyArm(
            POOLED,
            "annealed and faded, second moments pooled",
            of(*TRUNKS[POOLED]),
            control=ANNEALED,
        ),
        StudyArm(
            "paper",
            "everything, the paper's settings",
            lambda iterations, _nu: paper_parts(iterations),
            switch=29 / 30,
        ),
        StudyArm("paper-constant", paper, constant, needs="paper"),
    ]


def with_nu() -> list[StudyArm]:
    """The multiplier on top of annealing and fading, beside a constant of its mean; retired."""
    words = ", with a constant multiplier: the next arm's mean nu"
    awsgld = ", with the flat-histogram multiplier"
    pairs = [(f"{trunk}+constant", f"{trunk}+awsgld", trunk) for trunk in list(TRUNKS)[:3]]
    return [
        arm
        for plain, own, trunk in pairs
        for arm in (
            StudyArm(plain, WORDS[trunk] + words, control=trunk, retired=True),
            StudyArm(own, WORDS[trunk] + awsgld, control=plain, retired=True),
        )
    ]


def _on(trunk: str, parts: MakeParts) -> MakeParts:
    return lambda iterations, nu: [*TRUNKS[trunk], *parts(iterations, nu)]


def last_phases() -> list[StudyArm]:
    """What changes at the switch, branched off one and the same exploration."""
    lqn = "the same with L-BFGS directions, consecutive pairs"
    kinds: dict[str, tuple[str, str | None, MakeParts]] = {
        "l1+reset": ("L1, moments reset", None, fixed(FreshMoments)),
        "l2": ("L2, moments kept", None, fixed(SquaredLoss)),
        "l2+reset": ("L2, moments reset", None, fixed(SquaredLoss, FreshMoments)),
        "l2+reset+lqn": (lqn, "l2+reset", fixed(SquaredLoss, FreshMoments, Curvature)),
        "l1+reset+lqn": (
            "L1, moments reset, L-BFGS directions",
            "l1+reset",
            fixed(FreshMoments, Curvature),
        ),
        "l1+reset+lqn-all": (
            "L1, moments reset, L-BFGS directions for all parameters",
            "l1+reset",
            fixed(FreshMoments, partial(Curvature, names=None)),
        ),
        "noise-off": ("no noise", None, fixed()),
    }
    return [
        StudyArm(
            f"{name}@1/{share}",
            f"{what}, in the last 1/{share}",
            parts,
            control=f"{control}@1/{share}" if control else BASELINE,
            switch=1 - 1 / share,
            trunk=BASELINE,
            noise_during=Phase.EXPLORATION if name == "noise-off" else None,
        )
        for share in (30, 10, 4, 2)
        for name, (what, control, parts) in kinds.items()
    ]


def on_top() -> list[StudyArm]:
    """The last phase on top of annealing and fading: does curvature earn its place there?"""
    kinds: dict[str, tuple[str | None, MakeParts]] = {
        "l2": (None, fixed(SquaredLoss)),
        "l1+reset": (None, fixed(FreshMoments)),
        "l1+reset+lqn": ("l1+reset", fixed(FreshMoments, Curvature)),
        "lqn": (None, fixed(Curvature)),
        "noise-off": (None, fixed()),
    }
    return [
        StudyArm(
            f"{label}+{name}@1/10",
            f"{WORDS[trunk]}, then {name} in the last tenth",
            _on(trunk, parts),
            control=f"{label}+{control}@1/10" if control else trunk,
            switch=0.9,
            trunk=trunk,
            noise_during=Phase.EXPLORATION if name == "noise-off" else None,
        )
        for label, trunk in LABELS.items()
        for name, (control, parts) in kinds.items()
    ]


def leads() -> list[StudyArm]:
    """What else an optimizer can do without touching the representation."""
    v_only = Fading(events=300, exp_avg=1.0)
    ratio = "the points whose exp_avg^2 / exp_avg_sq is"
    return [
        StudyArm("faded-v-only", "exp_avg_sq faded, exp_avg kept", of(v_only), control="faded"),
        StudyArm(
            V_ONLY,
            "annealed, exp_avg_sq faded, exp_avg kept",
            of(ANNEALING, v_only),
            control=ANNEALED,
        ),
        StudyArm(
            UNFADED_OPACITIES,
            "annealed and faded, opacities not faded",
            of(ANNEALING, fading_but("opacities")),
            control=ANNEALED,
        ),
        StudyArm("faded-stale", f"{ratio} smallest", of(ChosenFading("stale")), control="faded"),
        StudyArm("faded-fresh", f"{ratio} largest", of(ChosenFading("fresh")), control="faded"),
        *long_runs(),
    ]


def long_runs() -> list[StudyArm]:
    """What a run of 30,000 iterations may need instead of the defaults."""
    return [
        StudyArm(
            "faded-3000",
            "faded as often as in 3,000 iterations: every tenth",
            lambda iterations, _nu: [_often(iterations)],
            control="faded",
        ),
        StudyArm(
            "annealed-2",
            "annealed from 2, and faded",
            of(annealing(2.0, 0.4), FADING),
            control=ANNEALED,
        ),
        StudyArm(
            "own-step",
            "root mean square of the steps on a schedule, whatever the learning rates",
            lambda _iterations, _nu: [OwnStep()],
            control=ANNEALED,
        ),
        StudyArm(
            OWN_STEP,
            "the same, faded: what needs no peak in the place of annealing",
            lambda _iterations, _nu: [OwnStep(), FADING],
            control=DEFAULTS,
        ),
        StudyArm(
            EARLY[0],
            "faded as often, but only in the first quarter",
            of(FADING_EARLY),
            control="faded",
        ),
        StudyArm(
            EARLY[1],
            "the same, and all but the positions annealed",
            of(ANNEALING_OF_REST, FADING_EARLY),
            control=MEANS_LEFT,
        ),
        StudyArm(
            DEFAULTS_POOLED,
            "all but the positions annealed, faded, second moments pooled",
            of(ANNEALING_OF_REST, FADING, Pooling()),
            control=DEFAULTS,
        ),
        *(
            StudyArm(
                name,
                f"all but the positions annealed, all but the {left} faded",
                of(ANNEALING_OF_REST, fading_but(left)),
                control=MEANS_LEFT,
            )
            for left, name in UNFADED.items()
        ),
        StudyArm(
            SHARE_KEPT,
            "all but the positions annealed, the same share faded however many the points",
            of(ANNEALING_OF_REST, ShareKept(events=300)),
            control=MEANS_LEFT,
        ),
        StudyArm(
            SELDOM_FADED,
            "all but the positions annealed, faded 100 times instead of 300",
            of(ANNEALING_OF_REST, ShareKept(events=100)),
            control=MEANS_LEFT,
        ),
    ]


def schedules() -> list[StudyArm]:
    """Fading with other peaks and ends of the annealing."""
    return [
        StudyArm(
            f"settled-{peak:g}-{final:g}",
            f"faded, all steps times {peak:g} falling to {final:g}, opacities from 1",
            of(annealing(peak, final), FADING),
            control="faded",
        )
        for peak, final in ((1.0, 0.2), (1.0, 0.1), (2.0, 0.2), (2.0, 0.1), (4.0, 0.1))
    ]


def detail() -> list[StudyArm]:
    """Which parameters' annealing costs fine detail, on top of fading."""
    alone = {
        "means": ("means",),
        "shapes": ("scales", "quats"),
        "colours": ("sh0", "shN"),
        "opacities": ("opacities",),
    }
    return [
        StudyArm(
            MEANS_LEFT,
            "faded, and all but the positions annealed",
            of(ANNEALING_OF_REST, FADING),
            control="faded",
        ),
        *(
            StudyArm(
                f"annealed-{name}+faded",
                f"faded, and {', '.join(names)} alone annealed",
                of(Annealing(4.0, 0.4, names=names), FADING),
                control="faded",
            )
            for name, names in alone.items()
        ),
    ]


def unseen() -> list[StudyArm]:
    """Points out of view, which 3DGS-MCMC's regularisers melt where views are many."""
    kept = "second moments of points out of view kept"
    return [
        StudyArm("kept", kept, of(KeepUnseen())),
        StudyArm("kept+faded", f"faded, {kept}", of(FADING, KeepUnseen()), control="faded"),
    ]


def adaptive() -> list[StudyArm]:
    """Clone, split and reset instead of 3DGS-MCMC.

    gsplat's threshold is that of a gradient over the image's width, whatever its pixels: at a
    quarter of the width four times of it leaves as many Gaussians per pixel as at full size.
    """
    kinds: dict[str, tuple[str, MakeParts | None]] = {
        "": ("stock 3DGS with adaptive density control, torch's Adam", None),
        "+faded": ("the same, faded", of(FADING)),
        "+annealed": ("the same, all but the positions annealed", of(ANNEALING_OF_REST)),
        "+defaults": ("the same, with both", of(ANNEALING_OF_REST, FADING)),
    }
    return [
        StudyArm(f"{name}{kind}", what, parts, mcmc=False, control=name, adaptive=threshold)
        for name, threshold in (("adc", 4 * GROW_GRAD), ("adc-dense", GROW_GRAD))
        for kind, (what, parts) in kinds.items()
    ]


def explorations() -> list[StudyArm]:
    """What could make nu exploration rather than a weight of the view that happens to be drawn."""
    kinds: dict[str, tuple[str, MakeParts]] = {
        "per-view": (
            "nu from the energy over that view's own recent mean",
            lambda iterations, _nu: [ViewHistogram(_warmup(iterations))],
        ),
        "per-point": ("nu per Gaussian, from its gradient", fixed(NuPerPoint)),
        "restarted": (
            "Theta anew at every refinement",
            lambda iterations, _nu: [RestartedHistogram(_warmup(iterations))],
        ),
        "of-noise": (
            "nu on the noise instead of the step",
            lambda iterations, _nu: [NuOfNoise(_warmup(iterations))],
        ),
    }
    return [StudyArm(f"nu-{name}", what, parts) for name, (what, parts) in kinds.items()]


def _warmup(iterations: int) -> int:
    return max(4, round(iterations * PAPER_WARMUP))


def _often(iterations: int) -> Fading:
    return Fading(events=max(iterations // EVENT_STEPS, 1))


def retired(group: str) -> list[StudyArm]:
    """Arms of a group whose code is gone: the records tell of them."""
    with Path(__file__).with_name("retired.csv").open(encoding="utf-8", newline="") as file:
        return [
            StudyArm(row["arm"], row["what"], control=row["control"], retired=True)
            for row in csv.DictReader(file)
            if row["group"] == group
        ]


GROUPS: dict[str, list[StudyArm]] = {
    "core": core(),
    "with-nu": with_nu(),
    "options": retired("options"),
    "tails": [*last_phases(), *retired("tails")],
    "on-top": on_top(),
    "leads": [*leads(), *retired("leads")],
    "schedules": schedules(),
    "detail": detail(),
    "unseen": unseen(),
    "adaptive": adaptive(),
    "explorations": explorations(),
}
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
    if arm.startswith(DEFAULTS):
        return "defaults" + arm.removeprefix(DEFAULTS)
    return re.sub("^defaults", SHORT_LABEL, arm.replace(ANNEALED, SHORT_LABEL))
