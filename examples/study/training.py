"""Trainings of the study: python examples/study/training.py CALL.json... (made by run.py).

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
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch
from splatting.fit import FitOptions
from splatting.scenes import Scene, load_scene

from study.arms import find_study_arm
from study.fitting import StudyFit

BRANCH_SHARES = (0.75, 0.9, 29 / 30)  # where the arms of the last phase branch off


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

    def options(self) -> FitOptions:
        """For `Fit`; a trunk and its branches share them."""
        init: Any = self.init
        return FitOptions(self.iterations, self.points, self.seed, init, self.sh_degree, 1.0)


def train(spec: Spec, folder: Path, trunk: Path | None, mean_nu: float | None) -> dict[str, Any]:
    """Train to the end; return the record that is also in `folder/record.json`."""
    torch.set_num_threads(1)
    scene, arm = _scene(spec.scene), find_study_arm(spec.arm)
    fit = StudyFit(scene, arm, spec.options(), mean_nu)
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
        record["curve"].append({"iteration": 0, "seconds": 0.0, **_rounded(fit.evaluate())})
    while fit.iteration < total:
        start = time.process_time()
        while True:
            fit.step()
            if fit.iteration in marks:
                break
        record["seconds"] = round(record["seconds"] + time.process_time() - start, 3)
        metrics = _rounded(fit.evaluate())
        now = {"iteration": fit.iteration, "seconds": record["seconds"], **metrics}
        record["curve"].append(now)
        if fit.iteration in (round(share * total) for share in BRANCH_SHARES):
            fit.save(folder / f"at-{fit.iteration}.pt")
        _write(path, record)
        fit.save(checkpoint)
    record["mean_nu"] = fit.mean_nu
    record["state_bytes"] = fit.state_bytes()
    record["peak_rss_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    record["machine"] = machine()
    record["date"] = time.strftime("%Y-%m-%d", time.gmtime())
    record["finished"] = True
    images = [(255 * fit.image(view)).round().to(torch.uint8).numpy() for view in scene.test]
    np.savez_compressed(folder / "renders.npz", *images)
    _write(path, record)
    return record


def machine() -> str:
    """What the training runs on, as the page says it."""
    system = f"{platform.system()} {platform.machine()}"
    return f"{system}, {os.cpu_count()} cores, torch {torch.__version__}"


@cache
def _scene(source: str) -> Scene:
    return load_scene(source)


def _marks(total: int) -> set[int]:
    """Iterations to evaluate at: every twentieth, and where arms branch off."""
    every = max(total // 20, 1)
    return {*range(every, total, every), *(round(s * total) for s in BRANCH_SHARES), total}


def _rounded(metrics: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 4) for name, value in metrics.items()}


def _write(path: Path, record: dict[str, Any]) -> None:
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(record), encoding="utf-8")
    os.replace(partial, path)


def main() -> int:
    """Run what the call files say, one after the other."""
    for path in sys.argv[1:]:
        call = json.loads(Path(path).read_text(encoding="utf-8"))
        trunk = Path(call["trunk"]) if call["trunk"] else None
        train(Spec(**call["spec"]), Path(call["folder"]), trunk, call["mean_nu"])
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
