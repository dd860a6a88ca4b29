"""What `steps.py` measures: steps of optimizers, and the two-loop recursion alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import (
    DEFAULTS,
    Curvature,
    EnergyHistogram,
    OwnFrame,
    Part,
    PhaseScheduler,
    SquaredLoss,
    two_loop,
)
from opt3dgs_optim.lbfgs import history_from_pairs

HISTORY_SIZE = 5
VIEWS = 4  # whose gradients take turns
NUMBERS = 59  # of a Gaussian with harmonics of degree 3
SETTLING = 200  # steps after which `OutOfView` knows that views see a tenth
LEARNING_RATES = {
    "means": 1.6e-4,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 5e-2,
    "sh0": 2.5e-3,
    "shN": 1.25e-4,
}


class Case:
    """Gaussians of gsplat's shapes with gradients, on a device, which all subjects step in turn.

    Only what their optimizers keep is their own: beside each other in memory they take half.
    """

    def __init__(self, points: int, device: torch.device) -> None:
        self.points, self.device = points, device
        self.generator = torch.Generator(device=device).manual_seed(0)
        raw = {
            "means": self.draw(3),
            "scales": 0.5 * self.draw(3) - 4,
            "quats": self.draw(4),
            "opacities": self.draw() - 1,
            "sh0": self.draw(1, 3),
            "shN": self.draw(15, 3),
        }
        self.splats = {name: Parameter(tensor) for name, tensor in raw.items()}
        for param in self.splats.values():
            param.grad = 1e-4 * torch.randn_like(param)

        # Of the positions, in turn: a pair of curvature is a difference of two of them.
        self.gradients = [1e-4 * self.draw(3) for _ in range(VIEWS)]
        self.splats["means"].grad = self.gradients[0]
        self.visible = torch.rand(points, device=device, generator=self.generator) < 0.1
        self.of_a_tenth = [gradient * self.visible[:, None] for gradient in self.gradients]

    def draw(self, *shape: int) -> Tensor:
        return torch.randn(self.points, *shape, device=self.device, generator=self.generator)

    def adams(self, fused: bool) -> dict[str, torch.optim.Adam]:
        """gsplat's optimizers; on a GPU they are fused always."""
        return {
            name: torch.optim.Adam(
                [{"params": [param], "lr": LEARNING_RATES[name], "name": name}],
                eps=1e-15,
                fused=fused or self.device.type == "cuda",
            )
            for name, param in self.splats.items()
        }


def six_adams(case: Case, fused: bool = False) -> Callable[[], None]:
    optimizers = case.adams(fused)

    def step() -> None:
        for optimizer in optimizers.values():
            optimizer.step()

    return step


def upgraded(
    case: Case,
    parts: list[Part],
    *,
    exploit: bool = False,
    tenth: bool = False,
    at: float = 0.25,
    masked: bool = False,
    fused: bool = False,
) -> Callable[[], None]:
    """Six upgraded optimizers with these parts, and `observe`.

    At a quarter of the run events of fading are as frequent as they get. `tenth`: views see a tenth
    of the points. `masked`: every step is one of these alone.
    """
    steps = 1_000_000
    phases = PhaseScheduler(steps, 0 if exploit else steps, parts)
    optimizers: Any = phases.upgrade(case.adams(fused))
    losses = list(torch.rand(64, device=case.device).mul(0.2).unbind())
    gradients = case.of_a_tenth if tenth else case.gradients
    count = round(at * steps)  # a call is one iteration

    def advance() -> None:
        nonlocal count
        count += 1
        case.splats["means"].grad = gradients[count % VIEWS]
        phases.observe(losses[count % len(losses)], iteration=count)

    def step() -> None:
        advance()
        for optimizer in optimizers.values():
            if masked:
                optimizer.step(visible=case.visible)
            else:
                optimizer.step()

    if tenth:  # the mean share is of the last hundred views, and begins at 1
        for _ in range(SETTLING):
            advance()
            optimizers["means"].step()
    return step


def two_loop_alone(case: Case) -> Callable[[], Any]:
    """The recursion, on a history in which every point has all its pairs."""
    s = torch.stack([case.draw(3) for _ in range(HISTORY_SIZE)])
    grad, history = case.draw(3), history_from_pairs(s, 2 * s + 0.3 * torch.randn_like(s))
    return lambda: two_loop(grad, history, HISTORY_SIZE)


def copy_144(case: Case) -> Callable[[], Any]:
    """A copy of as many bytes as the two-loop reads and writes: 120 of pairs, 12 in, 12 out."""
    source = torch.zeros(case.points * 36, device=case.device)
    target = torch.empty_like(source)
    return lambda: target.copy_(source)


SUBJECTS: dict[str, Callable[[Case], Callable[[], Any]]] = {
    "six Adams": six_adams,
    "six fused Adams": lambda case: six_adams(case, fused=True),
    "six Adams again": six_adams,  # other tensors, elsewhere in memory: how exact a ratio is
    "defaults": lambda case: upgraded(case, [*DEFAULTS]),
    "defaults, fused": lambda case: upgraded(case, [*DEFAULTS], fused=True),
    "defaults, a tenth in view": lambda case: upgraded(case, [*DEFAULTS], tenth=True),
    "defaults, steps of a tenth": lambda case: upgraded(case, [*DEFAULTS], tenth=True, masked=True),
    "defaults, last thirtieth": lambda case: upgraded(case, [*DEFAULTS], at=0.975),
    "defaults and OwnFrame": lambda case: upgraded(case, [OwnFrame(), *DEFAULTS]),
    "the paper's exploration": lambda case: upgraded(case, [EnergyHistogram.paper(warmup=4)]),
    "the paper's exploitation": lambda case: upgraded(
        case, [SquaredLoss(), Curvature()], exploit=True, at=0.0
    ),
    "two-loop, [N, 3] in and out": two_loop_alone,
    "copy of 144 bytes": copy_144,
}
# What a subject is measured in turn with: where it is not named, the first of them all.
BASELINES = {"defaults, fused": "six fused Adams"}
