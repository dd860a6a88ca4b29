"""The pilot trainings: what each is, what it branches off, and how one is run."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from splatting.arms import ALL_OFF, PAPER_WARMUP, Arm
from splatting.fit import Fit, FitOptions
from splatting.scenes import load_scene

from opt3dgs_optim import EnergyHistogram, PhaseScheduler
from opt3dgs_optim.annealing import Annealing
from opt3dgs_optim.fading import Fading
from opt3dgs_optim.lqnadam import CurvatureOptions
from opt3dgs_optim.multiplier import ConstantMultiplier
from opt3dgs_optim.pooling import Pooling

SWITCH = 0.75  # of a pilot: where the trainings of the last phase branch off
PEAKS = (2.0, 4.0, 8.0, 16.0)
COUNT_EVERY = 10


@dataclass(frozen=True)
class Pilot:
    """One training. `peak` is that of the annealing under it, 0 for none."""

    kind: str  # "base", a part, "constant", "no noise", or a kind of last phase
    peak: float
    seed: int

    @property
    def trunk(self) -> Pilot | None:
        """The training that it branches off at the switch."""
        return Pilot("base", self.peak, self.seed) if self.kind in LAST_PHASES else None

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.kind.replace(' ', '-')}-peak-{self.peak:g}-seed-{self.seed}"


@dataclass(frozen=True)
class PilotOptions:
    """What all pilots of one advice share."""

    scene: str
    size: Any = "images_4"
    iterations: int = 400
    points: int = 2000
    init: Any = "sfm"
    sh_degree: int = 0

    def fit_options(self, seed: int) -> FitOptions:
        """For the examples' trainer."""
        return FitOptions(self.iterations, self.points, seed, self.init, self.sh_degree, SWITCH)


LAST_PHASES: dict[str, dict[str, Any]] = {
    "reset": {"reset_moments": True},
    "squared loss": {"reset_moments": True, "squared_loss": True},
    "curvature": {"reset_moments": True, "curvature": CurvatureOptions()},
}


def _arm(pilot: Pilot) -> Arm:
    def make(iterations: int, switch: float, nu: float | None) -> PhaseScheduler:
        options = dict(ALL_OFF)
        warmup = max(4, round(iterations * PAPER_WARMUP))
        if pilot.peak:
            options["annealing"] = Annealing(pilot.peak)
        if pilot.kind == "fading":
            options["fading"] = Fading()
        elif pilot.kind == "pooling":
            options["pooling"] = Pooling()
        elif pilot.kind == "multiplier":
            options["multiplier"] = EnergyHistogram(warmup=warmup)
        elif pilot.kind == "constant":
            assert nu is not None
            options["multiplier"] = ConstantMultiplier(nu, warmup=warmup)
        elif pilot.kind == "no noise":
            options["noise_scale"] = 0.0
        last = LAST_PHASES.get(pilot.kind)
        return PhaseScheduler(iterations, switch if last else 1.0, **options | (last or {}))

    return Arm(f"{pilot.kind}, peak {pilot.peak:g}", "a pilot", make=make)


def result_path(folder: Path, pilot: Pilot) -> Path:
    """Where the result of a finished pilot is."""
    return folder / f"{pilot.name}.json"


def finished(folder: Path, pilot: Pilot, options: PilotOptions) -> dict[str, Any] | None:
    """Its result; ValueError if it is of other options."""
    path = result_path(folder, pilot)
    if not path.exists():
        return None
    result = json.loads(path.read_text(encoding="utf-8"))
    if result["options"] != asdict(options):
        raise ValueError(
            f"{path}: of {result['options']}, asked for are {asdict(options)}; use another -o"
        )
    return result


def train(
    pilot: Pilot,
    options: PilotOptions,
    folder: Path,
    mean_nu: float | None = None,
    count: Callable[[int], object] = lambda _steps: None,
) -> dict[str, Any]:
    """Train one pilot to its end and write its result; a base leaves a checkpoint to branch off."""
    torch.set_num_threads(1)
    fit = Fit(
        _scene(options.scene, options.size), _arm(pilot), options.fit_options(pilot.seed), mean_nu
    )
    at = round(SWITCH * options.iterations)
    if pilot.trunk is not None:
        fit.load(folder / f"{pilot.trunk.name}.pt", _arm(pilot.trunk).name)
    first = fit.iteration
    fit.compile_kernels()
    seconds: list[float] = [0.0, 0.0]  # before and after the switch
    while fit.iteration < options.iterations:
        last = int(fit.iteration >= at)
        began = time.process_time()
        fit.step()
        seconds[last] += time.process_time() - began
        if fit.iteration == at and pilot.kind == "base":
            fit.save(folder / f"{pilot.name}.pt")
        if (fit.iteration - first) % COUNT_EVERY == 0:
            count(COUNT_EVERY)
    count((fit.iteration - first) % COUNT_EVERY)
    phases = fit.phases
    assert phases is not None
    result = {
        "options": asdict(options),
        "pilot": asdict(pilot),
        **{name: round(value, 4) for name, value in fit.evaluate().items()},
        "views": len(fit.scene.test),
        "ms_before_switch": 1e3 * seconds[0] / max(at - first, 1),
        "ms_after_switch": 1e3 * seconds[1] / (options.iterations - at),
        "state_bytes_per_point": _state_bytes(fit) / len(fit.gaussians["means"]),
        "mean_nu": fit.mean_nu,
        "accepted_share": None if phases.accepted_share is None else float(phases.accepted_share),
    }
    partial = result_path(folder, pilot).with_suffix(".partial")
    partial.write_text(json.dumps(result), encoding="utf-8")
    os.replace(partial, result_path(folder, pilot))
    return result


def steps_of(pilot: Pilot, options: PilotOptions) -> int:
    """Iterations that it trains."""
    whole = options.iterations
    return whole - round(SWITCH * whole) if pilot.trunk is not None else whole


_loaded: dict[tuple[str, Any], Any] = {}


def _scene(source: str, size: Any) -> Any:
    """Read once in each process."""
    if (source, size) not in _loaded:
        _loaded[source, size] = load_scene(source, size)
    return _loaded[source, size]


def _state_bytes(fit: Fit) -> int:
    return sum(
        value.numel() * value.element_size()
        for optimizer in fit.optimizers.values()
        for state in optimizer.state.values()
        for value in state.values()
        if isinstance(value, torch.Tensor) and value.dim() > 0
    )
