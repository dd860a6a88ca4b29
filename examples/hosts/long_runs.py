"""Three trainers for 3,000 iterations each, stock and edited: what the lines do to PSNR.

Those that clone, split and prune are also trained with `parts=DEFAULTS_ADC`.

    python examples/hosts/long_runs.py --trainers DIR --scene SCENE

DIR and SCENE are those of `survey.py`. Each training is the trainer's own script, run on a CPU
through `on_cpu.py`, with every schedule of its 30,000 iterations scaled to a tenth: learning rates,
densification, resets. Each takes five to ten minutes of a core. Every training's figure goes into
docs/hosts/long_runs.json when it has ended, and one that is there already is kept: the command may
be stopped and called again. `survey.py --write` puts the figures on the page.
"""

from __future__ import annotations

import argparse
import datetime
import json
import platform
import re
import shutil
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch
from hosts.trials import GSPLAT, NO_VIDEO, Trial, commit_of, copy_scene, parts_of

from opt3dgs_optim import __version__

FIGURES = Path(__file__).resolve().parents[2] / "docs" / "hosts" / "long_runs.json"
ITERATIONS = 3_000
FULL = 30_000  # the trainers' own schedules, which are scaled to ITERATIONS
CAP = 4_000  # Gaussians of MCMC: what a scene of this size needs
SCALED_INRIA = {
    "position_lr_max_steps": FULL,
    "densify_from_iter": 500,
    "densification_interval": 100,
    "opacity_reset_interval": 3_000,
    "densify_until_iter": 15_000,
}


@dataclass(frozen=True)
class LongRun(Trial):
    """A training with its trainer's schedules scaled, and nothing saved.

    Attributes:
        clones: whether it clones, splits and prunes.
    """

    clones: bool = True

    def command(self, scene: Path, out: Path, iterations: int, *, ours: bool) -> list[str]:
        """The script's arguments."""
        n = str(iterations)
        if self.gsplat:
            strategy, *rest = self.options
            return [
                *(strategy, "--data_dir", str(scene), "--result_dir", str(out), *rest),
                *("--disable_viewer", "--data_factor", "4", *NO_VIDEO, "--eval_steps", str(FULL)),
                *("--max_steps", str(FULL), "--steps_scaler", str(iterations / FULL)),
            ]
        scaled = {name: value * iterations // FULL for name, value in SCALED_INRIA.items()}
        return [
            *("-s", str(scene), "-m", str(out), "--images", "images_jpg", "--eval"),
            *("--iterations", n, "--test_iterations", n, *self.options),
            *(text for name, value in scaled.items() for text in (f"--{name}", str(value))),
        ]


LONG_RUNS = (
    LongRun("gsplat-1.5.3", GSPLAT, ("mcmc", "--strategy.cap_max", str(CAP)), clones=False),
    LongRun("gsplat-1.5.3", GSPLAT, ("default",)),
    LongRun("gaussian-splatting", "train.py", ("--disable_viewer",)),
)


def train(
    run: LongRun, trainers: Path, scene: Path, iterations: int, *, ours: bool
) -> dict[str, Any]:
    """Train, stock or edited, and return what came of it.

    Raises:
        RuntimeError: the training stopped; the message has the end of its output.
    """
    work = Path(tempfile.mkdtemp(prefix="long_run_"))
    try:
        done = run.start(trainers, scene, work, "out", ours=ours, iterations=iterations)
        gaussians = number_of_gaussians(done.output, work / "out")
    finally:
        shutil.rmtree(work)
    if done.code != 0 or done.psnr is None:
        raise RuntimeError(f"{run.name} stopped with {done.code}: {done.output[-3000:]}")
    return {
        "psnr": round(done.psnr, 3),
        "gaussians": gaussians,
        "parts": parts_of(done.output),
        "version": __version__,
        "date": datetime.date.today().isoformat(),
        "torch": torch.__version__,
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
    }


def number_of_gaussians(output: str, folder: Path) -> int:
    """How many there are at the end: gsplat prints it, INRIA's trainer saves them.

    Raises:
        RuntimeError: the training has done neither.
    """
    said = re.findall(r"Number of GS: (\d+)", output)
    if said:
        return int(said[-1])
    for path in sorted(folder.glob("point_cloud/iteration_*/point_cloud.ply")):
        said = re.findall(rb"element vertex (\d+)", path.read_bytes()[:4096])
    if not said:
        raise RuntimeError(f"nothing says how many Gaussians there are: {output[-3000:]}")
    return int(said[-1])


def read_rows(path: Path) -> dict[str, dict[str, Any]]:
    """The rows that there are, by the names of the runs."""
    if not path.is_file():
        return {}
    return {row["name"]: row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}


def main() -> None:
    """Train what has no figure yet, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trainers", type=Path, required=True, help="a folder of repositories")
    parser.add_argument("--scene", type=Path, required=True, help="a scene in COLMAP's layout")
    parser.add_argument("--iterations", type=int, default=ITERATIONS)
    parser.add_argument("--only", default="", help="run those whose name holds this text")
    parser.add_argument("--again", action="store_true", help="also those that have a figure")
    parser.add_argument("--json", type=Path, default=FIGURES, help="where the figures go")
    options = parser.parse_args()
    rows = read_rows(options.json)
    with tempfile.TemporaryDirectory() as folder:
        scene = copy_scene(options.scene, Path(folder) / "scene")
        for run in LONG_RUNS:
            if options.only not in run.name:
                continue
            about = {
                "name": run.name,
                "commit": commit_of(options.trainers / run.trainer),
                "iterations": options.iterations,
                "scene": options.scene.name,
            }
            row = rows.get(run.name, {})
            if options.again or any(row.get(key) != value for key, value in about.items()):
                row = about
            rows[run.name] = row
            kinds = {"stock": (run, False), "edited": (run, True)}
            if run.clones:
                kinds["DEFAULTS_ADC"] = replace(run, scheduler="parts=DEFAULTS_ADC"), True
            for kind, (form, ours) in kinds.items():
                if kind not in row:
                    row[kind] = train(form, options.trainers, scene, options.iterations, ours=ours)
                    print(f"{run.name}, {kind}: {row[kind]['psnr']} dB", flush=True)
                kept = [rows[each.name] for each in LONG_RUNS if each.name in rows]
                text = json.dumps({"rows": kept}, indent=1) + "\n"
                options.json.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
