"""What some arms of the study change in the trainer around the optimizers."""

from __future__ import annotations

import math
from typing import Any

import torch
from splatting.fit import Fit, FitOptions
from splatting.scenes import Scene
from torch import Tensor

from study.full_matrix import FullMatrixAdam
from study.own_statistics import OwnStep
from study.study_arm import StudyArm
from study.view_pairs import SameViewAdam

OPACITY_DECAY = 1e-3  # of the opacity in an iteration, as a step of its logit
SCALE_DECAY = 1e-5  # of the log of the scales
# AdamW-GS's schedule of the two, as shares of the run: 3,000, 1,000 and 15,000 of 30,000
DECAY_STARTS = {"opacities": 0.1, "scales": 1 / 30}
DECAY_STOP = 0.5
HOST_OPTIONS = (
    "beta2",
    "visible",
    "average",
    "decoupled",
    "regularisers",
    "noise",
    "same_view",
    "matrix",
    "relative_eps",
)
NOISY_ROWS = ("visible", "hidden")
EPS = 1e-15  # the trainer's


class StudyFit(Fit):
    """`Fit` with the host options of a study arm.

    beta2: another beta2 in all optimizers. visible: step only rows that this view's loss reaches.
    average: from this share of the run on, evaluate the mean of the iterates. decoupled: opacity
    and scale regularisation as a decay outside Adam (as AdamW does with weights), `"scheduled"`
    for AdamW-GS's part of the run instead of all of it. regularisers: a
    factor on both of them inside the loss, 0 or more. noise: `"visible"` for position noise only
    on the rows that this view's loss reaches, `"hidden"` for the others only; of an arm whose
    noise is the trainer's. same_view: curvature pairs between two visits of one view; of an arm
    with curvature. matrix: a matrix of second moments for the positions, with this eigenvalue
    floor (see `FullMatrixAdam`); of an arm with torch's Adam. relative_eps: Adam's eps of some
    parameters, by name, as a share of their root mean square gradient.

    Raises:
        ValueError: a host option is unknown, or its value is outside what is allowed.
    """

    def __init__(
        self, scene: Scene, arm: StudyArm, options: FitOptions, mean_nu: float | None = None
    ) -> None:
        _check_host(arm)
        self.host = arm.host
        self.study_arm = arm
        self.mean: dict[str, Tensor] = {}
        self.num_averaged = 0
        self.seen: Tensor | None = None  # [N] bool, rows that this view's loss reaches
        super().__init__(scene, arm.arm(scene), options, mean_nu)
        if "beta2" in self.host:
            for optimizer in self.optimizers.values():
                optimizer.param_groups[0]["betas"] = (0.9, self.host["beta2"])
        self._change_positions()
        if self.phases is not None and isinstance(self.phases.annealing, OwnStep):
            self.phases.annealing.watch(self)

    def _change_positions(self) -> None:
        """Give the positions the optimizer that the arm asks for."""
        means = self.optimizers["means"]
        if self.host.get("same_view"):
            if self.phases is None or not self.phases.curvature:
                raise ValueError(
                    f"StudyFit: arm {self.study_arm.name}: same_view=True, but it has no curvature"
                )
            self.optimizers["means"] = SameViewAdam.of(means, len(self.scene.train))
        if "matrix" in self.host:
            (old,) = means.param_groups
            group = {key: old[key] for key in ("params", "lr", "betas", "eps", "name")}
            self.optimizers["means"] = FullMatrixAdam([group], floor=self.host["matrix"])

    def _next_view(self) -> int:
        view = super()._next_view()
        means = self.optimizers["means"]
        if isinstance(means, SameViewAdam):
            means.view = view
        return view

    def _regularisers(self) -> Tensor:
        factor = 0.0 if self.host.get("decoupled") else self.host.get("regularisers", 1.0)
        return factor * super()._regularisers() if factor else torch.zeros(())

    def _step_optimizers(self) -> None:
        if "visible" in self.host or "noise" in self.host:
            # The regularisers reach every row; the image reaches the positions of visible ones.
            means_grad = self.gaussians["means"].grad
            assert means_grad is not None
            self.seen = (means_grad != 0).any(dim=1)
        if "relative_eps" in self.host:
            self._set_eps()
        if self.host.get("visible"):
            for optimizer in self.optimizers.values():
                optimizer.step(visible=self.seen)  # pyright: ignore[reportCallIssue]
                optimizer.zero_grad(set_to_none=True)
        else:
            super()._step_optimizers()
        if self.host.get("decoupled"):
            self._decay()

    def _set_eps(self) -> None:
        for name, share in self.host["relative_eps"].items():
            (group,) = self.optimizers[name].param_groups
            state = self.optimizers[name].state.get(self.gaussians[name])
            if not state:
                continue
            correction = 1 - group["betas"][1] ** float(state["step"])
            typical = float((state["exp_avg_sq"].mean() / correction).sqrt())
            group["eps"] = max(share * typical, EPS)

    @torch.no_grad()
    def _decay(self) -> None:
        if self._decays("opacities"):
            opacity = torch.sigmoid(self.gaussians["opacities"])
            self.gaussians["opacities"].sub_(OPACITY_DECAY * opacity * (1 - opacity))
        if self._decays("scales"):
            self.gaussians["scales"].sub_(SCALE_DECAY)

    def _decays(self, name: str) -> bool:
        progress = self.iteration / self.options.iterations
        scheduled = DECAY_STARTS[name] <= progress < DECAY_STOP
        return scheduled or self.host["decoupled"] != "scheduled"

    @torch.no_grad()
    def _inject_noise(self) -> None:
        rows = self.host.get("noise")
        if rows is None:
            super()._inject_noise()
            return
        assert self.seen is not None
        # All rows draw, so that the random numbers are those of the arm without this option.
        quiet = ~self.seen if rows == "visible" else self.seen
        before = self.gaussians["means"][quiet]
        super()._inject_noise()
        self.gaussians["means"][quiet] = before

    def step(self) -> Tensor:
        """One iteration."""
        loss = super().step()
        start = self.host.get("average")
        if start is not None and self.iteration > start * self.options.iterations:
            self._average()
        return loss

    @torch.no_grad()
    def _average(self) -> None:
        self.num_averaged += 1
        for name, param in self.gaussians.items():
            if name not in self.mean or self.mean[name].shape != param.shape:
                self.mean[name], self.num_averaged = param.detach().clone(), 1
            self.mean[name].lerp_(param.detach(), 1.0 / self.num_averaged)

    def evaluate(self) -> dict[str, float]:
        """As `Fit.evaluate`, of the mean of the iterates where the arm averages them."""
        if self.num_averaged == 0:
            return super().evaluate()
        own = self.gaussians
        self.gaussians = {name: torch.nn.Parameter(mean) for name, mean in self.mean.items()}
        try:
            return super().evaluate()
        finally:
            self.gaussians = own

    def state_bytes(self) -> int:
        """Memory of the optimizers' state, in bytes."""
        tensors: list[Any] = [
            value
            for optimizer in self.optimizers.values()
            for state in optimizer.state.values()
            for value in state.values()
        ]
        return sum(t.numel() * t.element_size() for t in tensors if isinstance(t, Tensor))


def _check_host(arm: StudyArm) -> None:
    call, host = f"StudyFit: arm {arm.name}", arm.host
    unknown = set(host) - set(HOST_OPTIONS)
    if unknown:
        raise ValueError(
            f"{call}: unknown host options {sorted(unknown)}; there are {', '.join(HOST_OPTIONS)}"
        )
    factor = host.get("regularisers", 1.0)
    if not 0.0 <= factor < math.inf:
        raise ValueError(f"{call}: regularisers={factor!r}, but a number from 0 on is needed")
    if "regularisers" in host and host.get("decoupled"):
        raise ValueError(f"{call}: regularisers={factor!r}, but decoupled=True takes them away")
    rows = host.get("noise")
    if rows is not None and rows not in NOISY_ROWS:
        raise ValueError(f"{call}: noise={rows!r}, but one of {', '.join(NOISY_ROWS)} is needed")
    if rows is not None and arm.options is not None:
        raise ValueError(
            f"{call}: noise={rows!r}, but its optimizers inject the noise: the trainer must"
        )
    if "matrix" in host and arm.options is not None:
        raise ValueError(
            f"{call}: matrix={host['matrix']!r}, but its positions are stepped by the scheduler's "
            "optimizer: torch's Adam must"
        )
