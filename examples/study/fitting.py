"""What some arms of the study change in the trainer around the optimizers."""

from __future__ import annotations

from typing import Any

import torch
from splatting.fit import Fit, FitOptions
from splatting.scenes import Scene
from torch import Tensor

from study.arms import StudyArm

OPACITY_DECAY = 1e-3  # of the opacity in an iteration, as a step of its logit
SCALE_DECAY = 1e-5  # of the log of the scales
HOST_OPTIONS = ("beta2", "visible", "average", "decoupled")


class StudyFit(Fit):
    """`Fit` with the host options of a study arm.

    beta2: another beta2 in all optimizers. visible: step only rows that this view's loss reaches.
    average: from this share of the run on, evaluate the mean of the iterates. decoupled: opacity
    and scale regularisation as a decay outside Adam (as AdamW does with weights).
    """

    def __init__(
        self, scene: Scene, arm: StudyArm, options: FitOptions, mean_nu: float | None = None
    ) -> None:
        unknown = set(arm.host) - set(HOST_OPTIONS)
        if unknown:
            raise ValueError(f"arm {arm.name}: unknown host options {sorted(unknown)}")
        self.host = arm.host
        self.study_arm = arm
        self.mean: dict[str, Tensor] = {}
        self.num_averaged = 0
        super().__init__(scene, arm.arm(scene), options, mean_nu)
        if "beta2" in self.host:
            for optimizer in self.optimizers.values():
                optimizer.param_groups[0]["betas"] = (0.9, self.host["beta2"])

    def _regularisers(self) -> Tensor:
        return torch.zeros(()) if self.host.get("decoupled") else super()._regularisers()

    def _step_optimizers(self) -> None:
        if self.host.get("visible"):
            # The regularisers reach every row; the image reaches the positions of visible ones.
            means_grad = self.gaussians["means"].grad
            assert means_grad is not None
            seen = (means_grad != 0).any(dim=1)
            for optimizer in self.optimizers.values():
                optimizer.step(visible=seen)  # pyright: ignore[reportCallIssue]
                optimizer.zero_grad(set_to_none=True)
        else:
            super()._step_optimizers()
        if self.host.get("decoupled"):
            self._decay()

    @torch.no_grad()
    def _decay(self) -> None:
        opacity = torch.sigmoid(self.gaussians["opacities"])
        self.gaussians["opacities"].sub_(OPACITY_DECAY * opacity * (1 - opacity))
        self.gaussians["scales"].sub_(SCALE_DECAY)

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
