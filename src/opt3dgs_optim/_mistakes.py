"""Mistakes of a set-up, said early, each in a sentence that names the cure."""

from __future__ import annotations

import inspect
import types
import warnings
import weakref
from collections.abc import Mapping
from typing import Any, Protocol

from torch import Tensor
from torch.optim import Adam, Optimizer

CALL = "PhaseScheduler"
NOISE_STEPS = 5  # steps in a row with positions changed by somebody else before it is said
STALE_STEPS = 200  # steps without a new energy before it is said
FROZEN_STEPS = 20  # exploitation steps without a gradient of the positions before it is said


def check_one_noise(noise_scale: float, strategy: Any) -> None:
    """ValueError if the trainer's density control injects position noise as we do.

    Args:
        noise_scale: ours.
        strategy: an object or mapping with `noise_lr` (gsplat's MCMCStrategy, the arguments of
            3dgs-mcmc), a number (that noise_lr itself), or None where it is not known.
    """
    theirs = strategy
    if isinstance(strategy, Mapping):
        theirs = strategy.get("noise_lr", 0)
    elif not isinstance(strategy, (int, float)):
        theirs = getattr(strategy, "noise_lr", 0)
    if noise_scale > 0 and isinstance(theirs, (int, float)) and theirs > 0:
        raise ValueError(
            f"{CALL}.upgrade: noise_scale={noise_scale} and the trainer's noise_lr={theirs} would "
            "add the position noise twice; set the trainer's noise_lr to 0, or leave noise_scale "
            "at 0"
        )


def has_own_mask(optimizer: Any) -> bool:
    """Whether `optimizer` is an Adam whose own step takes a visibility mask first.

    gsplat's SelectiveAdam and INRIA's SparseGaussianAdam are.
    """
    if not isinstance(optimizer, Adam):
        return False
    names = list(inspect.signature(inspect.unwrap(type(optimizer).step)).parameters)
    return names[1:2] == ["visibility"]


def warn_of_scheduler(optimizer: Optimizer, name: str) -> None:
    """Say that a learning-rate scheduler was built on an optimizer that is being replaced."""
    if getattr(optimizer.step, "_wrapped_by_lr_sched", False):
        warnings.warn(
            f"{CALL}.upgrade: a learning-rate scheduler was already built on {name}; it goes on "
            "working on the shared groups, but not after load_state_dict, so build learning-rate "
            "schedulers on what upgrade() returns",
            stacklevel=4,
        )


class Replaced:
    """Watches an optimizer after the upgrade: nobody should step or schedule it any more."""

    def __init__(self, optimizer: Optimizer) -> None:
        self._old = weakref.ref(optimizer)
        # A bound method, because learning-rate schedulers look for step.__func__.
        optimizer.step = types.MethodType(_refuse, optimizer)

    def check(self) -> None:
        """Call in every step: RuntimeError where a scheduler has been built on the old object."""
        old = self._old()
        if old is not None and getattr(old.step, "_wrapped_by_lr_sched", False):
            raise RuntimeError(
                f"{CALL}: a learning-rate scheduler has been built on the optimizer that upgrade() "
                "replaced; build it on the optimizer that upgrade() returned"
            )

    def __deepcopy__(self, memo: Any) -> None:
        """A copy has no predecessor."""


def _refuse(self: Optimizer, *args: Any, **kwargs: Any) -> None:
    raise RuntimeError(
        f"{CALL}: this {type(self).__name__} was replaced by upgrade(); keep what it returns "
        "(optimizers = phases.upgrade(optimizers)) and step that"
    )


class FrozenWatch:
    """Says once that the positions get no gradients in exploitation."""

    def __init__(self) -> None:
        self._still = 0

    def check(self, positions: list[Tensor]) -> None:
        """Call in every exploitation step of the optimizer that holds the positions."""
        if self._still > FROZEN_STEPS:
            return
        if any(p.grad is not None for p in positions):
            self._still = 0
            return
        # Where points were just edited there is no gradient for one step: wait. Where
        # requires_grad is off there will be none.
        frozen = not any(p.requires_grad for p in positions)
        self._still = FROZEN_STEPS + 1 if frozen else self._still + 1
        if self._still > FROZEN_STEPS:
            why = "requires_grad is False" if frozen else f"no gradient for {FROZEN_STEPS} steps"
            warnings.warn(
                f"{CALL}: exploitation has begun but the positions are frozen ({why}), so it "
                "changes nothing; move the switch to before the Gaussians are frozen, "
                f"{CALL}(switch=...), or leave them trainable",
                stacklevel=5,
            )


class NoiseTwiceWatch:
    """Says once that somebody else moves the positions too, as a trainer's own noise does."""

    def __init__(self) -> None:
        self._left: tuple[weakref.ref[Tensor], int] | None = None
        self._moved = 0

    def leave(self, positions: Tensor) -> None:
        """Call after a step of ours: remember the tensor and how often it was written to."""
        self._left = (weakref.ref(positions), positions._version)

    def check(self, positions: Tensor) -> None:
        """Call before a step of ours that adds noise.

        Density control puts another Parameter in place; noise writes into this one, after every
        step. A clamp now and then is not noise, hence several steps in a row.
        """
        if self._left is None or self._moved > NOISE_STEPS:
            return
        same = self._left[0]() is positions
        written = same and positions._version != self._left[1]
        self._moved = self._moved + 1 if written else 0
        if self._moved > NOISE_STEPS:
            warnings.warn(
                f"{CALL}: the positions were changed in place between {NOISE_STEPS} steps in a "
                "row, while noise_scale > 0 adds position noise in every step; if the trainer "
                "injects its own noise, set its noise_lr to 0, or leave noise_scale at 0",
                stacklevel=5,
            )


class EnergySource(Protocol):
    """What tells how many energies have been observed: a histogram or a scheduler."""

    num_observed: int


class EnergyWatch:
    """Says once, clearly, that an optimizer is stepped without any energy."""

    def __init__(self, call: str) -> None:
        self._call = call
        self._seen = -1
        self._stale = 0
        self._told = False

    def check(self, source: EnergySource) -> None:
        """Call in every step."""
        if self._told:
            return
        self._stale = self._stale + 1 if source.num_observed == self._seen else 0
        self._seen = source.num_observed
        if source.num_observed == 0 or self._stale >= STALE_STEPS:
            since = "yet" if source.num_observed == 0 else f"for {STALE_STEPS} steps"
            self._told = True
            warnings.warn(
                f"{self._call}: step() was called but no energy has been observed {since}, so "
                "the multiplier is not being adapted and this is plain Adam. Call observe(loss) "
                "on the histogram or the scheduler once per iteration, before step(), or pass "
                "step() a closure that returns the loss.",
                stacklevel=5,
            )
