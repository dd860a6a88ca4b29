"""Own frame: positions are stepped along each Gaussian's axes, in its standard deviations."""

from __future__ import annotations

import functools
import math
import weakref
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef

from opt3dgs_optim.checks import check_number, set_options
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Frame, Step
from opt3dgs_optim.training import Training

CALL = "OwnFrame"
BETA1 = 0.9  # of one view an iteration
SLOWED_OVER, POWER = 1_000, 0.75  # iterations; where no end is planned: see `OwnFrame`
MEDIANS, EVERY = 6, 100  # of the longest axes, found every so many iterations: see `OwnFrame`
STEADY = 2  # edits in a row that leave the rows in their place are relocation's


@dataclass(frozen=True, repr=False)
class OwnFrame(Part):
    """Step the positions in each Gaussian's own frame, in units of its standard deviations.

        mu <- mu - rate(t) B Adam(B^T g),    B = R diag(s),    Sigma = B B^T
        rate(t) = rate * final^t,            t = iteration / total_steps in 0..1

    Where no end is planned, in iteration i, and in the fall of which a share x is over:

        rate(i, x) = rate * (1 + i / 1,000)^(-3/4) * (1 - (1 - final) sqrt(x))

    Adam is fed the gradient in the Gaussian's own frame, and returns a step along its axes, in its
    standard deviations. That depends neither on the unit of the scene nor on the positions'
    learning rate, except that a learning rate of 0 holds them. A Gaussian whose position has no
    gradient stays, and so do its moments (as in Taming 3DGS, 2024, with its Adam for visible ones).
    docs/algorithms/own-frame.md has the reasons.

    An axis counts as no thinner than `min_aspect` of the longest, by default 3,000 / total_steps,
    but between 0.1 and 0.25. It counts as no longer than 6 times the median of the Gaussians'
    longest axes, which is found every 100 iterations. Two edits in a row that make a new Parameter
    of the same memory, as relocation does, lift that bound, until one that makes other memory.

    For b views in a batch, or b ranks, gsplat sets beta1 = 1 - 0.1 b and scales rates by sqrt(b).
    The rate here follows beta1: below beta1 = 0.9 it is scaled by sqrt((1 - beta1) / 0.1).

    Adam's moments of the positions then belong to the own frame. In a training that adds it midway,
    from a checkpoint of the unchanged trainer, they begin anew, which is logged.
    Scales (log) and quaternions [N, 4] (wxyz) of the same points must be among the upgraded
    optimizers' groups; if not, there is one warning, and plain Adam steps the positions.
    Scales are [N, 3]; [N, 2] for flat Gaussians (2DGS), whose third axis counts as `min_aspect` of
    the longest; or [N, 1] for round ones. gsplat's trainer for flat Gaussians has a third scale
    that nothing trains: leave the part out there. A Gaussian whose scales or quaternion are NaN is
    not moved.

    It keeps the bound on the longest axes from step to step; checkpoints save it.

    Args:
        rate: a full step in the first iteration, in standard deviations; above 0.
        final: share of `rate` in the last iteration, above 0. 3DGS trainers decay the positions'
            learning rate to 0.01 of it; here longer last steps help in short trainings.
        min_aspect: least share of a Gaussian's longest standard deviation that a shorter one counts
            as, in 0..1; 0: every axis counts as it is, 1: a Gaussian counts as a ball; None: set by
            the length of the training.

    Raises:
        ValueError: an option is outside what is allowed.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import OwnFrame, PhaseScheduler
        >>> splats = {"means": torch.zeros(2, 3), "scales": torch.zeros(2, 3),
        ...           "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2)}
        >>> splats["scales"][1] = -1.5  # the second Gaussian is four times smaller
        >>> splats = {name: torch.nn.Parameter(value) for name, value in splats.items()}
        >>> adams = {name: torch.optim.Adam([param]) for name, param in splats.items()}
        >>> phases = PhaseScheduler(100, parts=[OwnFrame(rate=0.1)])
        >>> adams = phases.upgrade(adams)
        >>> splats["means"].grad = torch.ones(2, 3)
        >>> adams["means"].step()
        >>> [round(x, 4) for x in splats["means"][:, 0].tolist()]
        [-0.1, -0.0223]
    """

    rate: float = 0.1
    final: float = 0.03
    min_aspect: float | None = None

    names = ("means",)

    def __post_init__(self) -> None:
        least = self.min_aspect
        if least is not None:
            least = check_number(CALL, "min_aspect", least, 0.0, 1.0)
        set_options(
            self,
            rate=check_number(CALL, "rate", self.rate, 0.0, open_low=True),
            final=check_number(CALL, "final", self.final, 0.0, open_low=True),
            min_aspect=least,
        )

    def at(self, training: Training) -> float:
        """Standard deviations of a full step in the present iteration."""
        if not training.open_end:
            return self.rate * self.final**training.progress
        slowed = (1 + max(training.iteration, 0) / SLOWED_OVER) ** -POWER
        return self.rate * slowed * (1 - (1 - self.final) * math.sqrt(training.fallen))

    def plan(self, step: Step, training: Training) -> None:
        """Step the positions [N, 3] in their own frames."""
        quats = training.param_of(step.set, "quats")
        scales = training.param_of(step.set, "scales")
        rows = len(step.param)
        if (
            quats is None or scales is None
            or quats.shape != (rows, 4) or scales.shape not in ((rows, 3), (rows, 2), (rows, 1))
            or not quats.dtype == scales.dtype == step.param.dtype
        ):  # fmt: skip
            found = {
                n: None if t is None else (*t.shape, t.dtype)
                for n, t in (("scales", scales), ("quats", quats))
            }
            training.messages.warn_once(
                CALL,
                f"{CALL}: positions [{rows}, 3] need scales [N, 3] (or 2, or 1) and quats "
                f"[N, 4] of the same points among the upgraded optimizers, which hold {found}; "
                "Adam steps them",
            )
            return
        rate = self.at(training) if step.group["lr"] else 0.0
        if (beta1 := step.group["betas"][0]) < BETA1:
            rate *= math.sqrt((1 - beta1) / (1 - BETA1))
        least = self.min_aspect
        if least is None:
            least = min_aspect_of(training.end_step or step.iteration)
        now, kept = step.iteration // EVERY, training.unsaved.get((OwnFrame, step.set))
        if (
            kept is None or kept.means() is not step.param
            or (kept.found_in != now and kept.steady < STEADY)
        ):  # fmt: skip
            kept = self.keep_bound(step.set, step.param, scales, now, training)
        scales = scales if scales.shape[1] == 3 else three_of(scales)
        step.frame = Frame(rate, least, quats, scales, kept.longest)

    def keep_bound(
        self, of_set: str, means: Tensor, scales: Tensor, now: int, training: Training
    ) -> _Bound:
        """Keep what a longer axis counts as, of these 100 iterations or until the next edit."""
        kept = self.bound(of_set, means, training)
        if kept is None or (kept.found_in != now and kept.steady < STEADY):
            longest = scales.new_full((), math.inf)
            if len(means):
                longest = median_of(scales.detach().amax(1)).exp() * MEDIANS
            kept = _Bound(
                weakref.ref(means), rows_of(means), kept.steady if kept else 0, now, longest
            )
        training.unsaved[OwnFrame, of_set] = kept
        return kept

    def bound(self, of_set: str, means: Tensor, training: Training) -> _Bound | None:
        """What holds for these rows: as kept or, after a load, as noted; None: it is not known."""
        kept: _Bound | None = training.unsaved.get((OwnFrame, of_set))
        rows = rows_of(means)
        if kept is None:
            notes = training.notes_of(self)
            if not set(_notes(of_set)) <= set(notes):
                return None
            steady, found_in, longest = (notes[note] for note in _notes(of_set))
            longest = means.new_full((), longest or math.inf)
        elif kept.means() is means:
            return kept
        else:
            steady = kept.steady + 1 if kept.rows == rows else 0
            found_in = kept.found_in if kept.steady < STEADY else -1  # it is to be found
            longest = kept.longest if steady < STEADY else means.new_full((), math.inf)
        return _Bound(weakref.ref(means), rows, steady, found_in, longest)

    def read_back(self, training: Training) -> None:
        """Have the bounds in the notes; after a load, know the rows that they are of."""
        for of_set in [of_set for of_set, name in training.members if name == "means"]:
            means = training.param_of(of_set, "means")
            kept = None if means is None else self.bound(of_set, means, training)
            if kept is not None:
                training.unsaved.setdefault((OwnFrame, of_set), kept)
                number = kept.longest.item()
                found = kept.steady, kept.found_in, number if math.isfinite(number) else 0.0
                training.notes_of(self).update(zip(_notes(of_set), found, strict=True))

    def numbers(self, training: Training) -> Mapping[str, float]:
        """`own_frame_rate`: standard deviations of a full step with a beta1 of 0.9."""
        return {"own_frame_rate": self.at(training)}


class _Bound(NamedTuple):
    """What is kept of a set of Gaussians from step to step.

    Attributes:
        means: the Parameter that the trainer had in the last step, a weak reference.
        rows: how many, and in which memory, see `rows_of`.
        steady: how many edits in a row have left that.
        found_in: the hundred of iterations; -1: it is to be found.
        longest: [] the standard deviation that a longer axis counts as; infinite: none does.
    """

    means: weakref.ref[Tensor]
    rows: tuple[int, StorageWeakRef]
    steady: int
    found_in: int
    longest: Tensor


def rows_of(means: Tensor) -> tuple[int, StorageWeakRef]:
    """How many rows there are, and their memory: relocation makes a Parameter of the same.

    Not its address, which memory that is freed gives to the next.
    """
    return len(means), StorageWeakRef(means.untyped_storage())


def _notes(of_set: str) -> tuple[str, ...]:
    """The keys of the notes on a set of Gaussians; the third is 0 where no axis is bounded."""
    return tuple(f"{what} {of_set}".rstrip() for what in ("steady", "found in", "longest"))


def median_of(numbers: Tensor) -> Tensor:
    """The lower median [] of numbers [N], NaNs aside.

    It is `nanmedian`, which waits for the device in PyTorch 2.4.
    """
    ordered, _ = numbers.sort()  # NaNs come last
    middle = (numbers.numel() - numbers.isnan().sum() - 1) // 2
    return ordered.gather(0, middle.clamp(min=0).view(1)).view(())


def three_of(scales: Tensor) -> Tensor:
    """Scales [N, 3] of flat Gaussians [N, 2], whose third axis is no length, or of round [N, 1]."""
    scales = scales.detach()
    if scales.shape[1] == 1:
        return scales.expand(-1, 3).contiguous()
    return torch.nn.functional.pad(scales, (0, 1), value=-math.inf)


@functools.lru_cache(maxsize=64)  # every step asks
def min_aspect_of(iterations: int) -> float:
    """`min_aspect` where nothing is said, in a training of that length, or as long so far."""
    return min(max(3_000 / max(iterations, 1), 0.1), 0.25)
