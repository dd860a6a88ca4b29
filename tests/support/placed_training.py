"""A small training whose parameters and loss lie on any device, with any parts.

On a simulated GPU (`simulated_device`) it computes what it computes on the CPU, so that the two can
be compared, whatever is mixed: layouts of optimizers, masks, GradScaler, dropped steps, devices.
"""

from __future__ import annotations

import copy
import inspect
import io
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import pytest
import simulated_device
import torch
from simulated_device import on_host
from torch import Tensor
from torch.nn import Parameter
from trainers import AveragedThroughout, every_one

import opt3dgs_optim
from opt3dgs_optim import (
    DEFAULTS,
    DEFAULTS_ADC,
    Annealing,
    ConstantMultiplier,
    Curvature,
    EnergyHistogram,
    Fading,
    FreshMoments,
    IsotropicNoise,
    OutOfView,
    Part,
    PhaseScheduler,
    PositionNoise,
    SquaredLoss,
    paper_parts,
)

TOTAL, SWITCH, ROWS, VIEWS = 48, 32, 12, 5
LONG, LATE = 90, 60  # of presets, whose averaging acts in the last thirtieth
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
RATES = {"means": 1e-2, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3}
GPU = "cuda:0"
ADAMS = ("step", "exp_avg", "exp_avg_sq", "max_exp_avg_sq")

Arm = Callable[[Any], Iterable[Part]]
ARMS: dict[str, Arm] = {
    "no parts": lambda training: [],
    "Fading": lambda training: [Fading(start=0.0, stop=1.0)],
    "OutOfView": lambda training: [OutOfView()],
    "Averaging": lambda training: [AveragedThroughout()],
    "EnergyHistogram": lambda training: [EnergyHistogram(warmup=20)],
    "EnergyHistogram.paper": lambda training: [EnergyHistogram.paper(warmup=10)],
    "ConstantMultiplier": lambda training: [ConstantMultiplier(1.5)],
    "Annealing": lambda training: [Annealing()],
    "FreshMoments": lambda training: [FreshMoments()],
    "SquaredLoss": lambda training: [SquaredLoss()],
    "Curvature": lambda training: [Curvature()],
    "PositionNoise": lambda training: [PositionNoise(lambda: training.splats, 1e2)],
    "IsotropicNoise": lambda training: [IsotropicNoise(std=1e-3)],
    "DEFAULTS": lambda training: DEFAULTS,
    "DEFAULTS_ADC": lambda training: DEFAULTS_ADC,
    "paper": lambda training: paper_parts(LONG),
}
PRESETS = ("DEFAULTS", "DEFAULTS_ADC", "paper")


def _others() -> dict[str, Arm]:
    """Exported parts that have no arm yet, with their default options."""
    known = {*ARMS, "Part"}
    exported = {name: getattr(opt3dgs_optim, name) for name in opt3dgs_optim.__all__}
    parts = {n: each for n, each in exported.items() if inspect.isclass(each)}
    mine = {n: each for n, each in parts.items() if issubclass(each, Part) and n not in known}
    return {name: lambda training, kind=kind: [kind()] for name, kind in mine.items()}


ARMS |= _others()


def _everything(training: Training) -> list[Part]:
    parts = [ARMS[name](training) for name in EVERYTHING]
    return [each for found in parts for each in found]


EVERYTHING = (
    *("Fading", "OutOfView", "Averaging", "ConstantMultiplier", "Annealing"),
    *("FreshMoments", "SquaredLoss", "Curvature", "PositionNoise"),
)
ARMS["everything"] = _everything


def some_of(cases: Iterable[Any], kept: Callable[[Any], bool]) -> list[Any]:
    """The cases as parameters of a test; those that are not kept are `thorough`."""
    return [
        each
        if kept(each)
        else pytest.param(
            *(each if isinstance(each, tuple) else (each,)), marks=pytest.mark.thorough
        )
        for each in cases
    ]


def is_brief(arm: str) -> bool:
    """Whether an arm is tested everywhere: what trainers have, and all parts at once."""
    return arm in ("DEFAULTS", "paper", "everything")


class Training:
    """Gaussians drawn to a target of each view; every third of them is out of every view.

    Args:
        arm: one of `ARMS`, or a function that gets the training and returns its parts.
        places: the parameters' device, or a device by parameter, "" for the others.
        loss_on: the loss's device.
        layout: "dict", an Adam per parameter, or "single", one Adam with named groups.
        adam: options of torch.optim.Adam.
        scaled: whether a GradScaler scales the loss.
        masked: whether the steps get the views' masks.
        dropped: iterations whose loss is not finite.
        skips: whether the trainer leaves their steps out itself.
        counts: whether the trainer says its own iteration.
        options: of `PhaseScheduler`; `upgrade=False`: the trainer's own Adam.
    """

    def __init__(
        self,
        arm: str | Arm,
        *,
        places: str | Mapping[str, str] = "cpu",
        loss_on: str = "cpu",
        layout: str = "dict",
        adam: Mapping[str, Any] | None = None,
        scaled: bool = False,
        masked: bool = False,
        dropped: Iterable[int] = (),
        skips: bool = False,
        counts: bool = False,
        upgrade: bool = True,
        total: int | None = None,
        switch: int | None = None,
        dtype: torch.dtype = torch.float32,
        **options: Any,
    ) -> None:
        torch.manual_seed(0)
        long = arm in PRESETS
        total = total or (LONG if long else TOTAL)
        switch = switch or (LATE if long else SWITCH)
        draw = torch.Generator().manual_seed(0)
        given = {"": places} if isinstance(places, str) else places
        self.places = {name: given.get(name, given.get("", "cpu")) for name in SHAPES}
        self.loss_on, self.masked, self.dropped = torch.device(loss_on), masked, set(dropped)
        self.like: dict[str, Any] = {"generator": draw, "dtype": torch.float32}
        starts = {n: torch.randn(ROWS, *shape, **self.like) for n, shape in SHAPES.items()}
        self.splats = {
            name: Parameter(value.to(dtype).to(self.places[name])) for name, value in starts.items()
        }
        self.views = [self._view(view, dtype) for view in range(VIEWS)]
        made = ARMS[arm] if isinstance(arm, str) else arm
        self.phases = PhaseScheduler(total, switch, list(made(self)), **options)
        self.optimizers: Any = self._optimizers(layout, {"eps": 1e-15, **(adam or {})})
        self.upgraded = upgrade
        if upgrade:
            self.phases.upgrade(self.optimizers)
        self.scaler = torch.amp.GradScaler("cpu", init_scale=1024.0) if scaled else None
        self.iteration, self.skips, self.counts = 0, skips, counts
        self.waits: dict[int, list[str]] = {}  # iteration -> synchronisations of the package
        self.operators: Counter[str] = Counter()

    def _view(self, view: int, dtype: torch.dtype) -> dict[str, Any]:
        seen = torch.arange(ROWS) % 3 != view % 3
        found: dict[str, Any] = {}
        for name, shape in SHAPES.items():
            weight = (torch.rand(ROWS, *shape, **self.like) + 0.5) * shaped(seen, len(shape))
            target = torch.randn(ROWS, *shape, **self.like)
            on_loss = (weight.to(dtype).to(self.loss_on), target.to(dtype).to(self.loss_on))
            found[name] = *on_loss, seen.to(self.places[name])
        return found

    def _optimizers(self, layout: str, options: dict[str, Any]) -> Any:
        groups = {n: {"params": [p], "lr": RATES[n], "name": n} for n, p in self.splats.items()}
        if layout == "single":
            return torch.optim.Adam(groups.values(), **options)
        return {name: torch.optim.Adam([group], **options) for name, group in groups.items()}

    @property
    def every(self) -> list[Any]:
        return every_one(self.optimizers)

    def loss(self) -> Tensor:
        """A smooth loss, and a little of the photometric term that a part may replace."""
        total = torch.zeros((), device=self.loss_on, dtype=torch.float32)
        for name, param in self.splats.items():
            weight, target, _ = self.views[self.iteration % VIEWS][name]
            here = param if param.device == self.loss_on else param.to(self.loss_on)
            total = total + 0.02 * ((here - target).square() * weight).mean()
            if name == "sh0":
                total = total + 0.005 * self.phases.pixel_loss(here * weight, target * weight)
        return total * float("nan") if self.iteration in self.dropped else total

    def step(self) -> None:
        loss = self.loss()
        (loss if self.scaler is None else self.scaler.scale(loss)).backward()
        if self.upgraded:
            said = {"iteration": self.iteration} if self.counts else {}
            self.phases.observe(loss, **said)
        view = self.views[self.iteration % VIEWS]
        left_out = self.skips and self.iteration in self.dropped
        for optimizer in self.every:
            if left_out:
                optimizer.zero_grad(set_to_none=True)
                continue
            first = optimizer.param_groups[0]["name"]
            mask = {"visible": view[first][2]} if self.masked else {}
            if self.scaler is None:
                optimizer.step(**mask)
            else:
                self.scaler.step(optimizer, **mask)
            optimizer.zero_grad(set_to_none=True)
        if self.scaler is not None:
            self.scaler.update()

    def run(self, until: int | None = None) -> Training:
        """Iterations up to `until`, the end unless said."""
        gpu = simulated_device.active()
        while self.iteration < (self.phases.total_steps if until is None else until):
            if gpu is not None:
                gpu.forget()
            self.step()
            if gpu is not None:
                if gpu.ours:
                    self.waits[self.iteration] = gpu.ours
                self.operators += gpu.operators
            self.iteration += 1
        return self

    def kept(self) -> dict[str, Tensor]:
        """Copies of all tensors of the optimizers' state on the host, "PARAMETER.KEY"."""
        found = {}
        for optimizer in self.every:
            for group in optimizer.param_groups:
                state = optimizer.state.get(group["params"][0], {})
                tensors = {key: each for key, each in state.items() if isinstance(each, Tensor)}
                found |= {f"{group['name']}.{key}": on_host(v) for key, v in tensors.items()}
        return found

    def follow(self, first: Training) -> Training:
        """Go on from another's parameters and iteration; without its optimizers' state."""
        with torch.no_grad():
            for name, value in first.values().items():
                self.splats[name].copy_(value)
        self.iteration = first.iteration
        return self

    def resume(self, first: Training) -> Training:
        """Go on from all of another's, through its checkpoint."""
        self.follow(first)
        for ours, theirs in zip(self.every, first.every, strict=True):
            buffer = io.BytesIO()
            torch.save(theirs.state_dict(), buffer)
            buffer.seek(0)
            ours.load_state_dict(torch.load(buffer, weights_only=True))
        return self

    def resume_moments(self, first: Training) -> Training:
        """Go on from another's parameters and Adam's own state, as from the stock trainer's."""
        self.follow(first)
        for ours, theirs in zip(self.every, first.every, strict=True):
            groups = copy.deepcopy(ours.state_dict()["param_groups"])
            for group in groups:
                group.pop("opt3dgs", None)
            moments = {
                i: {key: value for key, value in state.items() if key in ADAMS}
                for i, state in theirs.state_dict()["state"].items()
            }
            ours.load_state_dict(copy.deepcopy({"state": moments, "param_groups": groups}))
        return self

    def values(self) -> dict[str, Tensor]:
        """Copies of the parameters on the host."""
        return {name: on_host(param.detach()) for name, param in self.splats.items()}


def shaped(rows: Tensor, dims: int) -> Tensor:
    """[N] as [N, 1, ..] with `dims` ones."""
    return rows.reshape(-1, *[1] * dims)


def distance(ours: Mapping[str, Tensor], theirs: Mapping[str, Tensor]) -> float:
    """The largest difference of two sets of parameters; infinite where one has a NaN alone."""
    pairs = [(ours[n].detach().double(), theirs[n].detach().double()) for n in ours]
    unlike = [float((a - b).abs().max().nan_to_num(float("inf"))) for a, b in pairs]
    return max(unlike)
