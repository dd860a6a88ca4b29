"""What could make the flat histogram explore: other energies, other restarts, other targets.

The loss of one random view mostly says which view it is, so a step scaled by its nu is a weight of
views. Each class changes one thing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim import Course, EnergyHistogram, Part, PositionNoise
from opt3dgs_optim.names import SLOT
from opt3dgs_optim.part import Group
from opt3dgs_optim.partitions import BANDWIDTH, REACH
from opt3dgs_optim.parts.histogram import CLAMP
from opt3dgs_optim.rows import shaped

VISITS = 5  # of a view, over which its mean energy is taken, weighed exponentially
RESTART = 1_000  # iterations: ten refinements
RESETTLING = 100  # energies after a restart for which nu is 1
BINS = 48  # of the density over the points


class Wrapped(Part):
    """A flat histogram whose energies, restarts or factor a subclass changes."""

    during = EnergyHistogram.during

    def __init__(self, warmup: int) -> None:
        self.histogram = EnergyHistogram(warmup=warmup)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.histogram!r})"

    @property
    def mean_multiplier(self) -> Tensor:
        return self.histogram.mean_multiplier

    def observe(self, energy: Tensor, valid: Tensor | bool, course: Course) -> None:
        """Take the energy."""
        self.histogram.observe(energy, valid, course)

    def factor(self, group: Group, course: Course) -> float | Tensor | None:
        return self.histogram.factor(group, course)

    def numbers(self, course: Course) -> Mapping[str, float | Tensor]:
        return self.histogram.numbers(course)

    def state_dict(self) -> dict[str, Any]:
        return {"histogram": self.histogram.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.histogram.load_state_dict(state["histogram"])


class ViewHistogram(Wrapped):
    """The energy is taken relative to the mean of the view that it is of.

    Attributes:
        view: index of the view of this iteration; the trainer says it.
    """

    def __init__(self, warmup: int) -> None:
        super().__init__(warmup)
        self.view = 0
        self._means: dict[int, float] = {}

    def observe(self, energy: Tensor, valid: Tensor | bool, course: Course) -> None:
        """Take energy / recent mean of its view; nothing at the first visit."""
        value, mean = float(energy), self._means.get(self.view)
        if not math.isfinite(value):
            return
        if mean is not None:
            super().observe(energy / mean, valid, course)
        self._means[self.view] = value if mean is None else mean + (value - mean) / VISITS

    def state_dict(self) -> dict[str, Any]:
        means = [[view, mean] for view, mean in sorted(self._means.items())]
        return super().state_dict() | {"means": means}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self._means = {int(view): float(mean) for view, mean in state["means"]}


class RestartedHistogram(Wrapped):
    """Theta starts anew every thousand iterations, since the Gaussians are others by then."""

    def observe(self, energy: Tensor, valid: Tensor | bool, course: Course) -> None:
        """Restart where it is time, then take the energy."""
        old = self.histogram
        if course.current % RESTART == 0 and old.num_observed > old.warmup:
            self.histogram = EnergyHistogram(warmup=RESETTLING)
            state = self.histogram.state_dict()
            self.histogram.load_state_dict(state | {"sums": old.state_dict()["sums"]})
        super().observe(energy, valid, course)

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"warmup": self.histogram.warmup}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.histogram = EnergyHistogram(warmup=int(state["warmup"]))
        super().load_state_dict(state)


class NuOfNoise(Wrapped):
    """Nu scales the deviation of the position noise; the steps are Adam's own."""

    def __init__(self, warmup: int) -> None:
        super().__init__(warmup)
        self._scale: float | None = None  # of the noise, as the trainer has it

    def observe(self, energy: Tensor, valid: Tensor | bool, course: Course) -> None:
        """Take the energy, and tell the noise."""
        super().observe(energy, valid, course)
        noise = course.part(PositionNoise)
        if noise is not None:
            self._scale = noise.scale if self._scale is None else self._scale
            noise.scale = self._scale * max(float(self.histogram.multiplier), 0.0)

    def factor(self, group: Group, course: Course) -> None:
        """The steps keep their length."""


class NuPerPoint(Part):
    """Nu for every Gaussian, from the density of the Gaussians over the loss they account for.

        nu_i = 1 + dlog q/dz / 2 at z_i,    z_i = standardised log |gradient of position i|

    q is the smoothed density of the z of this iteration's visible points: a point of which there
    are few beside it, at smaller gradients than the most, goes further than its Adam step; one at
    larger gradients not so far.
    """

    def __init__(self) -> None:
        self._nu = torch.ones(0)
        self._old: Tensor | None = None

    def __repr__(self) -> str:
        return "NuPerPoint()"

    def before(
        self, group: Group, param: Tensor, grad: Tensor, state: dict[str, Any], course: Course
    ) -> Tensor:
        """Measure at the positions, which are stepped first; remember where every row was."""
        if group[SLOT] == "means":
            self._nu = nu_per_point(grad)
        self._old = param.detach().clone()
        return grad

    def after(self, group: Group, param: Tensor, state: dict[str, Any], course: Course) -> None:
        """Scale the rows' steps."""
        old, nu = self._old, self._nu
        if old is not None and len(nu) == len(param):
            with torch.no_grad():
                param.copy_(old + shaped(nu, param) * (param - old))
        self._old = None

    def numbers(self, course: Course) -> dict[str, Tensor]:
        return {"nu_deviation": self._nu.std()} if len(self._nu) > 1 else {}


def nu_per_point(grad: Tensor) -> Tensor:
    """Nu [N] from the positions' gradients [N, 3]; 1 where there is none. Its visible mean is 1."""
    lengths = grad.norm(dim=1)
    seen = lengths > 0
    nu = torch.ones_like(lengths)
    if int(seen.sum()) < 2 * BINS:
        return nu
    logs = lengths[seen].log()
    z = ((logs - logs.mean()) / logs.std().clamp(min=1e-6)).clamp(-REACH, REACH)
    width = 2 * REACH / BINS
    counts = torch.histc(z, BINS, -REACH, REACH)
    centers = (torch.arange(BINS) + 0.5) * width - REACH
    between = (centers[:, None] - centers) / BANDWIDTH
    density = torch.exp(-between.square() / 2) @ (counts / counts.sum()) + 1e-4
    slopes = torch.gradient(density.log(), spacing=width)[0]
    slope = slopes[((z + REACH) / width).long().clamp(max=BINS - 1)] / 2
    nu[seen] = (1 + slope - slope.mean()).clamp(*CLAMP)
    return nu
