"""The arms of a comparison: what each changes against stock 3DGS-MCMC."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from opt3dgs_optim import EnergyHistogram, PhaseScheduler
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.multiplier import ConstantMultiplier

NOISE_LR = 5e5  # 3DGS-MCMC
PAPER_WARMUP = 2_500 / 30_000
HISTOGRAM_ARM = "mcmc+awsgld"
CONSTANT_ARM = "mcmc+constant-multiplier"

# (iterations, switch, mean nu of the histogram arm or None) -> the scheduler
MakeScheduler = Callable[[int, float, float | None], PhaseScheduler]


@dataclass(frozen=True)
class Arm:
    """One way of training; `make` is None for torch's own Adam in the trainer."""

    name: str
    what: str
    mcmc: bool = True  # relocation, growth, noise and regularisers of 3DGS-MCMC
    make: MakeScheduler | None = None
    needs: str | None = None  # the arm whose mean nu it takes, seed by seed


ALL_OFF: dict[str, Any] = {
    "multiplier": None,
    "curvature": None,
    "squared_loss": False,
    "reset_moments": False,
    "annealing": None,
    "fading": None,
    "pooling": None,
    "noise_scale": NOISE_LR,
}


def _scheduler(**options: Any) -> MakeScheduler:
    """A scheduler of which only the named parts are on; the noise is the package's."""

    def make(iterations: int, switch: float, _nu: float | None) -> PhaseScheduler:
        return PhaseScheduler(iterations, switch, **ALL_OFF | options)

    return make


def _histogram(iterations: int, switch: float, _nu: float | None) -> PhaseScheduler:
    return _scheduler(multiplier="histogram")(iterations, switch, None)


def _constant(iterations: int, switch: float, nu: float | None) -> PhaseScheduler:
    if nu is None:
        raise ValueError(f"arm {CONSTANT_ARM}: needs the mean nu of {HISTOGRAM_ARM}; run it first")
    constant = ConstantMultiplier(nu, warmup=round(iterations * PAPER_WARMUP))
    return _scheduler(multiplier=constant)(iterations, switch, None)


def _defaults(iterations: int, switch: float, _nu: float | None) -> PhaseScheduler:
    return PhaseScheduler(iterations, switch, noise_scale=NOISE_LR)


def _opt3dgs(iterations: int, switch: float, _nu: float | None) -> PhaseScheduler:
    parts = _scheduler(
        multiplier="histogram",
        curvature=CurvatureOptions(),
        squared_loss=True,
        reset_moments="auto",
    )
    return parts(iterations, switch, None)


def paper_scheduler(iterations: int, switch: float, _nu: float | None) -> PhaseScheduler:
    """Everything on, with the paper's settings."""
    histogram = EnergyHistogram.paper(warmup=round(iterations * PAPER_WARMUP))
    return PhaseScheduler.paper(
        iterations, switch=switch, multiplier=histogram, noise_scale=NOISE_LR
    )


_ARMS = (
    Arm("adam", "torch's Adam alone: no density control, no noise", mcmc=False),
    Arm("mcmc", "stock 3DGS-MCMC with torch's Adam: the baseline"),
    Arm(HISTOGRAM_ARM, "with the flat-histogram multiplier", make=_histogram),
    Arm(
        CONSTANT_ARM,
        "its control: a constant multiplier, the mean nu of that arm and seed",
        make=_constant,
        needs=HISTOGRAM_ARM,
    ),
    Arm("mcmc+l2", "L2 in the last phase", make=_scheduler(squared_loss=True)),
    Arm(
        "mcmc+l2+reset",
        "L2 and fresh Adam moments in the last phase",
        make=_scheduler(squared_loss=True, reset_moments=True),
    ),
    Arm(
        "mcmc+l2+reset+lqn",
        "the same with L-BFGS directions for the positions",
        make=_scheduler(squared_loss=True, reset_moments=True, curvature=CurvatureOptions()),
    ),
    Arm("opt3dgs", "every part of the paper, settings measured on the run", make=_opt3dgs),
    Arm("opt3dgs-paper", "every part of the paper, its settings", make=paper_scheduler),
    Arm("annealed+faded", "annealed steps, faded moments: the package's defaults", make=_defaults),
)
ARMS = {arm.name: arm for arm in _ARMS}


def find_arm(name: str) -> Arm:
    """The arm of that name; ValueError that lists the others."""
    if name not in ARMS:
        raise ValueError(f"arm {name!r} is unknown; there are {', '.join(ARMS)}")
    return ARMS[name]


def in_order(names: list[str]) -> list[Arm]:
    """The named arms, those that another one needs before it (added where they were not named)."""
    arms: list[Arm] = []
    for name in names:
        arm = find_arm(name)
        for each in ([find_arm(arm.needs)] if arm.needs else []) + [arm]:
            if each not in arms:
                arms.append(each)
    return arms
