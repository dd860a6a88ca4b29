"""The phase scheduler: one object that owns iteration, phase and energy for a whole training."""

from __future__ import annotations

import enum
import warnings
from collections.abc import Hashable, Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import torch
from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim._adaptive_state import check_loadable
from opt3dgs_optim._checkpoint import check_keys, check_whole
from opt3dgs_optim._checks import check_count, check_flag, check_number, check_part
from opt3dgs_optim._phase_options import (
    PAPER_STEPS,
    PAPER_SWITCH,
    PAPER_WARMUP,
    as_multiplier,
    resets_moments,
    switch_iteration,
)
from opt3dgs_optim._ranks import RankMean
from opt3dgs_optim._repr import block, curvature_line, scheduler_lines
from opt3dgs_optim._upgrading import Upgrading
from opt3dgs_optim.annealing import Annealing
from opt3dgs_optim.energy import EnergyHistogram
from opt3dgs_optim.fading import Fading
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.multiplier import ConstantMultiplier
from opt3dgs_optim.noise import CovarianceNoise
from opt3dgs_optim.pooling import Pooling

if TYPE_CHECKING:
    from opt3dgs_optim._adaptive import Adaptive
    from opt3dgs_optim.runs import RunLog

__all__ = ["PAPER_STEPS", "PAPER_SWITCH", "Phase", "PhaseScheduler"]

CALL = "PhaseScheduler"
OPTIMIZERS = TypeVar("OPTIMIZERS", bound="dict[str, Optimizer] | Optimizer")


class Phase(enum.Enum):
    """What a training is doing."""

    EXPLORATION = "exploration"
    EXPLOITATION = "exploitation"


class PhaseScheduler(Upgrading):
    """Put annealing, fading and Opt3DGS's two phases into a 3DGS trainer's optimizers.

    By default, annealing and fading: what paid against a control (docs/evidence.md). The two
    phases of the paper are on with `PhaseScheduler.paper`, or part by part. Exploration: Adam's
    step on every Gaussian parameter is multiplied by nu. Exploitation: the pixel loss turns from
    L1 to L2, Adam's moments start anew, nu is off, and the positions are stepped along a per-point
    L-BFGS direction. What is off costs nothing.

    Args:
        total_steps: iterations of the training.
        switch: where exploitation starts: a fraction of `total_steps` in (0, 1] if a float, an
            iteration if an int (`total_steps`: never). The paper: 29/30.
        multiplier: `"histogram"` for an `EnergyHistogram` with its defaults and a warm-up of a
            twelfth of the run; an `EnergyHistogram`; a number, for a constant (the control); or
            None, for off.
        curvature: `CurvatureOptions(...)` for the positions while exploiting, or None, for off.
            Its `backend` is that of the position noise too.
        squared_loss: whether `pixel_loss` turns to L2 in exploitation.
        reset_moments: whether Adam's moments start anew at the switch, in all groups; `"auto"`:
            where at least 100 iterations are left for them to settle (a restarted second moment
            is that of a few views, and its first steps are long).
        noise_scale: noise_lr of 3DGS-MCMC's position noise. 0 (the default) where the trainer
            injects it itself, as gsplat's MCMCStrategy and 3dgs-mcmc do; never both.
        noise_in_exploitation: whether that noise stays on after the switch.
        annealing: `Annealing(...)` for steps that start longer and end shorter than the trainer's
            learning rates alone would have them, in all phases; or None, for off.
        fading: `Fading(...)` for shrinking Adam's moments of random points, or None, for off.
        pooling: `Pooling(...)` for one second moment per point and parameter, or None, for off.
        adaptive: whether parts that this training shows to do nothing for it are switched off, see
            `switched_off`. Every 100 iterations that is one synchronisation with the GPU.
        log: a `RunLog` that gets one line per `observe`.
        process_group: a `torch.distributed` process group over whose ranks the energy is averaged,
            so that nu is the same on all; every rank must call `observe` as often. A loss that is
            not finite on one rank skips the step on all.

    Call order in each iteration: `pixel_loss`, backward, `observe(loss)`, `step()` of every
    optimizer. The state travels inside `param_groups[0]` of every upgraded optimizer's
    `state_dict()`, so that a trainer which saves its optimizers resumes bit for bit.

    Memory: Adam's; with curvature `LQNAdam`'s, from the switch on.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import PhaseScheduler
        >>> splats = {"means": torch.nn.Parameter(torch.ones(4, 3)),
        ...           "scales": torch.nn.Parameter(torch.zeros(4, 3))}
        >>> optimizers = {k: torch.optim.Adam([{"params": p, "lr": 0.01, "name": k}], eps=1e-15)
        ...               for k, p in splats.items()}
        >>> phases = PhaseScheduler(total_steps=60, switch=50)
        >>> optimizers = phases.upgrade(optimizers)
        >>> for _ in range(60):
        ...     render = splats["means"] * splats["scales"].exp()
        ...     loss = phases.pixel_loss(render, torch.zeros(4, 3))
        ...     loss.backward()
        ...     phases.observe(loss)
        ...     for optimizer in optimizers.values():
        ...         optimizer.step()
        ...         optimizer.zero_grad()
        >>> phases.phase
        <Phase.EXPLOITATION: 'exploitation'>

    Raises:
        ValueError: an option is outside what is allowed.
    """

    def __init__(
        self,
        total_steps: int,
        switch: float | int = PAPER_SWITCH,
        *,
        multiplier: EnergyHistogram
        | ConstantMultiplier
        | float
        | Literal["histogram"]
        | None = None,
        curvature: CurvatureOptions | None = None,
        squared_loss: bool = False,
        reset_moments: bool | Literal["auto"] = False,
        noise_scale: float = 0.0,
        noise_in_exploitation: bool = True,
        annealing: Annealing | None = Annealing(),  # noqa: B008 (immutable)
        fading: Fading | None = Fading(),  # noqa: B008 (immutable)
        pooling: Pooling | None = None,
        adaptive: bool = False,
        log: RunLog | None = None,
        process_group: Any = None,
    ) -> None:
        super().__init__()
        self.total_steps = check_count(CALL, "total_steps", total_steps, 1)
        self.switch_step = switch_iteration(switch, self.total_steps)
        self.multiplier = as_multiplier(multiplier, self.total_steps)
        check_part(CALL, "curvature", curvature, "CurvatureOptions", "history_size")
        self.curvature = curvature is not None
        self.curvature_options = curvature or CurvatureOptions()
        self.squared_loss = check_flag(CALL, "squared_loss", squared_loss)
        self.reset_moments = resets_moments(reset_moments, self.total_steps - self.switch_step)
        self.noise_scale = check_number(CALL, "noise_scale", noise_scale, 0.0)
        self.noise_in_exploitation = check_flag(
            CALL, "noise_in_exploitation", noise_in_exploitation
        )
        self.annealing = check_part(CALL, "annealing", annealing, "Annealing(...)", "factor")
        self.fading = check_part(CALL, "fading", fading, "Fading(...)", "fade")
        self.pooling = check_part(CALL, "pooling", pooling, "Pooling(...)", "pool")
        self.log = check_part(CALL, "log", log, "a RunLog", "step")
        self._over_ranks = None if process_group is None else RankMean(CALL, process_group)
        self._overrun = False
        self.num_observed = 0
        self.last_finite = torch.ones((), dtype=torch.bool)
        self._current = -1  # the iteration observed last, whose step comes next
        self.adaptive: Adaptive | None = None
        if check_flag(CALL, "adaptive", adaptive):
            from opt3dgs_optim._adaptive import Adaptive  # where it is off, it costs no import

            self.adaptive = Adaptive(self)

    @classmethod
    def install(
        cls, optimizers: OPTIMIZERS, total_steps: int, **options: Any
    ) -> tuple[PhaseScheduler, OPTIMIZERS]:
        """A scheduler and the upgraded optimizers in one line: `(phases, optimizers)`.

        Args:
            optimizers: see `upgrade`.
            total_steps, options: those of the class.
        """
        phases = cls(total_steps, **options)
        return phases, phases.upgrade(optimizers)  # pyright: ignore

    @classmethod
    def paper(cls, total_steps: int = PAPER_STEPS, **overrides: Any) -> PhaseScheduler:
        """The paper's settings, its schedule scaled to `total_steps`.

        Fixed energy range [0, 0.2] and temperature, warm-up 2,500 of 30,000, switch at 29,000,
        K = 5 consecutive pairs, L2, everything on.

        Args:
            total_steps: iterations of the training.
            overrides: options of the class, instead of the paper's.
        """
        check_count(f"{CALL}.paper", "total_steps", total_steps, 1)
        settings: dict[str, Any] = {
            "switch": PAPER_SWITCH,
            "annealing": None,
            "fading": None,
            "curvature": CurvatureOptions(),
            "squared_loss": True,
            "reset_moments": True,
            "multiplier": EnergyHistogram.paper(warmup=round(total_steps * PAPER_WARMUP)),
            **overrides,
        }
        return cls(total_steps, **settings)

    # -- where the training is -----------------------------------------------------------------

    @property
    def iteration(self) -> int:
        """The iteration whose loss comes next, from 0."""
        return self._current + 1

    @property
    def phase(self) -> Phase:
        """The phase of the iteration whose loss comes next; what `pixel_loss` goes by."""
        return self._phase_of(self.iteration)

    @property
    def exploiting(self) -> bool:
        """Whether the iteration observed last, whose step comes next, is exploitation."""
        return self._phase_of(self._current) is Phase.EXPLOITATION

    def annealing_factor(self, name: str | None) -> float | None:
        """The factor on the next step of a parameter of that name; None where annealing is off."""
        if self.annealing is None:
            return None
        return self.annealing.factor(name, max(self._current, 0) / self.total_steps)

    @property
    def given_noise(self) -> CovarianceNoise | None:
        """The position noise that the options give the next step, or None."""
        off = self.exploiting and not self.noise_in_exploitation
        return None if off else self._noise

    @property
    def noise(self) -> CovarianceNoise | None:
        """The position noise of the next step, or None: `given_noise`, unless it is resting."""
        return None if "noise" in self.switched_off else self.given_noise

    @property
    def switched_off(self) -> Mapping[str, str]:
        """Parts that `adaptive=True` has switched off, with the reason of each.

        `multiplier` and `curvature` for good; `noise` and `view_centering` until they are of use
        again; `epoch_pairs`: pairs are taken between consecutive steps instead.
        """
        return {} if self.adaptive is None else self.adaptive.reasons

    @property
    def accepted_share(self) -> Tensor | None:
        """Share of the last step's candidate pairs that were accepted, 0-d; None before any."""
        return None if self._positions is None else self._positions.accepted_share

    def _phase_of(self, iteration: int) -> Phase:
        exploiting = iteration >= self.switch_step
        return Phase.EXPLOITATION if exploiting else Phase.EXPLORATION

    # -- the lines in a trainer ----------------------------------------------------------------

    def observe(
        self,
        loss: Tensor | float,
        *,
        iteration: int | None = None,
        view: Hashable | None = None,
    ) -> None:
        """Take the loss of this iteration: once, after backward, before the optimizers step.

        Never synchronises with the GPU. A non-finite loss leaves the histogram alone, and the
        steps that follow it are skipped.

        Args:
            loss: the total training loss, 0-d; detached here. With gradient accumulation, once
                per optimizer step, with the mean over its batches; with a GradScaler, unscaled.
            iteration: the trainer's own count, where it may differ from the number of calls.
            view: which view was rendered, for `energy="view_centered"`.
        """
        if iteration is not None:
            check_count(f"{CALL}.observe", "iteration", iteration, 0)
        self._current = self.iteration if iteration is None else iteration
        self.num_observed += 1
        # Trainers that count from 1 end at total_steps.
        if self._current > self.total_steps and not self._overrun:
            self._overrun = True
            warnings.warn(
                f"{CALL}: iteration {self._current} of total_steps={self.total_steps}: the switch "
                "came too early for this run; pass the training's number of iterations",
                stacklevel=2,
            )
        value = loss if isinstance(loss, Tensor) else torch.tensor(float(loss))
        value = value.detach().reshape(())
        value = self.over_ranks(value)
        finite = torch.isfinite(value)
        if self.last_finite.device == finite.device:
            self.last_finite.copy_(finite)  # in place: a CUDA graph of a step reads it
        else:
            self.last_finite = finite
        # In exploitation nu is off, and the loss is another one: it would spoil the histogram.
        if self.multiplier is not None and not self.exploiting:
            self.multiplier.observe(value, view=view)
        if self.log is not None:
            phase = self._phase_of(self._current).value
            self.log.step(self._current, phase=phase, energy=value, **self.log_values())
        if self.adaptive is not None:
            self.adaptive.observed(value, view)

    def over_ranks(self, values: Tensor) -> Tensor:
        """Means of `values` over the process group, or `values` where there is none."""
        return values if self._over_ranks is None else self._over_ranks(values)

    def log_values(self) -> dict[str, Tensor]:
        """What this step's line of a run log should hold, 0-d: nu and the accepted share.

        nu only where it is adapted (after the warm-up, while exploring); the accepted share while
        exploiting, as of the last `step()`.
        """
        values: dict[str, Tensor] = {}
        multiplier = self.multiplier
        if multiplier is not None and not self.exploiting:
            if multiplier.num_observed > multiplier.warmup:
                values["nu"] = multiplier.multiplier
        elif self.accepted_share is not None:
            values["accepted"] = self.accepted_share
        return values

    def pixel_loss(self, render: Tensor, target: Tensor) -> Tensor:
        """The photometric term: mean |error| while exploring, mean error^2 while exploiting.

        Args:
            render, target: images of one shape, in 0..1.

        Raises:
            ValueError: their shapes differ.
        """
        if render.shape != target.shape:
            raise ValueError(
                f"{CALL}.pixel_loss: render has shape {tuple(render.shape)} and target "
                f"{tuple(target.shape)}, but one shape is needed"
            )
        error = render - target
        if self.squared_loss and self.phase is Phase.EXPLOITATION:
            return error.square().mean()
        return error.abs().mean()

    # -- state -----------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Iteration and histogram, as plain floats and lists."""
        return {
            "iteration": self.iteration,
            "num_observed": self.num_observed,
            "multiplier": None if self.multiplier is None else self.multiplier.state_dict(),
            **({} if self.adaptive is None else {"adaptive": self.adaptive.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`; ValueError if its histogram does not fit this scheduler's."""
        call = f"{CALL}.load_state_dict"
        check_keys(call, state, ("iteration", "num_observed", "multiplier"))
        iteration = check_whole(call, "iteration", state["iteration"])
        num_observed = check_whole(call, "num_observed", state["num_observed"])
        saved = state["multiplier"]
        check_loadable(call, state, self.adaptive is not None)
        if self.adaptive is not None:
            self.adaptive.load_state_dict(state.get("adaptive"))
        if self.multiplier is not None and saved is not None:
            self.multiplier.load_state_dict(saved)
        self._current = iteration - 1
        self.num_observed = num_observed

    def __repr__(self) -> str:
        lines = [f"total_steps={self.total_steps}, switch_step={self.switch_step}"]
        lines += scheduler_lines(self)
        if self.curvature:
            lines.append(curvature_line(self.curvature_options, self.accepted_share))
        else:
            lines.append("curvature=None")
        return block(CALL, lines)
