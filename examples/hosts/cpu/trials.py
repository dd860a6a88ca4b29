"""Short trainings of real trainers' scripts on a CPU, stock and with the lines."""

from __future__ import annotations

import os
import re
import shutil
import struct
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import torch
from PIL import Image
from plyfile import PlyData

from opt3dgs_optim.hosts import diff
from opt3dgs_optim.hosts.pages import places_in

ON_CPU = Path(__file__).resolve().parent / "on_cpu.py"
TRAINERS = Path(os.environ.get("OPT3DGS_TRAINERS", "/no/trainers"))
EVERY_POINT = 12  # of the scene's sparse points, one in so many: seconds instead of minutes
LIMIT = 3600  # seconds a training
HALF, LENGTH = 42, 84  # iterations; the scene has 14 training views, so that both end an epoch


@dataclass(frozen=True)
class Trial:
    """One way to run one trainer."""

    trainer: str  # the folder of its sources
    options: str = ""
    script: str = "train.py"
    worse: float = 2.0  # dB that so few iterations may end below stock's; they are no result

    @property
    def gsplat(self) -> bool:
        """Whether it is one of gsplat's scripts, which go on from no checkpoint."""
        return self.trainer.startswith("gsplat")

    @property
    def name(self) -> str:
        """For tests."""
        return " ".join(word for word in (self.trainer, *self.options.split()[:1]) if word)

    def command(self, scene: Path, out: Path) -> list[str]:
        """The script's arguments."""
        n, options = str(LENGTH), self.options.split()
        if self.gsplat:
            where = ["--data_dir", str(scene), "--result_dir", str(out), "--data_factor", "4"]
            steps = ["--max_steps", n, "--eval_steps", n, "--save_steps", n, "--disable_viewer"]
            often = ["--strategy.refine_start_iter", "10", "--strategy.refine_every", "5"]
            return [*options[:1], *where, *steps, *often, *options[1:]]
        where = ["-s", str(scene), "-m", str(out), "--iterations", n, "--test_iterations", n]
        often = ["--densify_from_iter", "5", "--densification_interval", "5"]
        end = ["--densify_until_iter", "38", "--opacity_reset_interval", "18"]
        saved = ["--checkpoint_iterations", str(HALF), "--images", "images_jpg", "--eval"]
        return [*where, *often, *end, *saved, *options]

    def train(
        self,
        scene: Path,
        work: Path,
        name: str,
        *more: str,
        ours: bool,
        end: int | None = None,
        enough: int | None = None,
    ) -> Done:
        """Train, stock or with our lines, in `work / name`.

        `end`: `finish()` there, and stop. `enough`: no end is planned, until there.
        """
        folder = TRAINERS / self.trainer
        if ours:
            folder = work / f"edited {end} {enough}" / self.trainer
            if not folder.is_dir():
                copy_edited(self, folder, end, enough)
        command = [*self.command(scene, work / name), *more]
        return run(folder / self.script, command, work / name)


@dataclass(frozen=True)
class Done:
    """A finished run."""

    code: int
    output: str
    out: Path

    @property
    def psnr(self) -> float | None:
        """That of the test views, which the trainer printed last, dB."""
        found = re.findall(r"(?:Evaluating test: .*?PSNR |PSNR *: +)([\d.]+)", self.output)
        return float(found[-1]) if found else None

    def saved(self) -> Path:
        """The Gaussians at the end."""
        (path,) = [
            *self.out.glob(f"ckpts/ckpt_{LENGTH - 1}_rank0.pt"),
            *self.out.glob(f"point_cloud/iteration_{LENGTH}/point_cloud.ply"),
        ]
        return path


def num_saved(path: Path) -> int:
    """How many Gaussians a saved .ply, or a checkpoint of gsplat's, has."""
    if path.suffix == ".ply":
        return PlyData.read(str(path))["vertex"].count
    return len(torch.load(path, weights_only=False)["splats"]["means"])


_TAMING = "--cams 2 --percent_dense 0.03 --mode final_count --budget 6000"
_TAMING += " --opacity_reset_interval 1000 --densify_until_iter 40"  # a budget for each refinement
TRIALS = (
    *(
        Trial(f"gsplat-{version}", options, "examples/simple_trainer.py")
        for version in ("1.4.0", "1.5.3", "main")
        for options in ("mcmc", "default")
    ),
    Trial("gaussian-splatting", "--disable_viewer"),
    # Its steps have no bias correction: early ones are up to 6.6 times as long as Adam's.
    Trial("gaussian-splatting", "--optimizer_type sparse_adam --disable_viewer", worse=6.0),
    Trial("3dgs-mcmc", "--cap_max 2500 --init_type sfm"),
    Trial("2d-gaussian-splatting", "--opacity_cull 0.005"),  # else none is left after a reset
    Trial("taming-3dgs", _TAMING),
    Trial("mini-splatting", "--simp_iteration1 28 --densify_until_iter 28 --simp_iteration2 32 "
          "--imp_metric indoor", script="ms/train.py"),
)  # fmt: skip
GSPLAT_NEEDS = "torchmetrics tyro cv2 sklearn yaml imageio"
NEEDS = {  # what a trainer imports before it is asked for anything
    **{f"gsplat-{version}": GSPLAT_NEEDS for version in ("1.4.0", "1.5.3")},
    "gsplat-main": f"{GSPLAT_NEEDS} piexif pycolmap",
    "gaussian-splatting": "cv2",
}


def missing(trial: Trial) -> str | None:
    """Why a trial cannot run here; None where it can."""
    import importlib.util

    if not (TRAINERS / trial.trainer / trial.script).is_file():
        return f"no {TRAINERS / trial.trainer}: put its sources there, set OPT3DGS_TRAINERS"
    names = NEEDS.get(trial.trainer, "").split()
    lacking = [name for name in names if not importlib.util.find_spec(name)]
    return f"{trial.trainer} needs {', '.join(lacking)}: pip install them" if lacking else None


def copy_edited(
    trial: Trial, target: Path, end: int | None = None, enough: int | None = None
) -> None:
    """The trainer's Python files, with our lines in the script."""
    plain = shutil.ignore_patterns(".git", "*.png", "*.jpg", "*.gif", "*.mp4", "*.so")
    shutil.copytree(TRAINERS / trial.trainer, target, ignore=plain)
    script = target / trial.script
    old = script.read_bytes().decode()
    known, text = diff.edited(old)
    if enough is not None:
        lines = known.open_end.replace("10_000", str(enough))
        text, _ = diff.inserted(old, places_in(lines))
    if end is not None:  # the loop ends with that iteration, as by a limit of time
        text = ending(text, end)
    script.write_bytes(text.encode())


def ending(text: str, end: int) -> str:
    """The script with `finish()` at the top of an iteration of INRIA's loop, and an end."""
    loop = re.search(r"^    for iteration in range\(first_iter, .*\n", text, re.M)
    assert loop is not None
    lines = (
        f"        if iteration == {end + 1}:\n            phases.finish()\n"
        f"            scene.save({end})\n            break\n"
    )
    return text[: loop.end()] + lines + text[loop.end() :]


def copy_scene(source: Path, target: Path) -> Path:
    """A scene as these trainers read it: small photos as .png and as .jpg, some of the points."""
    for folder in ("images", "sparse"):
        shutil.copytree(source / folder, target / folder)
    for kind in ("images_jpg", "images_4"):
        (target / kind).mkdir()
    for photo in (source / "images_4").iterdir():
        with Image.open(photo) as image:
            small = image.resize((image.width // 2, image.height // 2))
            small.save(target / "images_4" / f"{photo.stem}.png")
            small.save(target / "images_jpg" / photo.name)
    path = target / "sparse" / "0" / "points3D.bin"
    data, at, kept = path.read_bytes(), 8, []
    (count,) = struct.unpack_from("<Q", data)
    for index in range(count):  # id, position, colour, error: 43 bytes; then the track
        (track,) = struct.unpack_from("<Q", data, at + 43)
        if index % EVERY_POINT == 0:
            kept.append(data[at : at + 43] + struct.pack("<Q", 0))
        at += 51 + 8 * track
    path.unlink()
    path.write_bytes(struct.pack("<Q", len(kept)) + b"".join(kept))
    return target


def run(script: Path, arguments: list[str], out: Path) -> Done:
    """Run a script on the CPU; it may write beside itself, so that it has a folder of its own."""
    folder = out / "cwd"
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        [sys.executable, str(ON_CPU), str(script), *arguments],
        cwd=folder,
        # INRIA's checkpoints hold a number of numpy's type.
        env={
            **os.environ,
            "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1",
            "OMP_NUM_THREADS": "1",
            "OPT3DGS_END": str(out / "end.pt"),
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        timeout=LIMIT,
        check=False,
    )
    return Done(done.returncode, done.stdout, out)
