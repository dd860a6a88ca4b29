"""The arms of the study: each part alone, its control, and what goes beyond the paper."""

from __future__ import annotations

from typing import Any

from splatting.arms import PAPER_WARMUP, paper_scheduler
from splatting.scenes import Scene

from opt3dgs_optim import EnergyHistogram
from opt3dgs_optim.energy import PAPER_RANGE, PAPER_TEMPERATURE
from opt3dgs_optim.fading import Fading
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.multiplier import ConstantMultiplier
from opt3dgs_optim.pooling import Pooling
from study.lead_arms import leads
from study.study_arm import (
    ALL_ANNEALED,
    BASELINE,
    DEFAULT_PARTS,
    DEFAULTS,
    POOLED,
    Options,
    StudyArm,
    anneal_all,
    fixed,
)

# What the arms beyond the paper are made of, by the arm's name, and how a table says it.
PARTS: dict[str, dict[str, Any]] = {
    "annealed-8-0.4": {"annealing": anneal_all(8.0)},
    "faded": {"fading": Fading()},
    DEFAULTS: DEFAULT_PARTS,
    POOLED: {**DEFAULT_PARTS, "pooling": Pooling()},
}
WORDS = {"annealed-8-0.4": "annealed", "faded": "faded", DEFAULTS: "the defaults", POOLED: "pooled"}

LABELS = {"annealed": "annealed-8-0.4", "defaults": DEFAULTS, "pooled": POOLED}


def _histogram(**changes: Any) -> Options:
    def make(_scene: Scene, iterations: int, _nu: float | None) -> dict[str, Any]:
        warmup = round(iterations * PAPER_WARMUP)
        if changes.get("paper"):
            return {"multiplier": EnergyHistogram.paper(warmup=warmup)}
        return {"multiplier": EnergyHistogram(**{"warmup": warmup, **changes})}

    return make


def _constant(_scene: Scene, iterations: int, nu: float | None) -> dict[str, Any]:
    assert nu is not None
    return {"multiplier": ConstantMultiplier(nu, warmup=round(iterations * PAPER_WARMUP))}


def _with(options: Options, parts: dict[str, Any]) -> Options:
    return lambda *call: {**options(*call), **parts}


def _epoch_pairs(scene: Scene, _iterations: int, _nu: float | None) -> dict[str, Any]:
    pairs = CurvatureOptions(pairs="epoch", epoch_steps=len(scene.train), powell=True)
    return {"squared_loss": True, "reset_moments": True, "curvature": pairs}


def core() -> list[StudyArm]:
    """Whole trainings that only the trainer's learning rates, nu or the moments distinguish."""
    rates = [
        StudyArm(f"rates-x{k:g}", f"all steps times {k:g}", BASELINE, fixed(multiplier=float(k)))
        for k in (1.5, 2, 3)
    ]
    annealed = [
        StudyArm(
            f"annealed-{peak:g}-{final:g}",
            f"all steps times {peak:g} falling to {final:g}",
            BASELINE,
            fixed(annealing=anneal_all(peak, final)),
        )
        for peak, final in ((4, 0.4), (8, 0.4), (8, 0.1), (16, 0.4))
    ]
    both = anneal_all(4.0)
    return [
        StudyArm(BASELINE, "stock 3DGS-MCMC, torch's Adam", BASELINE),
        StudyArm("awsgld", "with the flat-histogram multiplier", BASELINE, _histogram()),
        StudyArm(
            "constant", "a constant multiplier, its mean nu", BASELINE, _constant, needs="awsgld"
        ),
        *rates,
        *annealed,
        StudyArm("faded", "moments of random points faded", BASELINE, fixed(**PARTS["faded"])),
        StudyArm(
            ALL_ANNEALED,
            "annealed from 4, and faded",
            "annealed-8-0.4",
            fixed(annealing=both, fading=Fading()),
        ),
        StudyArm(
            DEFAULTS,
            "the same, but opacities annealed from 1",
            ALL_ANNEALED,
            fixed(**PARTS[DEFAULTS]),
        ),
        StudyArm(
            POOLED,
            "the defaults, second moments pooled",
            DEFAULTS,
            fixed(**PARTS[POOLED]),
        ),
        StudyArm(
            "paper",
            "everything, the paper's settings",
            BASELINE,
            fixed(),
            29 / 30,
            preset=paper_scheduler,
        ),
        StudyArm(
            "faded-3000",
            "moments of random points faded ten times as often",
            "faded",
            fixed(fading=Fading(events=3_000)),
        ),
        StudyArm(
            "defaults-3000",
            "the defaults, faded ten times as often",
            DEFAULTS,
            fixed(**{**PARTS[DEFAULTS], "fading": Fading(events=3_000)}),
        ),
        StudyArm(
            "paper-constant",
            "a constant multiplier, the paper's mean nu",
            BASELINE,
            _constant,
            needs="paper",
        ),
    ]


def with_nu() -> list[StudyArm]:
    """The multiplier on top of annealing and fading, beside a constant of its mean."""
    return [
        arm
        for trunk, parts in PARTS.items()
        if trunk != POOLED
        for arm in (
            StudyArm(
                f"{trunk}+constant",
                f"{WORDS[trunk]}, with a constant multiplier: the next arm's mean nu",
                trunk,
                _with(_constant, parts),
                needs=f"{trunk}+awsgld",
            ),
            StudyArm(
                f"{trunk}+awsgld",
                f"{WORDS[trunk]}, with the flat-histogram multiplier",
                f"{trunk}+constant",
                _with(_histogram(), parts),
            ),
        )
    ]


def histograms() -> list[StudyArm]:
    """The multiplier's options, one changed at a time."""
    changes: dict[str, dict[str, Any]] = {
        "zeta-0.25": {"zeta": 0.25},
        "zeta-0.5": {"zeta": 0.5},
        "clamp-0-5": {"clamp": (0.0, 5.0)},
        "clamp-0.25-4": {"clamp": (0.25, 4.0)},
        "ema": {"energy": "ema"},
        "view-centred": {"energy": "view_centered"},
        "least-squares-slope": {"slope": "least_squares"},
        "fixed": {"paper": True},
        "fixed-range": {"energy_range": PAPER_RANGE},
        "fixed-temperature": {"temperature": PAPER_TEMPERATURE},
    }
    return [
        StudyArm(f"awsgld-{name}", f"the histogram with {options}", "awsgld", _histogram(**options))
        for name, options in changes.items()
    ]


def last_phases() -> list[StudyArm]:
    """What changes at the switch, branched off one and the same exploration."""
    kinds: dict[str, tuple[str, str | None, Options]] = {
        "l1+reset": ("L1, moments reset", None, fixed(reset_moments=True)),
        "l2": ("L2, moments kept", None, fixed(squared_loss=True)),
        "l2+reset": ("L2, moments reset", None, fixed(squared_loss=True, reset_moments=True)),
        "l2+reset+lqn": (
            "the same with L-BFGS directions, consecutive pairs",
            "l2+reset",
            fixed(squared_loss=True, reset_moments=True, curvature=CurvatureOptions()),
        ),
        "l2+reset+lqn-powell": (
            "the same with Powell damping",
            "l2+reset",
            fixed(squared_loss=True, reset_moments=True, curvature=CurvatureOptions(powell=True)),
        ),
        "l2+reset+lqn-epoch": ("pairs between means over epochs", "l2+reset", _epoch_pairs),
        "l1+reset+lqn": (
            "L1, moments reset, L-BFGS directions",
            "l1+reset",
            fixed(reset_moments=True, curvature=CurvatureOptions()),
        ),
        "noise-off": ("no noise", None, fixed(noise_in_exploitation=False)),
    }
    return [
        StudyArm(
            f"{name}@1/{share}",
            f"{what}, in the last 1/{share}",
            f"{control}@1/{share}" if control else BASELINE,
            options,
            1 - 1 / share,
            trunk=BASELINE,
        )
        for share in (30, 10, 4)
        for name, (what, control, options) in kinds.items()
    ]


def on_top() -> list[StudyArm]:
    """The last phase on top of annealing and fading: does curvature earn its place there?"""
    kinds: dict[str, tuple[str | None, dict[str, Any]]] = {
        "l2": (None, {"squared_loss": True}),
        "l1+reset": (None, {"reset_moments": True}),
        "l1+reset+lqn": ("l1+reset", {"reset_moments": True, "curvature": CurvatureOptions()}),
        "lqn": (None, {"curvature": CurvatureOptions()}),
        "noise-off": (None, {"noise_in_exploitation": False}),
    }
    return [
        StudyArm(
            f"{label}+{name}@1/10",
            f"{WORDS[trunk]}, then {name} in the last tenth",
            f"{label}+{control}@1/10" if control else trunk,
            fixed(**PARTS[trunk], **options),
            0.9,
            trunk=trunk,
        )
        for label, trunk in LABELS.items()
        for name, (control, options) in kinds.items()
    ]


STUDY_ARMS = {
    arm.name: arm
    for arms in (core(), with_nu(), histograms(), last_phases(), on_top(), leads())
    for arm in arms
}


def find_study_arm(name: str) -> StudyArm:
    """The arm of that name; ValueError that lists the others."""
    if name not in STUDY_ARMS:
        raise ValueError(f"arm {name!r} is unknown; there are {', '.join(STUDY_ARMS)}")
    return STUDY_ARMS[name]
