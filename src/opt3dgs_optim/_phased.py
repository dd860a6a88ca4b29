"""The optimizer that a trainer holds from the first step to the last, whatever the phase."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.optim import Adam, Optimizer

from opt3dgs_optim._adam import STATE_KEY, HookedAdam, fused_on_cuda
from opt3dgs_optim._checkpoint import check_keys
from opt3dgs_optim._groups import canonical_name, is_positions
from opt3dgs_optim._mistakes import (
    EnergyWatch,
    FrozenWatch,
    NoiseTwiceWatch,
    Replaced,
    has_own_mask,
)
from opt3dgs_optim._repr import (
    block,
    curvature_line,
    group_lines,
    scheduler_lines,
    skipped_lines,
)
from opt3dgs_optim._row_steps import ROW_STEPS
from opt3dgs_optim.lqnadam import LQNAdam

if TYPE_CHECKING:
    from opt3dgs_optim.phases import PhaseScheduler

CONSTRUCTOR_OPTIONS = (
    "betas",
    "eps",
    "weight_decay",
    "amsgrad",
    "foreach",
    "maximize",
    "capturable",
    "differentiable",
    "fused",
)


class PhasedAdam(LQNAdam):
    """Adam with nu and noise while exploring, with curvature on the positions while exploiting.

    Made by `PhaseScheduler.upgrade`, never by hand. It takes over the parameter groups (the very
    dicts: a learning-rate scheduler built on the old optimizer goes on working) and the state.
    """

    _own = (*LQNAdam._own, "scheduler", "switched", "_energy_watch", "_frozen_watch")
    _replaced: Replaced | None = None
    _noise_watch: NoiseTwiceWatch | None = None  # a copy starts to watch anew

    def __init__(self, optimizer: Adam, scheduler: PhaseScheduler) -> None:
        defaults = {key: optimizer.defaults[key] for key in CONSTRUCTOR_OPTIONS}
        if optimizer.defaults.get("decoupled_weight_decay"):
            defaults["decoupled_weight_decay"] = True
        groups = optimizer.param_groups
        fused = fused_on_cuda(
            groups, defaults["fused"], defaults["foreach"], bool(defaults["capturable"])
        )
        defaults["fused"] = fused
        shared = groups[0].pop(STATE_KEY, None)
        # A class of torch's decides its options by the defaults, a step by its group's.
        HookedAdam.__init__(self, groups, optimizer.defaults["lr"], **defaults)
        self._init_curvature(scheduler.curvature_options)
        self.scheduler = scheduler
        self.switched = False
        self._energy_watch = EnergyWatch("PhaseScheduler")
        self._frozen_watch = FrozenWatch()
        self.state.update(optimizer.state)
        self._trust_present()
        self._trust_rows()
        if has_own_mask(optimizer):
            self._count_rows()
        if fused:
            self._use_fused()
        self._replaced = Replaced(optimizer)
        if shared is not None:
            self._load_shared_state(shared)

    def _use_fused(self) -> None:
        for group in self.param_groups:
            group["fused"] = True
        for param, state in self.state.items():
            if "step" in state:
                state["step"] = state["step"].to(param.device, torch.float32)

    # -- visible rows only -------------------------------------------------------------------

    def _takes_mask(self, group: dict[str, Any], num_points: int) -> bool:
        return self._is_points(group)

    def _is_points(self, group: Mapping[str, Any]) -> bool:
        return canonical_name(group.get("name")) is not None

    # -- phases ------------------------------------------------------------------------------

    def _begin_step(self, loss: Any) -> None:
        super()._begin_step(loss)
        if self._replaced is not None:
            self._replaced.check()
        if loss is not None:
            self.scheduler.observe(loss)
        self._energy_watch.check(self.scheduler)
        if self.scheduler.exploiting and not self.switched:
            self.switched = True
            if self.scheduler.reset_moments:
                self._reset_moments()
        self._fade()
        adds_noise = self.scheduler.noise is not None
        positions = self._positions() if self.switched or adds_noise else []
        if self.switched and positions:
            self._frozen_watch.check(positions)
        if adds_noise and positions and self._noise_watch is not None:
            self._noise_watch.check(positions[0])

    def _end_step(self) -> None:
        if self.scheduler.adaptive is not None:
            self.scheduler.adaptive.count_pairs(self._tally)
        if self.scheduler.noise is None:
            return
        positions = self._positions()
        if positions:
            if self._noise_watch is None:
                self._noise_watch = NoiseTwiceWatch()
            self._noise_watch.leave(positions[0])

    def _foresee(
        self, history: Tensor, position: Tensor, gradient: Tensor, visible: Tensor | None = None
    ) -> None:
        if self.scheduler.adaptive is not None:
            size = self.curvature_options.history_size
            self.scheduler.adaptive.foresee(history, size, position, gradient, visible)

    def _positions(self) -> list[Tensor]:
        return [p for g in self.param_groups if is_positions(g) for p in g["params"]]

    def _reset_moments(self) -> None:
        """Loss and direction change scale at the switch: old second moments would stall it."""
        self._repair_rows()
        for state in self.state.values():
            for key in ("step", "exp_avg", "exp_avg_sq", "max_exp_avg_sq", ROW_STEPS):
                if key in state:
                    state[key].zero_()

    def _fade(self) -> None:
        """The fading events since the last iteration, in the parameters that it covers."""
        fading, scheduler = self.scheduler.fading, self.scheduler
        if fading is None or scheduler.num_observed == 0:
            return
        now, total = scheduler.iteration, scheduler.total_steps
        events = range(fading.events_before(now - 1, total), fading.events_before(now, total))
        if events:
            groups = [g for g in self.param_groups if fading.covers(g.get("name"))]
            fading.fade(
                {p: self.state[p] for g in groups for p in g["params"] if p in self.state}, events
            )

    def _bad_step(self) -> Tensor | None:
        return ~self.scheduler.last_finite if self.scheduler.num_observed else None

    def _factor(self, group: dict[str, Any]) -> Tensor | float | None:
        """Annealing over the whole run, times nu while exploring."""
        scheduler = self.scheduler
        if canonical_name(group.get("name")) is None or scheduler.num_observed == 0:
            return None
        factor = scheduler.annealing_factor(group.get("name"))
        multiplier = scheduler.multiplier
        if multiplier is None or scheduler.exploiting:
            return factor
        nu = multiplier.multiplier
        return nu if factor is None else nu * factor

    def _uses_curvature(self, group: Mapping[str, Any]) -> bool:
        scheduler = self.scheduler
        return scheduler.exploiting and scheduler.curvature and is_positions(group)

    def _after_group(self, group: dict[str, Any], params: list[Tensor]) -> None:
        pooling = self.scheduler.pooling
        if pooling is not None and pooling.covers(group.get("name")):
            for param, rows in zip(params, self._moving or [None] * len(params), strict=True):
                pooling.pool(self.state[param], rows)
        noise = self.scheduler.noise
        if noise is not None and is_positions(group):
            self._add_noise(noise, group, params)

    def __repr__(self) -> str:
        lines = scheduler_lines(self.scheduler)
        if self._positions() and self.scheduler.curvature:
            lines.append(curvature_line(self.curvature_options, self.accepted_share))
        lines += skipped_lines(self.skipped_rows) + group_lines(self.param_groups)
        return block(type(self).__name__, lines)

    # -- checkpoints -------------------------------------------------------------------------

    def _shared_state(self) -> dict[str, Any]:
        return {"scheduler": self.scheduler.state_dict(), "switched": self.switched}

    def _load_shared_state(self, shared: Mapping[str, Any]) -> None:
        check_keys(f"{type(self).__name__}.load_state_dict", shared, ("scheduler", "switched"))
        self.scheduler.load_state_dict(shared["scheduler"])
        self.curvature_options = self.scheduler.curvature_options
        self.switched = bool(shared["switched"])


def check_upgradable(optimizer: Any, name: str) -> Adam:
    """Return `optimizer` if it is torch's Adam (or AdamW built on it), else TypeError."""
    call = "PhaseScheduler.upgrade"
    if isinstance(optimizer, HookedAdam):
        raise TypeError(
            f"{call}: {name} is a {type(optimizer).__name__} of this package already; upgrade the "
            "trainer's own torch.optim.Adam, once"
        )
    same_step = isinstance(optimizer, Adam) and (
        inspect.unwrap(type(optimizer).step) is inspect.unwrap(Adam.step)
    )
    if not same_step and not has_own_mask(optimizer):
        kind = f"{type(optimizer).__module__}.{type(optimizer).__qualname__}"
        raise TypeError(
            f"{call}: {name} is a {kind}, but torch.optim.Adam (or a subclass with Adam's own "
            "step, or one of its own that takes a visibility mask) is needed"
        )
    return optimizer


def named_groups(optimizer: Optimizer) -> list[str]:
    """Names of the optimizer's groups; ValueError if one occurs twice."""
    names = [group["name"] for group in optimizer.param_groups if "name" in group]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"PhaseScheduler.upgrade: two groups are named {twice[0]!r}")
    return names
