"""The paper's last phase: a squared loss, and moments that begin anew with it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from opt3dgs_optim.clock import Phase
from opt3dgs_optim.part import Part
from opt3dgs_optim.step import Step
from opt3dgs_optim.training import Training


@dataclass(frozen=True, repr=False)
class SquaredLoss(Part):
    """The photometric term is L2 instead of L1 while exploiting (Opt3DGS, section 4.2).

    The trainer calls `phases.pixel_loss(render, target)` instead of its L1.
    """

    during = Phase.EXPLOITATION

    def pixel_loss(self, error: Tensor) -> Tensor:
        """Mean squared error, 0-d."""
        return error.square().mean()


@dataclass(frozen=True, repr=False)
class FreshMoments(Part):
    """Adam's moments of the Gaussian parameters start anew at the switch.

    Loss and direction change scale there, and second moments of the old gradients would hold the
    steps back for a thousand iterations.
    """

    during = Phase.EXPLOITATION

    def plan(self, step: Step, training: Training) -> None:
        """Begin anew in the parameter's first step after the switch."""
        if step.stepped_in < training.switch_at <= step.iteration:
            step.fresh = True
