"""The arms of every comparison: each way of training, in one list.

To add one, add it to `ARMS`: its name, what it is, and the parts that its steps have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from opt3dgs_optim import (
    DEFAULTS,
    Averaging,
    Fading,
    OutOfView,
    OwnFrame,
    Part,
    PhaseScheduler,
    paper_parts,
)

BASELINE = "mcmc"
OTHERS = ("scales", "quats", "opacities", "sh0", "shN")  # than the positions


@dataclass
class Longer(Part):
    """All steps times a constant: what tuned learning rates would do."""

    times: float
    names = None

    def plan(self, step, training) -> None:
        """Scale the rate of every parameter."""
        step.factor *= self.times


@dataclass(frozen=True)
class Arm:
    """One way of training."""

    name: str
    what: str
    parts: Callable[[int], Sequence[Part]] | None = None  # of the iterations; None: torch's Adam
    density: Literal["mcmc", "adc"] = "mcmc"  # 3DGS-MCMC, or clone, split, prune and reset
    rates: float = 1.0  # factor on all of the trainer's learning rates
    beta1: float = 0.9
    decays: bool = True  # the positions' rate, to a hundredth
    moments: Literal[32, 16] = 32  # bits of Adam's moments

    def scheduler(self, iterations: int) -> PhaseScheduler | None:
        """Of one training; None where the trainer's own Adam stays as it is."""
        if self.parts is None:
            return None
        parts = self.parts(iterations)
        return PhaseScheduler(iterations, parts=parts, moments=self.moments)


def of(*parts: Part) -> Callable[[int], Sequence[Part]]:
    """The same parts, however long the training is; they learn nothing."""
    return lambda _iterations: [*parts]


def own(
    events: int = 300, rate: float = 0.1, aspect: float = 0.1
) -> Callable[[int], Sequence[Part]]:
    """Steps of the positions in the own frame, the others faded, a hold, the last ones averaged."""
    frame, fading = OwnFrame(rate, 0.01, aspect), Fading(events=events, stop=0.5, names=OTHERS)
    return of(frame, fading, OutOfView(), Averaging())


_ARMS = (
    Arm(BASELINE, "3DGS-MCMC as its authors publish it: the baseline"),
    Arm("defaults", "the package's defaults", of(*DEFAULTS)),
    Arm(
        "own-late",
        "as own, with longer steps to the end: the defaults since 2026-11-28",
        of(OwnFrame(0.1, 0.03), Fading(stop=0.7, names=OTHERS), OutOfView(), Averaging()),
    ),
    Arm(
        "own", "own frame, the others faded, a hold, averaged: the defaults until 2026-11-28", own()
    ),
    Arm("own-16", "as own, Adam's moments in 16 bits", own(), moments=16),
    *(
        Arm(f"own-{count}-events", f"as own, Fading(events={count})", own(count))
        for count in (600, 1200)
    ),
    Arm("own-rate-0.15", "as own, OwnFrame(0.15)", own(rate=0.15)),
    *(
        Arm(f"own-aspect-{least}", f"as own, OwnFrame(min_aspect={least})", own(aspect=least))
        for least in (0.25, 0.5)
    ),
    Arm("averaged", "the baseline, its last thirtieth averaged", of(Averaging())),
    Arm("x2", "the baseline, all steps times 2", of(Longer(2.0))),
    Arm("x3", "the baseline, all steps times 3", of(Longer(3.0))),
    Arm(
        "learn2splat",
        "Learn2Splat's tuned Adam: rates times 5, beta1 0.99, a constant rate of the positions",
        rates=5.0,
        beta1=0.99,
        decays=False,
    ),
    Arm("paper", "everything that the paper has, with its settings", paper_parts),
    Arm("adc", "3DGS with clone, split, prune and reset as published", density="adc"),
    Arm("adc-own", "as adc, own frame, averaged", of(OwnFrame(0.1, 0.01, 0.1), Averaging()), "adc"),
)
ARMS = {arm.name: arm for arm in _ARMS}


def find_arm(name: str) -> Arm:
    """The arm of that name; ValueError that lists the others."""
    if name not in ARMS:
        raise ValueError(f"arm {name!r} is unknown; there are {', '.join(ARMS)}")
    return ARMS[name]
