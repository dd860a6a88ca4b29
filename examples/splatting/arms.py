"""The arms of every comparison: each way of training, in one list.

To add one, add it to `ARMS`: its name, what it is, and the parts that its steps have.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from opt3dgs_optim import (
    DEFAULTS,
    Averaging,
    Harmonics,
    Part,
    PhaseScheduler,
    paper_parts,
)

BASELINE = "stock"


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
    rates: float = 1.0  # factor on all of the trainer's learning rates
    beta1: float = 0.9
    decays: bool = True  # the positions' rate, to a hundredth
    open_end: bool = False  # whether the scheduler is told no number of iterations

    def scheduler(self, iterations: int) -> PhaseScheduler | None:
        """Of one training; None where the trainer's own Adam stays as it is."""
        if self.parts is None:
            return None
        total = None if self.open_end else iterations
        return PhaseScheduler(total, parts=self.parts(iterations))


def of(*parts: Part) -> Callable[[int], Sequence[Part]]:
    """The same parts, however long the training is; they learn nothing."""
    return lambda _iterations: [*parts]


_ARMS = (
    Arm(BASELINE, "the trainer as its authors publish it: the baseline"),
    Arm("defaults", "the package's defaults", of(*DEFAULTS)),
    Arm("harmonics", "the defaults and `Harmonics`", of(*DEFAULTS, Harmonics())),
    Arm("stock-harmonics", "the baseline and `Harmonics`", of(Harmonics())),
    Arm(
        "open-end",
        "the defaults without a planned end, for `benchmarks/open_end.py`",
        of(*DEFAULTS),
        decays=False,
        open_end=True,
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
)
ARMS = {arm.name: arm for arm in _ARMS}


def find_arm(name: str) -> Arm:
    """The arm of that name; ValueError that lists the others."""
    if name not in ARMS:
        raise ValueError(f"arm {name!r} is unknown; there are {', '.join(ARMS)}")
    return ARMS[name]
