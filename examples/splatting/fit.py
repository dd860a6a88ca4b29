"""Fit one scene with one arm: the trainer of the examples, with checkpoints and a run log."""

from __future__ import annotations

import os
import pickle
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Protocol

import torch
from torch import Tensor
from torch.nn import Parameter
from tqdm import tqdm

from opt3dgs_optim import Phase, PhaseScheduler, PositionNoise
from opt3dgs_optim.runs import RunLog, read_run
from splatting.arms import NOISE_LR, Arm
from splatting.density import MCMCDensityControl, Optimizers, regularisers
from splatting.gaussians import (
    DEFAULT_PRESET,
    MCMC_PRESET,
    gaussians_from_points,
    random_gaussians,
    stock_learning_rates,
)
from splatting.metrics import photometric_loss, psnr, ssim
from splatting.rasterizer import Rendering, render
from splatting.scenes import Scene, View
from splatting.stopping import StopRequest

LR_DECAY = 0.01  # of the positions' learning rate over the run
TRAIN_VIEWS_EVALUATED = 8
CHECKPOINT_FORMAT = 1


@dataclass(frozen=True)
class FitOptions:
    """How to fit; two runs are comparable if these agree."""

    iterations: int = 1500
    points: int = 2000  # the most Gaussians
    seed: int = 0
    init: Literal["sfm", "random"] = "sfm"
    sh_degree: int = 0
    switch: float = 29 / 30
    evaluations: int = 20
    sh_degree_interval: int = 1000  # iterations until one degree more is used, as trainers do
    rates: float = 1.0  # factor on all learning rates of the trainer

    def __post_init__(self) -> None:
        for name in ("iterations", "points", "evaluations", "sh_degree_interval"):
            if getattr(self, name) < 1:
                raise ValueError(f"FitOptions: {name}={getattr(self, name)}, must be at least 1")
        if self.init not in ("sfm", "random"):
            raise ValueError(f"FitOptions: init={self.init!r}, must be 'sfm' or 'random'")
        if not self.rates > 0:
            raise ValueError(f"FitOptions: rates={self.rates}, must be above 0")
        if not 0 < self.switch <= 1:
            raise ValueError(f"FitOptions: switch={self.switch}, must be in (0, 1]")


class DensityControl(Protocol):
    """What moves, adds and removes Gaussians between the steps."""

    state: dict[str, Any]  # part of a checkpoint

    def step(
        self, iteration: int, gaussians: dict[str, Parameter], optimizers: Optimizers, /
    ) -> int:
        """Called after the optimizers' step, with the iteration from 0; how many were relocated."""
        ...


class Fit:
    """The state of one training: Gaussians, optimizers, schedules, random generators."""

    def __init__(
        self, scene: Scene, arm: Arm, options: FitOptions, mean_nu: float | None = None
    ) -> None:
        self.scene, self.arm, self.options = scene, arm, options
        torch.manual_seed(options.seed)  # the noise
        self.order = torch.Generator().manual_seed(options.seed + 1)
        self.density_draws = torch.Generator().manual_seed(options.seed + 2)
        self.gaussians = self._initial_gaussians()
        stock = stock_learning_rates(scene.extent)
        self.rates = {name: rate * options.rates for name, rate in stock.items()}
        self.optimizers = {
            name: torch.optim.Adam(
                [{"params": param, "lr": self.rates[name], "name": name}], eps=1e-15
            )
            for name, param in self.gaussians.items()
        }
        self.phases: PhaseScheduler | None = None
        self.noise: PositionNoise | None = None  # where the trainer itself adds it
        if arm.parts is not None:
            self.phases = arm.make(options.iterations, options.switch, mean_nu, self.gaussians)
            self.phases.upgrade(self.optimizers)
        elif arm.mcmc:
            self.noise = PositionNoise(self.gaussians, NOISE_LR)
        self.density = self._density_control()
        self.iteration = 0
        self.relocated = 0  # Gaussians that density control has moved so far
        self.views: list[int] = []  # what is left of this epoch

    def _initial_gaussians(self) -> dict[str, Parameter]:
        scene, options = self.scene, self.options
        draw = torch.Generator().manual_seed(options.seed + 3)
        common: dict[str, Any] = {"sh_degree": options.sh_degree, "generator": draw}
        common.update(MCMC_PRESET if self.arm.mcmc else DEFAULT_PRESET)
        if options.init == "sfm":
            return gaussians_from_points(
                scene.points, scene.colors, num_points=options.points, **common
            )
        # A tenth of the budget to start with where density control can fill the rest.
        count = max(options.points // 10, 1) if self.arm.mcmc else options.points
        center = scene.points.median(0).values
        spread = float((scene.points - center).abs().quantile(0.9)) / scene.extent
        return random_gaussians(scene.extent, count, center=center, spread=spread, **common)

    def _density_control(self) -> DensityControl | None:
        if not self.arm.mcmc:
            return None
        return MCMCDensityControl.for_run(
            self.options.iterations,
            self.options.points,
            num_points=len(self.gaussians["means"]),
            generator=self.density_draws,
        )

    # -- one iteration -------------------------------------------------------------------------

    def step(self) -> Tensor:
        """One iteration; returns the detached loss."""
        view = self.scene.train[self._next_view()]
        image = self._train_image(view)
        pixel_loss = None if self.phases is None else self.phases.pixel_loss
        loss = photometric_loss(image, view.image, pixel_loss)
        if self.arm.mcmc:
            loss = loss + regularisers(self.gaussians)
        loss.backward()
        if self.phases is not None:
            self.phases.observe(loss, iteration=self.iteration)
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        if self.noise is not None:
            with torch.no_grad():
                lr = self.optimizers["means"].param_groups[0]["lr"]
                self.noise.add_to(self.gaussians["means"], lr)
        if self.density is not None:
            self.relocated += self.density.step(self.iteration, self.gaussians, self.optimizers)
        self.iteration += 1
        decay = LR_DECAY ** (self.iteration / self.options.iterations)
        self.optimizers["means"].param_groups[0]["lr"] = self.rates["means"] * decay
        return loss.detach()

    def _next_view(self) -> int:
        if not self.views:
            self.views = torch.randperm(len(self.scene.train), generator=self.order).tolist()
        return self.views.pop()

    @property
    def phase(self) -> Phase:
        """The phase of the iteration that comes next."""
        return Phase.EXPLORATION if self.phases is None else self.phases.phase

    @property
    def mean_nu(self) -> float | None:
        """Mean of nu since the warm-up, or None where nu is off."""
        parts = [] if self.phases is None else self.phases.parts
        means = [part.mean_multiplier for part in parts if hasattr(part, "mean_multiplier")]  # pyright: ignore
        return float(means[0]) if means else None

    # -- looking at it -------------------------------------------------------------------------

    @torch.no_grad()
    def image(self, view: View) -> Tensor:
        """The render of a view, [H, W, 3] in 0..1."""
        return self._render(view).image.clamp(0, 1)

    def _train_image(self, view: View) -> Tensor:
        return self._render(view).image

    def _render(self, view: View, offset: Tensor | None = None) -> Rendering:
        degree, behind = self.active_sh_degree, self.scene.background
        return render(
            self.gaussians, view.camera, sh_degree=degree, background=behind, offset=offset
        )

    @property
    def active_sh_degree(self) -> int:
        """The degree of spherical harmonics in use: one more each `sh_degree_interval`."""
        return min(self.iteration // self.options.sh_degree_interval, self.options.sh_degree)

    def compile_kernels(self) -> None:
        """Have the rasterizer compiled, or loaded from its cache, before the run's clock starts."""
        copy = {name: param.detach().requires_grad_() for name, param in self.gaussians.items()}
        view = self.scene.train[0]
        image = render(copy, view.camera, sh_degree=self.options.sh_degree).image
        photometric_loss(image, view.image).backward()

    def evaluate(self) -> dict[str, float]:
        """PSNR and SSIM of the test views, PSNR of a few train views, number of Gaussians."""
        test = [(self.image(view), view.image) for view in self.scene.test]
        stride = max(len(self.scene.train) // TRAIN_VIEWS_EVALUATED, 1)
        train = [(self.image(view), view.image) for view in self.scene.train[::stride]]
        return {
            "psnr": _mean([psnr(a, b) for a, b in test]),
            "ssim": _mean([ssim(a, b) for a, b in test]),
            "train_psnr": _mean([psnr(a, b) for a, b in train]),
            "num_points": float(len(self.gaussians["means"])),
        }

    # -- checkpoints ---------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write a checkpoint; an old one stays whole until the new one is."""
        state = {
            "format": CHECKPOINT_FORMAT,
            "arm": self.arm.name,
            "scene": self.scene.name,
            "options": asdict(self.options),
            "photos": self._photos(),
            "iteration": self.iteration,
            "relocated": self.relocated,
            "density": {} if self.density is None else self.density.state,
            "gaussians": {name: param.detach() for name, param in self.gaussians.items()},
            "optimizers": {name: opt.state_dict() for name, opt in self.optimizers.items()},
            "views": self.views,
            "random": [
                torch.get_rng_state(),
                self.order.get_state(),
                self.density_draws.get_state(),
            ],
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        torch.save(state, partial)
        os.replace(partial, path)

    def _photos(self) -> list[float]:
        """Height and width of the first, and the background: what a checkpoint must agree in."""
        return [*self.scene.train[0].image.shape[:2], *self.scene.background.tolist()]

    def load(self, path: Path, trunk: str | None = None) -> None:
        """Go on from a checkpoint; ValueError if it is none, or of another scene, arm or options.

        Args:
            path: the file.
            trunk: the arm that it is of, where this run branches off another arm's.
        """
        state = _loaded(path)
        arm = trunk or self.arm.name
        mine = (self.scene.name, arm, asdict(self.options), CHECKPOINT_FORMAT)
        options = asdict(FitOptions()) | state["options"]  # older files lack newer options
        its = (state["scene"], state["arm"], options, state["format"])
        shown = self._photos()
        if state.get("photos", shown) != shown:
            raise ValueError(
                f"{path}: a checkpoint of photos of other sizes or on another background (height, "
                f"width, background: {state['photos']}), but those of this run are {shown}; choose "
                "another folder"
            )
        if mine != its:
            raise ValueError(
                f"{path}: a checkpoint of {its}, but this run is {mine}; choose another folder"
            )
        for name, value in state["gaussians"].items():
            fresh = Parameter(value)
            self.optimizers[name].param_groups[0]["params"] = [fresh]
            self.optimizers[name].load_state_dict(state["optimizers"][name])
            self.gaussians[name] = fresh
        self.iteration, self.views = state["iteration"], state["views"]
        self.relocated = state.get("relocated", 0)
        if self.density is not None:
            self.density.state = state.get("density") or {}
        torch.set_rng_state(state["random"][0])
        self.order.set_state(state["random"][1])
        self.density_draws.set_state(state["random"][2])
        if self.phases is not None:  # a trunk may be stock, whose checkpoint has no clock
            self.phases.current = self.iteration - 1


def run(
    fit: Fit, folder: Path, metadata: dict[str, Any] | None = None, *, quiet: bool = True
) -> dict[str, float]:
    """Train to the end, or on from where an earlier call was stopped; return the last metrics.

    Writes `folder/log.jsonl` and `folder/checkpoint.pt`. The log counts this process's seconds, so
    that other trainings beside it change nothing. On Ctrl-C the iteration is finished, its
    checkpoint written, and KeyboardInterrupt raised; a second Ctrl-C stops at once.
    """
    checkpoint, path, total = folder / "checkpoint.pt", folder / "log.jsonl", fit.options.iterations
    if checkpoint.exists():
        fit.load(checkpoint)
    about = {"arm": fit.arm.name, "scene": fit.scene.name, **asdict(fit.options)}
    about |= metadata or {}
    if fit.iteration == total:
        _say_finished(fit, path)
        return fit.evaluate()
    fit.compile_kernels()
    # Lines past the checkpoint, or of a run without one, are superseded.
    if path.exists():
        log = RunLog.resume(path, iteration=fit.iteration, metadata=about, clock=time.process_time)
    else:
        log = RunLog(path, metadata=about, clock=time.process_time)
    every = max(total // fit.options.evaluations, 1)
    bar = tqdm(total=total, initial=fit.iteration, desc=fit.arm.name, unit="it", disable=quiet)
    with log, bar, StopRequest() as stop:
        metrics = _evaluate(fit, log)
        while fit.iteration < total:
            phase = fit.phase
            loss = fit.step()
            numbers = {} if fit.phases is None else fit.phases.numbers()
            log.step(fit.iteration, phase=phase.value, loss=loss, **numbers)
            look = fit.iteration % every == 0 or fit.iteration == total
            if look:
                metrics = _evaluate(fit, log)
            if look or stop.requested:
                with log.paused():
                    fit.save(checkpoint)
            bar.update()
            if not quiet and fit.iteration % 10 == 0:
                shown = f"loss {float(loss):.4f}, PSNR {metrics['psnr']:.2f} dB, {phase.value}"
                bar.set_postfix_str(shown)
            if stop.requested:
                log.event("interrupted", fit.iteration)
                raise KeyboardInterrupt
        log.event("finished", fit.iteration, mean_nu=fit.mean_nu)
    return metrics


def _loaded(path: Path) -> dict[str, Any]:
    """What `Fit.save` has written; ValueError where a file is something else."""
    try:
        state = torch.load(path, weights_only=True)
    except (EOFError, KeyError, OSError, RuntimeError, ValueError, pickle.UnpicklingError) as error:
        raise ValueError(f"{path}: no checkpoint can be read from it: {error!r:.200}") from None
    if not isinstance(state, dict) or not {"scene", "arm", "options", "format"} <= state.keys():
        raise ValueError(f"{path}: no checkpoint of this trainer")
    return state


def _say_finished(fit: Fit, path: Path) -> None:
    """Of a run that was stopped after its last checkpoint, and before its log said so."""
    if not any(event["event"] == "finished" for event in read_run(path).events):
        with RunLog.resume(path, iteration=fit.iteration, clock=time.process_time) as log:
            _evaluate(fit, log)
            log.event("finished", fit.iteration, mean_nu=fit.mean_nu)


def _evaluate(fit: Fit, log: RunLog) -> dict[str, float]:
    with log.paused():
        metrics = fit.evaluate()
    log.evaluation(fit.iteration, **metrics)
    return metrics


def _mean(values: list[Tensor]) -> float:
    return float(torch.stack(values).mean())
