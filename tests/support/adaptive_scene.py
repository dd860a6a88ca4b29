"""A scene in which each part of a training can be made useless, and its trainer."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from trainers import INRIA_NAMES, every_one

from opt3dgs_optim import Course, Curvature, Part, PhaseScheduler, PositionNoise

POINTS, TOTAL, SWITCH = 120, 170, 110
RATES = {"means": 2e-2, "scales": 1e-4, "quats": 1e-4, "opacities": 1e-2}
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": ()}
CHECK, PROBE = 20, 3  # shortened: the same decisions after a fifth of the iterations


def shorten(monkeypatch: Any) -> None:
    """Look at the evidence more often."""
    from opt3dgs_optim import course
    from opt3dgs_optim.parts import curvature

    monkeypatch.setattr(course, "EVIDENCE_INTERVAL", CHECK)
    monkeypatch.setattr(curvature, "PROBE_STEPS", PROBE)


class GatedNoise(PositionNoise):
    """A part of a trainer's own: useless while no point is near the opacity gate."""

    def evidence(self, course: Course) -> Tensor:
        given: Any = self.gaussians
        source: Any = given() if callable(given) else given
        return (source["opacities"].detach() < 0).any().float().reshape(1)

    def useless(self, evidence: list[float], course: Course) -> str | None:
        return None if evidence[0] else "no point is near the opacity gate"


@dataclass(frozen=True)
class Scene:
    """As it stands, every part has something to do."""

    views: int = 20
    views_disagree: float = 0.0  # share of a view's own curvature: a pair then holds none
    concave: bool = False  # no pair is accepted
    opacity: float = -5.3  # logit of all points: 0.005, at the gate
    curvature: bool = True
    noise_scale: float = 1.0
    history_size: int = 5


class Training:
    """Points on quadratics of condition 100, each with axes of its own; views look at them."""

    def __init__(self, scene: Scene, layout: str = "dict", *others: Part, **options: Any) -> None:
        draw = torch.Generator().manual_seed(0)
        self.scene, self.layout = scene, layout
        axes = torch.linalg.qr(torch.randn(POINTS, 3, 3, generator=draw))[0]
        stiff = torch.diag_embed(10 ** (2 * torch.rand(POINTS, 3, generator=draw)))
        slopes = torch.randn(scene.views, POINTS, 2, 3, generator=draw)
        share = scene.views_disagree
        hessians = (1 - share) * (axes @ stiff @ axes.mT) + share * 20 * slopes.mT @ slopes
        self.hessians = hessians * (-0.01 if scene.concave else 0.01)
        self.minima = torch.randn(scene.views, POINTS, 3, generator=draw) * 0.1 * share
        self.splats = {
            name: Parameter(torch.randn(POINTS, *shape, generator=draw) * 0.5)
            for name, shape in SHAPES.items()
        }
        with torch.no_grad():
            self.splats["opacities"].fill_(scene.opacity)
        self.noise = GatedNoise(lambda: self.splats, scene.noise_scale)
        self.curvature = Curvature(scene.history_size)
        parts: list[Part] = [*others]
        parts += [self.curvature] if scene.curvature else []
        parts += [self.noise] if scene.noise_scale else []
        options = {"adaptive": True, **options}
        self.phases = PhaseScheduler(TOTAL, SWITCH, parts, **options)
        self.optimizers: Any = self.phases.upgrade(self._plain())

    def _plain(self) -> Any:
        if self.layout == "single":
            groups = [
                {"params": [p], "lr": RATES[name], "name": INRIA_NAMES[name]}
                for name, p in self.splats.items()
            ]
            return torch.optim.Adam(groups, eps=1e-15)
        return {
            name: torch.optim.Adam([{"params": p, "lr": RATES[name], "name": name}], eps=1e-15)
            for name, p in self.splats.items()
        }

    @property
    def every(self) -> list[Any]:
        return every_one(self.optimizers)

    @property
    def positions_state(self) -> dict[str, Any]:
        means = self.splats["means"]
        return next(o.state[means] for o in self.every if means in o.state)

    def step(self) -> None:
        epoch, at = divmod(self.phases.iteration, self.scene.views)
        order = torch.randperm(self.scene.views, generator=torch.Generator().manual_seed(epoch))
        view = int(order[at])
        off = self.splats["means"] - self.minima[view, : len(self.splats["means"])]
        hessian = self.hessians[view, : len(off)]
        loss = 0.5 * (off[:, None] @ hessian @ off[..., None]).mean() + 1
        loss.backward()
        self.phases.observe(loss)
        for optimizer in self.every:
            optimizer.step()
            optimizer.zero_grad()

    def run(self, until: int) -> Training:
        torch.manual_seed(self.phases.iteration)  # the noise
        while self.phases.iteration < until:
            self.step()
        return self

    def save(self) -> dict[str, Any]:
        return copy.deepcopy(
            {
                "splats": {name: p.detach() for name, p in self.splats.items()},
                "optimizers": [o.state_dict() for o in self.every],
            }
        )

    def load(self, saved: dict[str, Any]) -> Training:
        with torch.no_grad():
            for name, value in saved["splats"].items():
                self.splats[name].copy_(value)
        for optimizer, state in zip(self.every, copy.deepcopy(saved["optimizers"]), strict=True):
            optimizer.load_state_dict(state)
        return self
