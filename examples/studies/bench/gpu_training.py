"""gsplat's own `simple_trainer.py mcmc`, stock and with the lines of `opt3dgs hosts diff`."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splatting.colmap_writer import write_colmap
from splatting.scenes import load_scene

from opt3dgs_optim.hosts import write

ON_CPU = Path(__file__).resolve().parents[2] / "hosts" / "on_cpu.py"
KINDS = ("stock", "ours")
CAP = "--strategy.cap_max"
SHORT = 2_000  # iterations; below it the strategy's schedule is shortened too


def train_both(
    script: Path, scene: Path | None, work: Path, iterations: int, points: int, *, cpu: bool
) -> dict[str, Any]:
    """PSNR of the held-out views and seconds of both trainings, or the reason why there is none.

    Args:
        script: gsplat's `simple_trainer.py`; copied before it is edited.
        scene: folder in COLMAP's layout; None: the embedded one.
        work: folder for the scene, the edited trainer and the results.
        points: the most Gaussians.
        cpu: map CUDA to the CPU and gsplat's rasterizer to the examples'.
    """
    if scene is None:
        scene = work / "embedded"
        write_colmap(load_scene("embedded", "images_4" if cpu else "images"), scene)
    edited = work / "edited"
    plain = shutil.ignore_patterns(".git", "*.png", "*.jpg", "*.gif", "*.mp4", "results")
    if not edited.is_dir():
        shutil.copytree(script.parent, edited, ignore=plain)
        write(edited / script.name)
    scripts = {"stock": script, "ours": edited / script.name}
    return {
        kind: train(scripts[kind], scene, work / kind, iterations, points, cpu=cpu)
        for kind in KINDS
    }


def train(
    script: Path, scene: Path, out: Path, iterations: int, points: int, *, cpu: bool
) -> dict[str, Any]:
    """One training, in a process of its own."""
    steps, count = str(iterations), str(points)
    words = ["mcmc", "--data_dir", str(scene), "--data_factor", "1", "--result_dir", str(out)]
    words += ["--max_steps", steps, "--eval_steps", steps, "--save_steps", steps, CAP, count]
    words += ["--disable_viewer", "--disable_video"]
    if iterations < SHORT:
        words += ["--strategy.refine_start_iter", "10", "--strategy.refine_every", "10"]
    done, seconds = run([*([str(ON_CPU)] if cpu else []), str(script), *words], out / "cwd")
    if done.returncode != 0:
        lines = [line.strip() for line in re.split(r"[\r\n]", done.stdout) if line.strip()]
        return {"skipped": (lines or ["no output"])[-1], "seconds": round(seconds, 1)}
    found = {"seconds": round(seconds, 1), **stats(out / "stats")}
    printed = re.findall(r"PSNR: ([\d.]+)", done.stdout)
    return {"psnr": float(printed[-1]), **found} if printed else found


def stats(folder: Path) -> dict[str, float]:
    """What the trainer wrote of its last evaluation, and its own seconds of the training."""
    made: dict[str, float] = {}
    for path in sorted(folder.glob("val_step*.json")):
        made |= {k: v for k, v in json.loads(path.read_text()).items() if k in ("psnr", "ssim")}
    for path in sorted(folder.glob("train_step*.json")):
        read = json.loads(path.read_text())
        names = {"ellipse_time": "training_seconds", "num_GS": "gaussians", "mem": "memory_gb"}
        made |= {names[key]: value for key, value in read.items() if key in names}
    return made


def run(words: Sequence[str], folder: Path) -> tuple[subprocess.CompletedProcess[str], float]:
    """Run a Python script in `folder`; what it was, and the seconds that it took."""
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *words],
        cwd=folder,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        check=False,
    )
    return done, time.perf_counter() - start
