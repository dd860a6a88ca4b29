"""The arms of a comparison: what each changes against stock 3DGS-MCMC."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from opt3dgs_optim import (
    DEFAULTS,
    ConstantMultiplier,
    EnergyHistogram,
    Part,
    PhaseScheduler,
    PositionNoise,
    paper_parts,
)
from opt3dgs_optim.presets import PAPER_WARMUP

NOISE_LR = 5e5  # 3DGS-MCMC
BASELINE = "mcmc"
HISTOGRAM_ARM = "awsgld"
DEFAULT_ARM = "defaults"

# (iterations, mean nu of the arm in `needs` or None) -> what the steps have
MakeParts = Callable[[int, float | None], list[Part]]


@dataclass(frozen=True)
class Arm:
    """One way of training."""

    name: str
    what: str = ""
    parts: MakeParts | None = None  # None: torch's own Adam in the trainer
    mcmc: bool = True  # relocation, growth, noise and regularisers of 3DGS-MCMC
    needs: str | None = None  # the arm whose mean nu it takes, seed by seed

    def make(
        self, iterations: int, switch: float, nu: float | None, gaussians: Mapping[str, Tensor]
    ) -> PhaseScheduler:
        """The scheduler of one training: the arm's parts, and the noise of 3DGS-MCMC.

        Args:
            iterations: length of the training.
            switch: where exploitation starts, as a share of it.
            nu: mean nu of the arm in `needs`.
            gaussians: the trainer's dict of parameters, which the noise reads in every step.
        """
        if self.needs is not None and nu is None:
            raise ValueError(f"arm {self.name}: needs the mean nu of {self.needs}; run it first")
        parts = [] if self.parts is None else self.parts(iterations, nu)
        if self.mcmc:
            parts.append(PositionNoise(gaussians, NOISE_LR))
        return PhaseScheduler(iterations, switch, parts)


def fixed(*parts: Callable[[], Part]) -> MakeParts:
    """These parts, made anew for each training: some learn, and serve one."""
    return lambda _iterations, _nu: [make() for make in parts]


def histogram(iterations: int, _nu: float | None = None) -> list[Part]:
    """The flat-histogram multiplier, its settings measured on the run."""
    return [EnergyHistogram(warmup=max(4, round(iterations * PAPER_WARMUP)))]


def constant(iterations: int, nu: float | None) -> list[Part]:
    """Its control; float32, as the histogram's nu on the step is."""
    value = float(torch.tensor(nu, dtype=torch.float32))
    return [ConstantMultiplier(value, warmup=round(iterations * PAPER_WARMUP))]


_ARMS = (
    Arm(BASELINE, "3DGS-MCMC as its authors publish it: the baseline"),
    Arm(
        "rates-x3",
        "3DGS-MCMC with all steps times three: what a larger learning rate gains",
        fixed(lambda: ConstantMultiplier(3.0)),
    ),
    Arm(
        "adam",
        "torch's Adam from the start of INRIA's trainer: no density control, no noise",
        mcmc=False,
    ),
    Arm(HISTOGRAM_ARM, "3DGS-MCMC with AW-SGLD's multiplier nu", histogram),
    Arm(
        "constant",
        "its control: a constant multiplier, the mean nu of that arm and seed",
        constant,
        needs=HISTOGRAM_ARM,
    ),
    Arm("paper", "the paper's preset", lambda iterations, _nu: paper_parts(iterations)),
    Arm(DEFAULT_ARM, "the package's defaults", lambda _iterations, _nu: [*DEFAULTS]),
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
