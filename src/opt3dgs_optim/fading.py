"""Fading: Adam's moments of random points are shrunk, so that their next steps are longer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim._checks import check_count, check_number
from opt3dgs_optim._groups import canonical_name, check_names

CALL = "Fading"


@dataclass(frozen=True)
class Fading:
    """Shrink Adam's state of a random share of the points, again and again (after AdamW-GS).

    A point's step is lr * exp_avg / sqrt(exp_avg_sq). With the default factors it keeps its
    length at first (0.2 / sqrt(0.04) = 1); within ten iterations exp_avg is that of new gradients,
    while exp_avg_sq needs a thousand to recover: until then the point's steps are up to five times
    longer. So fading is a larger learning rate for single points, for a while.

    The same points are faded in all these parameters. Which ones depends on `seed`, the event
    and the number of points alone: a resumed run repeats them. It costs no memory.

    Args:
        share: of the points in each event, chance per point in (0, 1].
        exp_avg, exp_avg_sq: factors on the moments, in [0, 1]. exp_avg^2 <= exp_avg_sq keeps the
            next step from being longer than the last.
        events: how many over the run.
        start, stop: where the first and the last event are, as shares of the run.
        seed: of the choice of points.
        names: the Gaussian parameters, under gsplat's or INRIA's names; None: all of them.

    Raises:
        ValueError: an option is outside what is allowed, or a name is no Gaussian parameter's.
    """

    share: float = 0.2
    exp_avg: float = 0.2
    exp_avg_sq: float = 0.04
    events: int = 300
    start: float = 0.03
    stop: float = 0.5
    seed: int = 0
    names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        check_number(CALL, "share", self.share, 0.0, 1.0, open_low=True)
        check_number(CALL, "exp_avg", self.exp_avg, 0.0, 1.0)
        check_number(CALL, "exp_avg_sq", self.exp_avg_sq, 0.0, 1.0)
        check_count(CALL, "events", self.events, 1)
        check_number(CALL, "start", self.start, 0.0, 1.0)
        check_number(CALL, "stop", self.stop, self.start, 1.0, open_low=True)
        check_count(CALL, "seed", self.seed, 0)
        if self.names is not None:
            object.__setattr__(self, "names", check_names(CALL, self.names))

    def covers(self, name: str | None) -> bool:
        """Whether a parameter is faded.

        Args:
            name: its name, gsplat's or INRIA's; None is no Gaussian parameter.
        """
        known = canonical_name(name)
        return known is not None and (self.names is None or known in self.names)

    def events_before(self, iteration: int, total_steps: int) -> int:
        """Number of events before the step of this iteration (from 0)."""
        share = (iteration / total_steps - self.start) / (self.stop - self.start)
        return int(min(max(share, 0.0), 1.0) * self.events)

    def factors(self, event: int, num_points: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Factors on exp_avg and exp_avg_sq of one event, [num_points] each."""
        generator = torch.Generator(device).manual_seed((self.seed << 32) + event)
        chosen = torch.rand(num_points, generator=generator, device=device) < self.share
        return (
            torch.where(chosen, self.exp_avg, 1.0),
            torch.where(chosen, self.exp_avg_sq, 1.0),
        )

    def fade(self, state: Mapping[Any, dict[str, Any]], events: range) -> None:
        """Fade the moments of every parameter, in place.

        Args:
            state: an optimizer's, by parameter [N, ..]; what has no moments is left out.
            events: numbers of the events to come, from 0.
        """
        for param, moments in state.items():
            if "exp_avg" not in moments or param.dim() == 0:
                continue
            shape = (-1, *[1] * (param.dim() - 1))
            for event in events:
                first, second = self.factors(event, param.shape[0], param.device)
                moments["exp_avg"].mul_(first.view(shape))
                for key in ("exp_avg_sq", "max_exp_avg_sq"):
                    if key in moments:
                        moments[key].mul_(second.view(shape))
