"""Curvature pairs between two visits of one view, so that y holds no difference between views.

Both s and y span the steps from one visit of a view to the next: an epoch, in which the other
parameters have moved as well.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

from opt3dgs_optim import curvature
from opt3dgs_optim._phased import PhasedAdam

VISITS = "visits"  # state key, [N, views, 2 D]: position and gradient; a zero gradient: no visit


class SameViewAdam(PhasedAdam):
    """`PhasedAdam` whose pairs are taken against the last visit of the view of this step.

    A point that a view did not reach keeps its visit before that. All visits are dropped where
    the pairs are (the parameter object, or its number of rows, is another one) and where
    `reset_points` is called: which rows have moved since a visit is not known, so that a trainer
    whose density control runs more often than once in two epochs never has a pair.

    Memory: 24 bytes per point and view beyond LQNAdam's (D = 3, float32).
    """

    num_views: int
    view: int  # the view of the step that comes next; its owner sets it

    @classmethod
    def of(cls, optimizer: Optimizer, num_views: int) -> SameViewAdam:
        """Make a scheduler's optimizer of the positions one of these: the very object.

        Raises:
            TypeError: it was not made by `PhaseScheduler.upgrade`.
        """
        if not isinstance(optimizer, PhasedAdam):
            raise TypeError(f"{cls.__name__}.of: {type(optimizer).__name__} is no PhasedAdam")
        optimizer.__class__ = cls  # its scheduler holds the object and goes on reading it
        assert isinstance(optimizer, cls)
        optimizer.num_views, optimizer.view = num_views, 0
        return optimizer

    def _has_operator(self, position: Tensor) -> bool:
        return False  # it takes consecutive pairs

    def _history(self, param: Tensor, position: Tensor) -> Tensor:
        if not self._is_known(param):
            self.state[param].pop(VISITS, None)
        return super()._history(param, position)

    def _take_pairs(
        self, param: Tensor, history: Tensor, position: Tensor, gradient: Tensor, epoch_ends: bool
    ) -> None:
        options = self.curvature_options
        taken = record_visit(
            history,
            options.history_size,
            self._visits(param)[:, self.view],
            position,
            gradient,
            min_cosine=options.min_cosine,
            powell=options.powell,
        )
        self._count(*taken)

    def _visits(self, param: Tensor) -> Tensor:
        state, (rows, dim) = self.state[param], param.shape
        shape = (rows, self.num_views, 2 * dim)
        if VISITS not in state or state[VISITS].shape != shape:
            # A step reads one view of all points: let that be one piece of memory.
            cells = param.new_zeros(self.num_views, rows, 2 * dim)
            state[VISITS] = cells.transpose(0, 1)
        return state[VISITS]

    def _drop_visits(self, *, unknown: bool) -> None:
        for param, state in self.state.items():
            if not (unknown and self._is_known(param)):
                state.pop(VISITS, None)

    def _reset_rows(self, rows: Tensor, moments: bool) -> None:
        self._drop_visits(unknown=False)
        super()._reset_rows(rows, moments)

    def drop_pairs(self) -> None:
        """As LQNAdam's; the visits are freed too."""
        self._drop_visits(unknown=False)
        super().drop_pairs()

    def state_dict(self) -> dict[str, Any]:
        """As LQNAdam's; visits whose rows have been edited since are left out as well."""
        self._drop_visits(unknown=True)
        return super().state_dict()


def record_visit(
    history: Tensor,
    history_size: int,
    visit: Tensor,
    position: Tensor,
    gradient: Tensor,
    *,
    min_cosine: float,
    powell: bool = False,
) -> tuple[Tensor, Tensor]:
    """`curvature.record` against the last visit of this view instead of the last step.

    Args:
        history: see `curvature.record`; changed in place.
        history_size: K.
        visit: [N, 2 D], position and gradient at the view's last visit, a gradient of zero where
            there was none; replaced by this step's, in place, where the view reaches the point.
        position, gradient: [N, D], of this step.
        min_cosine, powell: see `curvature.record`.

    Returns:
        (accepted, candidates), [N] bool each.
    """
    dim = position.shape[1]
    visible = (gradient != 0).any(dim=1) & torch.isfinite(gradient).all(dim=1)
    visited = (visit[:, dim:] != 0).any(dim=1)
    head = curvature.header(history, history_size)
    head.position.copy_(visit[:, :dim])
    head.gradient.copy_(visit[:, dim:])
    head.counter.copy_(head.counter.maximum(visited.to(history.dtype)))  # 0: nothing to compare
    taken = curvature.record(
        history,
        history_size,
        position,
        gradient,
        visible & visited,
        min_cosine=min_cosine,
        powell=powell,
    )
    now = torch.cat([position, gradient], dim=1)
    visit.copy_(torch.where(visible[:, None], now, visit))
    return taken
