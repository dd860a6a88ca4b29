"""The phase scheduler: one object that owns iteration, phase and energy for a whole training."""

from __future__ import annotations

import enum
from collections.abc import Callable, Hashable, Mapping
from typing import Any, Literal, TypeVar, overload

import torch
from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim._checks import check_count, check_flag, check_number
from opt3dgs_optim._groups import GAUSSIAN_NAMES, canonical_name
from opt3dgs_optim._phased import PhasedAdam, check_upgradable, named_groups
from opt3dgs_optim.energy import EnergyHistogram
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.multiplier import ConstantMultiplier
from opt3dgs_optim.noise import CovarianceNoise
from opt3dgs_optim.runlog import RunLog

CALL = "PhaseScheduler"
PAPER_STEPS = 30_000
PAPER_SWITCH = 29_000 / PAPER_STEPS
PAPER_WARMUP = 2_500 / PAPER_STEPS
SPLATS = TypeVar("SPLATS", bound=Mapping[str, Tensor])


class Phase(enum.Enum):
    """What a training is doing."""

    EXPLORATION = "exploration"
    EXPLOITATION = "exploitation"


class PhaseScheduler:
    """Put Opt3DGS's two phases into the optimizers of an existing 3DGS trainer.

    Exploration: Adam's step on every Gaussian parameter is multiplied by nu. Exploitation: the
    pixel loss turns from L1 to L2, Adam's moments start anew, nu is off, and the positions are
    stepped along a per-point L-BFGS direction. Every part can be off by itself, and then costs
    nothing.

    Args:
        total_steps: iterations of the training.
        switch: where exploitation starts: a fraction of `total_steps` in (0, 1] if a float, an
            iteration if an int (`total_steps`: never). The paper: 29/30.
        multiplier: `"histogram"` for an `EnergyHistogram` with its defaults and a warm-up of a
            twelfth of the run; an `EnergyHistogram`; a number, for a constant (the control); or
            None, for off.
        curvature: `CurvatureOptions(...)` for the positions while exploiting, or None, for off.
        squared_loss: whether `pixel_loss` turns to L2 in exploitation.
        reset_moments: whether Adam's moments start anew at the switch, in all groups.
        noise_scale: noise_lr of 3DGS-MCMC's position noise. 0 (the default) where the trainer
            injects it itself, as gsplat's MCMCStrategy and 3dgs-mcmc do; never both.
        noise_in_exploitation: whether that noise stays on after the switch.
        log: a `RunLog` that gets one line per `observe`.

    Call order in each iteration: `pixel_loss`, backward, `observe(loss)`, `step()` of every
    optimizer. The state travels inside `param_groups[0]` of every upgraded optimizer's
    `state_dict()`, so that a trainer which saves its optimizers resumes bit for bit.

    Example:
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
        | None = "histogram",
        curvature: CurvatureOptions | None = CurvatureOptions(),  # noqa: B008 (immutable)
        squared_loss: bool = True,
        reset_moments: bool = True,
        noise_scale: float = 0.0,
        noise_in_exploitation: bool = True,
        log: RunLog | None = None,
    ) -> None:
        self.total_steps = check_count(CALL, "total_steps", total_steps, 1)
        self.switch_step = _switch_step(switch, self.total_steps)
        self.multiplier = _as_multiplier(multiplier, self.total_steps)
        self.curvature = curvature is not None
        self.curvature_options = curvature or CurvatureOptions()
        self.squared_loss = check_flag(CALL, "squared_loss", squared_loss)
        self.reset_moments = check_flag(CALL, "reset_moments", reset_moments)
        self.noise_scale = check_number(CALL, "noise_scale", noise_scale, 0.0)
        self.noise_in_exploitation = check_flag(
            CALL, "noise_in_exploitation", noise_in_exploitation
        )
        self.log = log
        self.num_observed = 0
        self.last_finite = torch.ones((), dtype=torch.bool)
        self._current = -1  # the iteration observed last, whose step comes next
        self._noise: CovarianceNoise | None = None
        self._positions: PhasedAdam | None = None

    @classmethod
    def paper(cls, total_steps: int = PAPER_STEPS, **overrides: Any) -> PhaseScheduler:
        """The paper's settings, its schedule scaled to `total_steps`.

        Fixed energy range [0, 0.2] and temperature, warm-up 2,500 of 30,000, switch at 29,000,
        K = 5 consecutive pairs, L2, everything on.
        """
        check_count(f"{CALL}.paper", "total_steps", total_steps, 1)
        settings: dict[str, Any] = {
            "switch": PAPER_SWITCH,
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

    @property
    def noise(self) -> CovarianceNoise | None:
        """The position noise of the next step, or None."""
        return None if self.exploiting and not self.noise_in_exploitation else self._noise

    @property
    def accepted_share(self) -> Tensor | None:
        """Share of the last step's candidate pairs that were accepted, 0-d; None before any."""
        return None if self._positions is None else self._positions.accepted_share

    def _phase_of(self, iteration: int) -> Phase:
        exploiting = iteration >= self.switch_step
        return Phase.EXPLOITATION if exploiting else Phase.EXPLORATION

    # -- the lines in a trainer ----------------------------------------------------------------

    @overload
    def upgrade(
        self, optimizers: dict[str, Any], gaussians: Any = None
    ) -> dict[str, Optimizer]: ...
    @overload
    def upgrade(self, optimizers: Optimizer, gaussians: Any = None) -> Optimizer: ...
    def upgrade(
        self,
        optimizers: dict[str, Any] | Optimizer,
        gaussians: Mapping[str, Tensor] | Callable[[], Mapping[str, Tensor]] | None = None,
    ) -> dict[str, Optimizer] | Optimizer:
        """Return the trainer's optimizer(s) with both phases inside.

        Learning rates, betas, eps, names and state are kept; learning rates are never changed.

        Args:
            optimizers: a dict of `torch.optim.Adam`, one per parameter (gsplat, nerfstudio), or
                one Adam with named groups (INRIA, 3dgs-mcmc). Those that hold no Gaussian
                parameter (camera poses, exposures) come back as they are, or stay plain Adam.
            gaussians: the trainer's dict of raw tensors (`scales, quats, opacities`), or a
                function returning it; needed with `noise_scale > 0`.

        Raises:
            TypeError: an optimizer of Gaussian parameters is not torch's Adam.
            ValueError: no group holds positions, a name occurs twice, or `gaussians` is missing.
        """
        self._noise = self._make_noise(gaussians)
        if isinstance(optimizers, Optimizer):
            names = named_groups(optimizers)
            _require_positions(names)
            return self._take(check_upgradable(optimizers, "the optimizer"))
        if not isinstance(optimizers, Mapping):
            raise TypeError(
                f"{CALL}.upgrade: optimizers is a {type(optimizers).__name__}, but a dict of "
                "optimizers, or one optimizer with named groups, is needed"
            )
        _require_positions(list(optimizers))
        upgraded: dict[str, Optimizer] = {}
        for name, optimizer in optimizers.items():
            if canonical_name(name) is None:
                upgraded[name] = optimizer
                continue
            adam = check_upgradable(optimizer, f"optimizers[{name!r}]")
            named_groups(adam)
            for group in adam.param_groups:
                group.setdefault("name", name)
            upgraded[name] = self._take(adam)
        return upgraded

    def _take(self, optimizer: Any) -> PhasedAdam:
        phased = PhasedAdam(optimizer, self)
        if any(canonical_name(group.get("name")) == "means" for group in phased.param_groups):
            self._positions = phased
        return phased

    def _make_noise(self, gaussians: Any) -> CovarianceNoise | None:
        if self.noise_scale == 0:
            return None
        if gaussians is None:
            raise ValueError(
                f"{CALL}.upgrade: gaussians=None, but noise_scale={self.noise_scale} needs the "
                "trainer's dict of scales, quats and opacities (or a function returning it)"
            )
        return CovarianceNoise(gaussians, self.noise_scale)

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
            loss: the total training loss, 0-d; detached here.
            iteration: the trainer's own count, where it may differ from the number of calls.
            view: which view was rendered, for `energy="view_centered"`.
        """
        if iteration is not None:
            check_count(f"{CALL}.observe", "iteration", iteration, 0)
        self._current = self.iteration if iteration is None else iteration
        self.num_observed += 1
        value = loss if isinstance(loss, Tensor) else torch.tensor(float(loss))
        value = value.detach().reshape(())
        self.last_finite = torch.isfinite(value)
        # In exploitation nu is off, and the loss is another one: it would spoil the histogram.
        if self.multiplier is not None and not self.exploiting:
            self.multiplier.observe(value, view=view)
        if self.log is not None:
            phase = self._phase_of(self._current).value
            self.log.step(self._current, phase=phase, energy=value, **self.log_values())

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
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict()`; ValueError if its histogram does not fit this scheduler's."""
        missing = sorted({"iteration", "num_observed", "multiplier"} - set(state))
        if missing:
            raise ValueError(f"{CALL}.load_state_dict: keys {missing} are missing")
        saved = state["multiplier"]
        if self.multiplier is not None and saved is not None:
            self.multiplier.load_state_dict(saved)
        self._current = int(state["iteration"]) - 1
        self.num_observed = int(state["num_observed"])

    def __repr__(self) -> str:
        return (
            f"{CALL}(iteration={self.iteration}, total_steps={self.total_steps}, "
            f"phase={self.phase.value}, switch_step={self.switch_step}, "
            f"multiplier={self.multiplier!r}, "
            f"curvature={self.curvature_options if self.curvature else None!r})"
        )


def _switch_step(switch: float | int, total_steps: int) -> int:
    if isinstance(switch, int) and not isinstance(switch, bool):
        return check_count(CALL, "switch", switch, 0, total_steps)
    fraction = check_number(CALL, "switch", switch, 0.0, 1.0)
    return round(fraction * total_steps)


def _as_multiplier(value: Any, total_steps: int) -> EnergyHistogram | ConstantMultiplier | None:
    if value is None or isinstance(value, (EnergyHistogram, ConstantMultiplier)):
        return value
    if value == "histogram":
        # An automatic range needs a few energies even in the shortest run.
        return EnergyHistogram(warmup=max(4, round(total_steps * PAPER_WARMUP)))
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return ConstantMultiplier(value)
    raise ValueError(
        f"{CALL}: multiplier={value!r}, but 'histogram', an EnergyHistogram, a number or None is "
        "needed"
    )


def _require_positions(names: list[str]) -> None:
    if not any(canonical_name(name) == "means" for name in names):
        raise ValueError(
            f"{CALL}.upgrade: none of the names {names} stands for positions; "
            f"{' or '.join(GAUSSIAN_NAMES['means'])} is needed"
        )
