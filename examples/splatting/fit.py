"""The trainer of the examples: one scene, one arm, iteration by iteration, with checkpoints."""

from __future__ import annotations

import os
import pickle
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.nn import Parameter

from splatting.arms import Arm
from splatting.density import MCMCDensityControl, Optimizers, add_noise, regularisers
from splatting.gaussians import (
    DEFAULT_PRESET,
    MCMC_PRESET,
    gaussians_from_points,
    stock_learning_rates,
)
from splatting.metrics import photometric_loss, psnr, ssim
from splatting.rasterizer import Rendering, render
from splatting.scenes import Scene, View

LR_DECAY = 0.01  # of the positions' learning rate over the run
TRAIN_VIEWS_EVALUATED = 8
SH_DEGREE_INTERVALS = 30  # of a run; after each one degree more is used
DRAWS = ("noise", "order", "density", "start")  # one random generator each, seeded in this order


@dataclass(frozen=True)
class FitOptions:
    """How to fit; two runs are comparable if these agree."""

    iterations: int = 1500
    points: int = 2000  # the most Gaussians; with clone and split the most at the start
    seed: int = 0
    sh_degree: int = 0
    threshold: float = 1.0  # factor on that of clone and split

    def __post_init__(self) -> None:
        for name in ("iterations", "points"):
            if getattr(self, name) < 1:
                raise ValueError(f"FitOptions: {name}={getattr(self, name)}, must be at least 1")
        if not self.threshold > 0:
            raise ValueError(f"FitOptions: threshold={self.threshold}, must be above 0")


class DensityControl(Protocol):
    """What moves, adds and removes Gaussians between the steps."""

    state: dict[str, Any]  # part of a checkpoint

    def step(
        self, iteration: int, gaussians: dict[str, Parameter], optimizers: Optimizers, /
    ) -> int:
        """Called after the optimizers' step, with the iteration from 0; how many were relocated."""
        ...


class Fit:
    """The state of one training: Gaussians, optimizers, schedules, random generators.

    Args:
        scene: views to train on and to judge by.
        arm: what its optimizers have.
        options: what it shares with the trainings that it is compared with.
    """

    relocates = True  # as 3DGS-MCMC, with its noise and its regularisers

    def __init__(self, scene: Scene, arm: Arm, options: FitOptions) -> None:
        self.scene, self.arm, self.options = scene, arm, options
        self.draws = {
            name: torch.Generator().manual_seed(options.seed + i) for i, name in enumerate(DRAWS)
        }
        self.gaussians = self._initial_gaussians()
        self.rates = {k: lr * arm.rates for k, lr in stock_learning_rates(scene.extent).items()}
        self.optimizers = {
            name: torch.optim.Adam(
                [{"params": param, "lr": self.rates[name], "name": name}],
                betas=(arm.beta1, 0.999),
                eps=1e-15,
            )
            for name, param in self.gaussians.items()
        }
        self.phases = arm.scheduler(options.iterations)
        if self.phases is not None:
            self.phases.upgrade(self.optimizers)
        self.density = self._density_control()
        self.iteration = 0
        self.relocated = 0  # Gaussians that density control has moved so far
        self.views: list[int] = []  # what is left of this epoch

    def _initial_gaussians(self) -> dict[str, Parameter]:
        preset = MCMC_PRESET if self.relocates else DEFAULT_PRESET
        return gaussians_from_points(
            self.scene.points,
            self.scene.colors,
            num_points=self.options.points,
            sh_degree=self.options.sh_degree,
            generator=self.draws["start"],
            **preset,
        )

    def _density_control(self) -> DensityControl:
        return MCMCDensityControl.for_run(
            self.options.iterations,
            self.options.points,
            num_points=len(self.gaussians["means"]),
            generator=self.draws["density"],
        )

    # -- one iteration -------------------------------------------------------------------------

    def step(self) -> Tensor:
        """One iteration; returns the detached loss."""
        view = self.scene.train[self._next_view()]
        pixel_loss = None if self.phases is None else self.phases.pixel_loss
        loss = photometric_loss(self._train_image(view), view.image, pixel_loss)
        if self.relocates:
            loss = loss + regularisers(self.gaussians)
        loss.backward()
        if self.phases is not None:
            self.phases.observe(loss)
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        means = self.optimizers["means"].param_groups[0]
        if self.relocates:
            add_noise(self.gaussians, means["lr"], self.draws["noise"])
        self.relocated += self.density.step(self.iteration, self.gaussians, self.optimizers)
        self.iteration += 1
        if self.arm.decays:
            decay = LR_DECAY ** (self.iteration / self.options.iterations)
            means["lr"] = self.rates["means"] * decay
        return loss.detach()

    def _next_view(self) -> int:
        if not self.views:
            order = torch.randperm(len(self.scene.train), generator=self.draws["order"])
            self.views = order.tolist()
        return self.views.pop()

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
        """The degree of spherical harmonics in use: one more in each thirtieth of the run.

        That is every 1,000 of 30,000 iterations, and what `opt3dgs lines` prints for fewer.
        """
        intervals = SH_DEGREE_INTERVALS * self.iteration // self.options.iterations
        return min(intervals, self.options.sh_degree)

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
            "training": self._training(),
            "iteration": self.iteration,
            "relocated": self.relocated,
            "density": self.density.state,
            "gaussians": {name: param.detach() for name, param in self.gaussians.items()},
            "optimizers": {name: opt.state_dict() for name, opt in self.optimizers.items()},
            "views": self.views,
            "draws": {name: draw.get_state() for name, draw in self.draws.items()},
        }
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        torch.save(state, partial)
        os.replace(partial, path)

    def _training(self) -> list[Any]:
        """What a checkpoint must agree in: also the photos, and what is behind them."""
        photo = [*self.scene.train[0].image.shape[:2], *self.scene.background.tolist()]
        photos = [view.name for view in self.scene.train]
        kind, arm = type(self).__name__, self.arm.name
        return [self.scene.name, photo, photos, kind, arm, asdict(self.options)]

    def load(self, path: Path) -> None:
        """Go on from a checkpoint; ValueError if it is none, or one of another training."""
        try:
            state = torch.load(path, weights_only=True)
            its = state["training"]
        except (EOFError, LookupError, RuntimeError, TypeError, pickle.UnpicklingError) as error:
            raise ValueError(f"{path}: no checkpoint of this trainer: {error!r:.200}") from None
        if its != self._training():
            raise ValueError(
                f"{path}: a checkpoint of {its}, but this run is {self._training()}; choose "
                "another folder"
            )
        for name, value in state["gaussians"].items():
            fresh = Parameter(value)
            self.optimizers[name].param_groups[0]["params"] = [fresh]
            self.optimizers[name].load_state_dict(state["optimizers"][name])
            self.gaussians[name] = fresh
        self.iteration, self.views = state["iteration"], state["views"]
        self.relocated, self.density.state = state["relocated"], state["density"]
        for name, draw in state["draws"].items():
            self.draws[name].set_state(draw)


def _mean(values: list[Tensor]) -> float:
    return float(torch.stack(values).mean())
