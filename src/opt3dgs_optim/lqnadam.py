"""LQNAdam: Adam fed with a per-point L-BFGS direction (eq. 17)."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from opt3dgs_optim.adam import StepAdam
from opt3dgs_optim.contract import check_supported
from opt3dgs_optim.lbfgs.backend import Backend
from opt3dgs_optim.messages import warn_user
from opt3dgs_optim.names import split_name
from opt3dgs_optim.parts.curvature import Curvature
from opt3dgs_optim.training import Training


class LQNAdam(StepAdam):
    """Adam that is fed with an L-BFGS direction of every row, from the first step on (eq. 17).

    Dimension 0 of a parameter is a batch: every row is a problem of its own, with its own curvature
    pairs and its own direction H g. For Gaussians that is one row for each, [N, 3] for positions. A
    problem of n coordinates is one row, [1, n]. A parameter [N] would be N problems of one
    coordinate, which have no curvature to speak of: there is a warning.

    In Adam, H g replaces the gradient, scaled to the gradient's length. Adam then divides by its
    own second moment, so little more than the direction of H g is left. It follows that

    - on quadratics it is **slower than Adam** with a tuned learning rate for the first few hundred
      steps. After 200 steps, with three coordinates in random axes, Adam's error is smaller by more
      than a factor of 100 where the condition is 100, and by a factor of 2 where it is 10,000;
    - it is **faster in narrow valleys**, by steps, given time. After 1,000 steps its error on the
      quadratics of condition 10,000 is smaller than Adam's by a factor of 10 and more. In the
      curved valley of Rosenbrock's function it is smaller by a factor of 10 after 200 steps;
    - on a CPU a step takes ten (50 rows) to a hundred times (100,000) as long as Adam's, so that by
      seconds it was faster on none of these;
    - in the last phase of a splatting training, for which the paper proposes it, it changes next to
      nothing here: positions hardly move by then (`docs/evidence.md`).

    The first two compare each one's best of six learning rates; `examples/lqnadam_quadratics.py`
    measures them.

    Memory: Adam's, plus 160 bytes per row of three coordinates with five pairs.

    Args:
        params, lr, betas, eps, weight_decay: as in `torch.optim.Adam`.
        history_size, min_cosine, graft, backend: as in `Curvature`.

    Examples:
        Fifty starts in Rosenbrock's valley, each optimizer with the best of its rates there:

        >>> import torch
        >>> from opt3dgs_optim import LQNAdam
        >>> def median_error(make, lr):
        ...     noise = torch.randn(50, 2, generator=torch.Generator().manual_seed(0))
        ...     x = torch.nn.Parameter(torch.tensor([-1.2, 1.0]) + 0.1 * noise)  # [50, 2]
        ...     optimizer = make([x], lr=lr)
        ...     for _ in range(200):
        ...         optimizer.zero_grad()
        ...         error = 100 * (x[:, 1] - x[:, 0] ** 2) ** 2 + (1 - x[:, 0]) ** 2
        ...         error.sum().backward()
        ...         optimizer.step()
        ...     return error.median().item()
        >>> adam = min(median_error(torch.optim.Adam, lr) for lr in (0.1, 0.3, 1.0))
        >>> lqn = min(median_error(LQNAdam, lr) for lr in (0.1, 0.3, 1.0))
        >>> lqn < adam / 2
        True

    Raises:
        ValueError, RuntimeError: as `Curvature`.
    """

    def __init__(
        self,
        params: Any,
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
        *,
        history_size: int = 5,
        min_cosine: float = 1e-6,
        graft: bool = True,
        backend: Backend = "auto",
    ) -> None:
        curvature = Curvature(
            history_size, min_cosine=min_cosine, graft=graft, names=None, backend=backend
        )
        super().__init__(params, lr, betas, eps, weight_decay)
        slots = [split_name(group.get("name")) for group in self.param_groups]
        check_supported("LQNAdam", self, slots)
        self.follow(Training([curvature], switch_step=0), slots)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group as in `torch.optim.Adam`; parameters of one dimension get a warning."""
        super().add_param_group(param_group)
        for param in self.param_groups[-1]["params"]:
            if param.dim() == 1 and len(param) > 1:
                rows = len(param)
                warn_user(
                    f"LQNAdam: a parameter of shape [{rows}] is {rows} problems of one coordinate "
                    f"each, since dimension 0 is the batch; [1, {rows}] is one problem of {rows}"
                )

    @property
    def accepted_share(self) -> Tensor | None:
        """Share of the last step's candidate pairs that were accepted, 0-d; None before any."""
        curvature = self.training.part(Curvature)
        return None if curvature is None else curvature.accepted_share
