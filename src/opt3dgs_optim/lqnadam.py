"""LQNAdam: Adam fed with a per-point L-BFGS direction (eq. 17)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from opt3dgs_optim.backend import Backend
from opt3dgs_optim.course import Course
from opt3dgs_optim.overrides import AdamOptions
from opt3dgs_optim.parts.curvature import Curvature
from opt3dgs_optim.stepadam import StepAdam

if TYPE_CHECKING:
    from typing_extensions import Unpack


class LQNAdam(StepAdam):
    """Adam with the part `Curvature` on every parameter, from the first step on (eq. 17).

    Args:
        params, lr, betas, eps, weight_decay, amsgrad: as in `torch.optim.Adam`.
        history_size, min_cosine, graft, backend: as in `Curvature`.
        adam: `foreach, maximize, capturable, fused, decoupled_weight_decay`, as in
            `torch.optim.Adam`.

    Examples:
        >>> import torch
        >>> from opt3dgs_optim import LQNAdam
        >>> points = torch.nn.Parameter(torch.ones(4, 3))
        >>> optimizer = LQNAdam([points], lr=0.05)
        >>> for _ in range(100):
        ...     optimizer.zero_grad()
        ...     (points**2 * torch.tensor([1.0, 10.0, 100.0])).sum().backward()
        ...     optimizer.step()
        >>> bool(points.abs().max() < 0.2)
        True

    Raises:
        ValueError, RuntimeError: as `Curvature`.
        TypeError: `params` is a tensor, or an option is none of Adam's.
    """

    any_group = True

    def __init__(
        self,
        params: Any,
        lr: float | Tensor = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
        amsgrad: bool = False,
        *,
        history_size: int = 5,
        min_cosine: float = 1e-6,
        graft: bool = True,
        backend: Backend = "auto",
        **adam: Unpack[AdamOptions],
    ) -> None:
        if adam.get("differentiable"):
            raise ValueError(
                "LQNAdam: differentiable=True, but curvature pairs are kept between steps and "
                "have no gradient; False is needed"
            )
        curvature = Curvature(
            history_size, min_cosine=min_cosine, graft=graft, names=None, backend=backend
        )
        super().__init__(params, lr, betas, eps, weight_decay, amsgrad, **adam)
        self.follow(Course([curvature]))

    @property
    def accepted_share(self) -> Tensor | None:
        """Share of the last step's candidate pairs that were accepted, 0-d; None before any."""
        curvature = self.course.part(Curvature)
        return None if curvature is None else curvature.accepted_share
