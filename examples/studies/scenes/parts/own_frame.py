"""Positions stepped in each Gaussian's own frame, in units of its standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim import Course, Part
from opt3dgs_optim.lbfgs.pairs import columns
from opt3dgs_optim.part import Group
from opt3dgs_optim.parts.noise import _rotate


class OwnFrame(Part):
    """Move the centre of each Gaussian by B Adam(B^T g), B = R diag(s), Sigma = B B^T.

    The step along each of its own axes is `rate(t) = rate * final^t` standard deviations,
    t = iteration / total_steps; the positions' learning rate counts only in that 0 holds them.

    Args:
        rate: standard deviations, of a full step at the begin.
        final: share of that at the end; 0.01 is the decay of all 3DGS trainers.
        cap: most standard deviations of a step along an axis; None: no bound.
    """

    names = ("means",)
    gaussians: Mapping[str, Tensor]  # the trainer's dict, set by `StudyArm.make`

    def __init__(self, rate: float = 0.1, final: float = 0.01, cap: float | None = None) -> None:
        self.rate, self.final, self.cap = rate, final, cap
        self._kept: Any = None

    def __repr__(self) -> str:
        return f"OwnFrame({self.rate:g}, {self.final:g}, {self.cap})"

    def _frame(self) -> tuple[Tensor, list[Tensor], list[Tensor]]:
        """Quaternions' real part and axis, standard deviations: columns [N]."""
        q = columns(self.gaussians["quats"].detach(), torch.float32)
        w, *axis = (q / (q * q).sum(0).sqrt().clamp(min=1e-12)).unbind()
        scales = columns(self.gaussians["scales"].detach(), torch.float32).exp()
        return w, axis, list(scales.unbind())

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: dict[str, Any], course: Course
    ) -> Tensor:
        """B^T g; the positions are put aside, so that Adam writes its step and nothing else."""
        w, axis, scales = self._frame()
        local = _rotate(w, [-a for a in axis], list(columns(grad, torch.float32).unbind()))
        self._kept = param.detach().clone(), w, axis, scales
        param.detach().zero_()
        return torch.stack([s * a for s, a in zip(scales, local, strict=True)], 1)

    def factor(self, group: Group, course: Course) -> float:
        lr = float(group["lr"])
        return self.rate * self.final**course.progress / lr if lr else 1.0

    @torch.no_grad()
    def after(self, group: Group, param: Tensor, state: dict[str, Any], course: Course) -> None:
        """B z in the place of Adam's step z."""
        kept, w, axis, scales = self._kept
        self._kept = None
        steps = param.detach() if self.cap is None else param.detach().clamp(-self.cap, self.cap)
        local = columns(steps, torch.float32).unbind()
        moved = _rotate(w, axis, [s * a for s, a in zip(scales, local, strict=True)])
        param.copy_(kept + torch.stack(moved, 1))
