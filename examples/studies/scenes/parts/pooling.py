"""Pooling: one second moment for all coordinates of a point."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from opt3dgs_optim import Course, Part
from opt3dgs_optim.names import check_names
from opt3dgs_optim.part import Group


@dataclass(frozen=True, repr=False)
class Pooling(Part):
    """Replace Adam's second moments of a point's coordinates by their mean (after VectorAdam).

        v_ij <- mean_j v_ij,    point i, coordinate j of one parameter

    With one second moment the step has the direction of `exp_avg`, whatever the axes: short along
    one that the images hardly constrain. Applied after every step, so that a point's first is
    Adam's own. It costs no memory.

    VectorAdam (Ling, Sharp and Jacobson, NeurIPS 2022) sums over the coordinates; the mean keeps
    the length of steps whose coordinates are alike, and so the trainer's learning rates.

    Args:
        names: the Gaussian parameters, under gsplat's or INRIA's names.

    Raises:
        ValueError: a name is no Gaussian parameter's, or there is none.
    """

    names: tuple[str, ...] = ("means", "scales", "quats")

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", check_names("Pooling", self.names))

    def after(self, group: Group, param: Tensor, state: dict[str, Any], course: Course) -> None:
        """Pool the second moments of a parameter [N, ..], in place."""
        for key in ("exp_avg_sq", "max_exp_avg_sq"):
            moment = state.get(key)
            if moment is not None and moment.dim() > 1 and moment.numel() > 0:
                coordinates = tuple(range(1, moment.dim()))
                moment.copy_(moment.mean(coordinates, keepdim=True).expand_as(moment))
