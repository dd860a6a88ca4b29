"""Fading and annealing that the optimizers' own moments steer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from opt3dgs_optim.fading import Fading

if TYPE_CHECKING:
    from study.fitting import StudyFit

STRIDE = 10  # iterations between two looks at the steps' size
LARGEST_FACTOR = 16.0


class ChosenFading:
    """`Fading` whose points the moments choose, parameter by parameter.

    A point is stale where its gradients have shrunk: exp_avg^2 is then small beside exp_avg_sq,
    both summed over its coordinates. `"stale"` fades the share of the points in which it is
    smallest, `"fresh"` that in which it is largest.
    """

    def __init__(self, choice: Literal["stale", "fresh"]) -> None:
        self.choice = choice
        self.random = Fading()  # whose numbers these are

    def events_before(self, iteration: int, total_steps: int) -> int:
        """As `Fading`."""
        return self.random.events_before(iteration, total_steps)

    def covers(self, name: str | None) -> bool:
        """As `Fading`."""
        return self.random.covers(name)

    def fade(self, state: Mapping[Any, dict[str, Any]], events: range) -> None:
        """As `Fading`, of the chosen points."""
        for moments in state.values():
            for _ in events:
                rows = chosen_rows(moments, self.random.share, stale=self.choice == "stale")
                moments["exp_avg"][rows] *= self.random.exp_avg
                moments["exp_avg_sq"][rows] *= self.random.exp_avg_sq


def chosen_rows(moments: dict[str, Tensor], share: float, stale: bool) -> Tensor:
    """Indices of the share of the rows [N, ..] whose exp_avg^2 / exp_avg_sq is most extreme.

    Rows without a gradient so far are not among them.
    """
    num_points = len(moments["exp_avg"])
    first = moments["exp_avg"].double().square().reshape(num_points, -1).sum(1)
    second = moments["exp_avg_sq"].double().reshape(num_points, -1).sum(1)
    known = torch.nonzero(second > 0).squeeze(1)
    ratio = first[known] / second[known]
    count = min(round(share * num_points), len(known))
    return known[torch.topk(ratio, count, largest=not stale).indices]


class OwnStep:
    """Annealing of the step itself: its root mean square falls from lr * `first` to lr * `final`.

    The factor on a parameter's step is what that takes: the wanted size over the root mean square
    of exp_avg / sqrt(exp_avg_sq), looked at every few iterations, and at most `LARGEST_FACTOR`.
    """

    def __init__(self, first: float = 1.0, final: float = 0.1) -> None:
        self.first = first
        self.final = final
        self._fit: StudyFit | None = None
        self._sizes: dict[str, tuple[int, float]] = {}  # name -> iteration // STRIDE, size

    def watch(self, fit: StudyFit) -> None:
        """Whose moments are meant."""
        self._fit = fit

    def factor(self, name: str | None, progress: float) -> float:
        """As `Annealing`."""
        fit = self._fit
        if fit is None or name not in fit.gaussians:
            return 1.0
        now = fit.iteration // STRIDE
        if self._sizes.get(name, (-1, 1.0))[0] != now:
            self._sizes[name] = (now, self._size(name))
        wanted = self.first ** (1 - progress) * self.final**progress
        return wanted / max(self._sizes[name][1], wanted / LARGEST_FACTOR)

    def _size(self, name: str) -> float:
        """Root mean square of the step over the learning rate; 1 before the first one."""
        assert self._fit is not None
        optimizer = self._fit.optimizers[name]
        moments = optimizer.state.get(self._fit.gaussians[name])
        if not moments:
            return 1.0
        betas, steps = optimizer.param_groups[0]["betas"], float(moments["step"])
        first = moments["exp_avg"] / (1 - betas[0] ** steps)
        second = moments["exp_avg_sq"] / (1 - betas[1] ** steps)
        known = second > 0
        squares = first[known].square() / second[known]
        return float(squares.mean().sqrt()) if len(squares) else 1.0
