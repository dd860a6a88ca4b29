"""Trainings of the study: python examples/studies/scenes/training.py CALL.json... (made by run.py).

Writes `record.json` (the curve and what the training was), a checkpoint at every evaluation, and
the last renders of the test views. A second start goes on from the checkpoint.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from splatting.fit import Fit, FitOptions
from splatting.scenes import Background, Scene, Size, load_scene

from studies.scenes.arms import StudyArm, find_study_arm
from studies.scenes.perceptual import NET, load_tool, mean_lpips

DIGITS = {"median_scale": 6}
SEEN = "visible_share"  # what `OutOfView` calls the mean share of the points that a view sees
BACKGROUNDS: dict[str, Background] = {"lego": "white"}
BRANCH_SHARES = (0.5, 0.75, 0.9, 29 / 30)  # where the arms of the last phase branch off


@dataclass(frozen=True)
class Spec:
    """What identifies a training."""

    scene: str  # a folder, or "embedded"
    arm: str
    seed: int
    iterations: int
    points: int
    init: str = "sfm"
    sh_degree: int = 0
    size: Size = "images_4"
    rotated: bool = False  # the seed says which views are held out: index = seed modulo 8
    views: int = 0  # evenly spaced ones of those to train on; 0: all
    rates: float = 1.0  # factor on all learning rates of the trainer

    def options(self) -> FitOptions:
        """For `Fit`; a trunk and its branches share them."""
        init: Any = self.init
        options = (self.iterations, self.points, self.seed, init, self.sh_degree, 1.0)
        return FitOptions(*options, rates=self.rates)


def train(
    spec: Spec,
    folder: Path,
    trunk: Path | None,
    mean_nu: float | None,
    lpips: Callable[[Scene, list[np.ndarray]], float] | None = None,
) -> dict[str, Any]:
    """Train to the end; return the record that is also in `folder/record.json`."""

    def evaluate() -> dict[str, float]:
        metrics = fit.evaluate() | _population(fit)
        if lpips is not None:
            metrics["lpips"] = lpips(scene, renders(fit))
        return {name: round(value, DIGITS.get(name, 4)) for name, value in metrics.items()}

    torch.set_num_threads(1)
    scene, arm = scene_of(spec), find_study_arm(spec.arm)
    fit = fit_of(arm)(scene, arm, spec.options(), mean_nu)
    checkpoint, path = folder / "checkpoint.pt", folder / "record.json"
    total, marks = spec.iterations, _marks(spec.iterations)
    record: dict[str, Any] = {**asdict(spec), "scene": scene.name, "curve": [], "seconds": 0.0}
    if checkpoint.exists() and path.exists():
        fit.load(checkpoint)
        record = json.loads(path.read_text(encoding="utf-8"))
        # The record is written first, so it may be one evaluation ahead of the checkpoint.
        record["curve"] = [r for r in record["curve"] if r["iteration"] <= fit.iteration]
        record["seconds"] = record["curve"][-1]["seconds"]
    elif arm.trunk is not None:
        assert trunk is not None
        at = round(arm.switch * total)
        fit.load(trunk / f"at-{at}.pt", arm.trunk)
        record["curve"] = [
            row
            for row in json.loads((trunk / "record.json").read_text(encoding="utf-8"))["curve"]
            if row["iteration"] <= at
        ]
        record["seconds"] = record["curve"][-1]["seconds"]
    fit.compile_kernels()
    if not record["curve"]:
        record["curve"].append({"iteration": 0, "seconds": 0.0, **evaluate()})
    while fit.iteration < total:
        start = time.process_time()
        while True:
            fit.step()
            if fit.iteration in marks:
                break
        record["seconds"] = round(record["seconds"] + time.process_time() - start, 3)
        now = {"iteration": fit.iteration, "seconds": record["seconds"]}
        record["curve"].append({**now, **evaluate()})
        if fit.iteration in (round(share * total) for share in BRANCH_SHARES):
            fit.save(folder / f"at-{fit.iteration}.pt")
        _write(path, record)
        fit.save(checkpoint)
    record["mean_nu"] = fit.mean_nu
    record["state_bytes"] = state_bytes(fit)
    record["peak_rss_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    record["machine"] = machine()
    record["date"] = time.strftime("%Y-%m-%d", time.gmtime())
    record["finished"] = True
    np.savez_compressed(folder / "renders.npz", *renders(fit))
    _write(path, record)
    return record


def fit_of(arm: StudyArm) -> type[Fit]:
    """The trainer of an arm."""
    if not arm.adaptive:
        return Fit
    from studies.scenes.adaptive import AdaptiveFit  # gsplat stays optional

    return AdaptiveFit


def _population(fit: Fit) -> dict[str, float]:
    """Gaussians moved so far, the median of their longest axis (in extents) and opacity.

    And the mean share of them that a view sees, where a part keeps it.
    """
    scales, logits = fit.gaussians["scales"].detach(), fit.gaussians["opacities"].detach()
    numbers = {} if fit.phases is None else fit.phases.numbers()
    seen = {SEEN: float(numbers[SEEN])} if SEEN in numbers else {}
    return seen | {
        "relocated": float(fit.relocated),
        "median_scale": float(scales.amax(1).median().exp()) / fit.scene.extent,
        "median_opacity": float(torch.sigmoid(logits).median()),
    }


def renders(fit: Fit) -> list[np.ndarray]:
    """The test views as they are now, [H, W, 3] uint8 each."""
    return [(255 * fit.image(view)).round().to(torch.uint8).numpy() for view in fit.scene.test]


def state_bytes(fit: Fit) -> int:
    """Memory of the optimizers' state, in bytes."""
    states = [state for opt in fit.optimizers.values() for state in opt.state.values()]
    tensors = [value for state in states for value in state.values()]
    return sum(t.numel() * t.element_size() for t in tensors if isinstance(t, torch.Tensor))


def machine() -> str:
    """What the training runs on, as the page says it."""
    system = f"{platform.system()} {platform.machine()}"
    return f"{system}, {os.cpu_count()} cores, torch {torch.__version__}"


def scene_of(spec: Spec) -> Scene:
    """The scene with the views that this training holds out."""
    scene = _scene(spec.scene, spec.size, spec.seed % 8 if spec.rotated else None)
    train, count = scene.train, len(scene.train)
    if spec.views:
        if not 2 <= spec.views <= count:
            raise ValueError(f"views={spec.views}, but 2 to {count} are allowed, or 0 for all")
        train = [train[i * count // spec.views] for i in range(spec.views)]
    return replace(scene, train=train)


@cache
def perceptual(tool: Path, weights: Path) -> Callable[[Scene, list[np.ndarray]], float]:
    """LPIPS of renders of a scene's test views; see `perceptual.py` for the tool."""
    module = load_tool(tool)
    return partial(mean_lpips, module, module.load(weights, NET))


@cache
def _scene(source: str, size: Size, held_out: int | None) -> Scene:
    background = BACKGROUNDS.get(Path(source).name, "black")
    return load_scene(source, size, background=background, held_out=held_out)


def _marks(total: int) -> set[int]:
    """Iterations to evaluate at: every twentieth, and where arms branch off."""
    every = max(total // 20, 1)
    return {*range(every, total, every), *(round(s * total) for s in BRANCH_SHARES), total}


def _write(path: Path, record: dict[str, Any]) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(record), encoding="utf-8")
    os.replace(partial, path)


def main() -> int:
    """Run what the call files say, one after the other."""
    for path in sys.argv[1:]:
        call = json.loads(Path(path).read_text(encoding="utf-8"))
        trunk = Path(call["trunk"]) if call["trunk"] else None
        lpips = call.get("lpips") and perceptual(*map(Path, call["lpips"]))
        train(Spec(**call["spec"]), Path(call["folder"]), trunk, call["mean_nu"], lpips)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
