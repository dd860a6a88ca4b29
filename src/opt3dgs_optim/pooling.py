"""Pooling: one second moment for all coordinates of a point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim._groups import canonical_name, check_names
from opt3dgs_optim._visible import shaped

CALL = "Pooling"
MOMENTS = ("exp_avg_sq", "max_exp_avg_sq")


@dataclass(frozen=True)
class Pooling:
    """Replace Adam's second moments of a point's coordinates by their mean (after VectorAdam).

        v_ij <- mean_j v_ij,    point i, coordinate j of one parameter

    Adam divides every coordinate's gradient by the size of that coordinate's own gradients, so
    that it makes a full step along an axis that the images hardly constrain: a Gaussian's extent
    along the line of sight, which few views see and the scale regulariser pulls at. With one
    second moment the step has the direction of `exp_avg`, whatever the axes: short along such an
    axis, up to the root of the number of coordinates longer along one with large gradients.

    Applied after every step, so that the first step of a point is Adam's own. The state keeps its
    shapes, [N, ..] with equal coordinates, because trainers edit it by rows. It costs no memory.

    VectorAdam: Ling, Sharp and Jacobson, NeurIPS 2022. It sums over the coordinates; the mean
    keeps the length of steps whose coordinates are alike, and so the trainer's learning rates.

    Args:
        names: the Gaussian parameters, under gsplat's or INRIA's names.

    Raises:
        ValueError: a name is no Gaussian parameter's, or there is none.
    """

    names: tuple[str, ...] = ("means", "scales", "quats")

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", check_names(CALL, self.names))

    def covers(self, name: str | None) -> bool:
        """Whether a parameter is pooled.

        Args:
            name: its name, gsplat's or INRIA's; None is no Gaussian parameter.
        """
        return canonical_name(name) in self.names

    @torch.no_grad()
    def pool(self, moments: dict[str, Any], rows: Tensor | None = None) -> None:
        """Pool the second moments of a parameter [N, ..], in place.

        Args:
            moments: its state in an optimizer; what has no second moments is left alone.
            rows: [N] bool, the points to pool; all where it is None.
        """
        for key in MOMENTS:
            moment = moments.get(key)
            if moment is None or moment.dim() < 2 or moment.shape[0] == 0:
                continue
            coordinates = tuple(range(1, moment.dim()))
            pooled = moment.mean(coordinates, keepdim=True).expand_as(moment)
            if rows is not None:
                pooled = torch.where(shaped(rows, moment), pooled, moment)
            moment.copy_(pooled)
