"""Short trainings of real trainers on a CPU, stock and edited: `pytest -m hosts` runs them."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import sys
import textwrap
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from PIL import Image

from opt3dgs_optim.hosts import write

DOCS = Path(__file__).resolve().parents[2] / "docs" / "hosts"
ON_CPU = Path(__file__).resolve().parent / "on_cpu.py"
ITERATIONS = 100
GSPLAT = "examples/simple_trainer.py"
EVERY_POINT = 5  # of the scene's sparse points, every fifth: seconds instead of minutes
LIMIT = 7200  # seconds a training
SAYS_PARTS = re.compile(r"opt3dgs_optim .*, parts (.*), in the steps of ")
PART = re.compile(r"(\w+)\(")
SAYS_OFF = re.compile(r"opt3dgs_optim: iteration \d+: (\S+) is switched off")

INRIA_OPTIONS = (
    *("--images", "images_jpg", "--eval", "--densify_from_iter", "10"),
    *("--densification_interval", "10", "--opacity_reset_interval", "35"),
)
SHORT_GSPLAT = (
    *("--disable_viewer", "--data_factor", "4"),
    *("--strategy.refine_start_iter", "10", "--strategy.refine_every", "10"),
)
SHORT_SPLATFACTO = (
    *("--pipeline.model.warmup-length", "10", "--pipeline.model.refine-every", "10"),
)
NO_VIDEO = ("--disable_video",)
LIGHTNING_PLUGIN = """\
model:
  plugins:
    - class_path: opt3dgs_optim.hosts.lightning.Opt3DGS
"""
SHORTER = {*INRIA_OPTIONS, *SHORT_GSPLAT, *SHORT_SPLATFACTO, *NO_VIDEO}


@dataclass(frozen=True)
class Trial:
    """One way to run one trainer."""

    trainer: str  # the folder of its sources
    script: str  # its path there
    options: tuple[str, ...]  # beside scene, iterations and output, which `command` adds
    refused: str | None = None  # what a refusal says, where the edited trainer must refuse
    stock_fails: str | None = None  # what the stock trainer stops with, where it does not run
    different: str = ""  # from the stock run, for the table
    scheduler: str = ""  # arguments that the edited script's PhaseScheduler has beside its own
    lines: ClassVar[str] = "-"  # for the table, where `diff` writes none
    trusted: ClassVar[bool] = True  # its checkpoints may hold more than tensors, as INRIA's do

    @property
    def name(self) -> str:
        """For tests and tables."""
        own = [o for o in self.options if o not in SHORTER]
        return " ".join([self.trainer, *own])

    @property
    def gsplat(self) -> bool:
        """Whether it is one of gsplat's scripts."""
        return self.trainer.startswith("gsplat")

    def command(self, scene: Path, out: Path, iterations: int, *, ours: bool) -> list[str]:
        """The script's arguments; the same for both but where the method has another name."""
        n = str(iterations)
        if self.gsplat:
            where = ["--data_dir", str(scene), "--result_dir", str(out)]
            steps = ["--max_steps", n, "--eval_steps", n, "--save_steps", n]
            return [*self.options[:1], *where, *steps, *self.options[1:]]
        where = ["-s", str(scene), "-m", str(out), "--iterations", n, "--test_iterations", n]
        return [*where, "--checkpoint_iterations", str(iterations // 2), *self.options]

    def checkpoint(self, out: Path, iterations: int) -> Path:
        """The file that a run leaves behind."""
        if self.gsplat:
            return out / "ckpts" / f"ckpt_{iterations - 1}_rank0.pt"
        return out / f"chkpnt{iterations // 2}.pth"

    def going_on(self, checkpoint: Path) -> list[str]:
        """The options to go on from a checkpoint; gsplat only evaluates one."""
        return ["--ckpt" if self.gsplat else "--start_checkpoint", str(checkpoint)]

    def find_script(self, trainers: Path, work: Path, *, ours: bool) -> Path:
        """The script to run: the trainer's own, or one with our lines in a copy in `work`."""
        if ours:
            return edited_copy(self, trainers, work / "edited" / self.trainer)
        return trainers / self.trainer / self.script

    def edit(self, folder: Path) -> None:
        """Put our lines into the script of the copy in `folder`."""
        write(folder / self.script)
        if self.scheduler:
            give_to_scheduler(folder / self.script, self.scheduler)

    def start(
        self,
        trainers: Path,
        scene: Path,
        work: Path,
        out: str,
        *more: str,
        ours: bool,
        iterations: int = ITERATIONS,
    ) -> Done:
        """Train, stock or with our lines, in `work / out`; copies of the trainers go to `work`."""
        script = self.find_script(trainers, work, ours=ours)
        command = self.command(scene, work / out, iterations, ours=ours)
        return run(script, [*command, *more], work / out / "cwd", trusted=self.trusted)


class Nerfstudio(Trial):
    """`ns-train`, then `ns-eval`: nothing is edited, the method has another name."""

    lines = "none needed"

    def command(self, scene: Path, out: Path, iterations: int, *, ours: bool) -> list[str]:
        """The script's arguments."""
        method, *options = self.options
        return [
            *(f"{method}-opt3dgs" if ours else method, "--vis", "tensorboard"),
            *("--output-dir", str(out), "--experiment-name", "run", "--timestamp", "one"),
            *("--max-num-iterations", str(iterations), "--steps-per-save", str(iterations // 2)),
            *("--save-only-latest-checkpoint", "False", *options),
            *("--steps-per-eval-image", "0", "--steps-per-eval-all-images", "0"),
            *("colmap", "--data", str(scene), "--colmap-path", "sparse/0"),
            *("--downscale-factor", "1"),  # splatfacto itself starts at a quarter
        ]

    def checkpoint(self, out: Path, iterations: int) -> Path:
        """The file that a run leaves behind."""
        name = f"step-{iterations // 2:09d}.ckpt"
        return next(out.glob(f"run/*/one/nerfstudio_models/{name}"), out / name)

    def going_on(self, checkpoint: Path) -> list[str]:
        """The options to go on from a checkpoint; after `--load-step` ns-eval would look for it."""
        return ["--load-checkpoint", str(checkpoint)]

    def start(
        self,
        trainers: Path,
        scene: Path,
        work: Path,
        out: str,
        *more: str,
        ours: bool,
        iterations: int = ITERATIONS,
    ) -> Done:
        """Train and evaluate, stock or ours."""
        scripts = trainers / self.trainer / "nerfstudio" / "scripts"
        method, *rest = self.command(scene, work / out, iterations, ours=ours)
        here = work / out / "cwd"
        trained = run(scripts / "train.py", [method, *more, *rest], here, trusted=True)
        if trained.code != 0:
            return trained
        (config,) = (work / out).glob("run/*/one/config.yml")  # splatfacto-mcmc's is in splatfacto
        result = here / "psnr.json"
        options = ["--load-config", str(config), "--output-path", str(result)]
        done = run(scripts / "eval.py", options, here, trusted=True)
        psnr = json.loads(result.read_text())["results"]["psnr"] if done.code == 0 else None
        output = f"{trained.output}\n{done.output}\nPSNR: {psnr}"
        return Done(done.code, output, trained.seconds + done.seconds)


class Lightning(Trial):
    """gaussian-splatting-lightning's `main.py fit`: nothing is edited, a configuration is added."""

    lines = "none needed"

    def command(self, scene: Path, out: Path, iterations: int, *, ours: bool) -> list[str]:
        """The script's arguments."""
        folder = out.parent / "configurations"
        folder.mkdir(parents=True, exist_ok=True)
        save, plugin = folder / "save.yaml", folder / "opt3dgs.yaml"
        save.write_text(f"save_iterations:\n  - {iterations // 2}\n")
        plugin.write_text(LIGHTNING_PLUGIN)
        parser = ("--data.parser", "Colmap", "--data.parser.split_mode", "experiment")
        size = ("--data.parser.image_dir", "images_jpg", "--data.parser.down_sample_factor", "4")
        return [
            *("fit", "--data.path", str(scene), *parser, *size, "--config", str(save)),
            *(("--config", str(plugin)) if ours else ()),
            *("--max_steps", str(iterations), "--output", str(out), "-n", "run"),
            *("--trainer.accelerator", "cpu", "--trainer.num_sanity_val_steps", "0"),
            *self.options,
        ]

    def checkpoint(self, out: Path, iterations: int) -> Path:
        """The file that a run leaves behind; it is written before that iteration's step."""
        name = f"epoch=*-step={iterations // 2 - 1}.ckpt"
        return next(out.glob(f"run/checkpoints/{name}"), out / name)

    def going_on(self, checkpoint: Path) -> list[str]:
        """The options to go on from a checkpoint."""
        return ["--ckpt_path", str(checkpoint)]

    def find_script(self, trainers: Path, work: Path, *, ours: bool) -> Path:
        """The trainer's own, which takes our plugin as an option."""
        return super().find_script(trainers, work, ours=False)


class CityGaussian(Lightning):
    """CityGaussian's `main.py fit`: a copy of its module has the lines of the page."""

    lines = "4, by hand"
    module = "internal/gaussian_splatting.py"
    # Where each of the page's lines goes: below the line that begins so.
    places = (
        "from typing import",
        "self.gaussian_optimizers = gaussian_optimizers",
        'self.manual_backward(metrics["loss"]',
    )

    def command(self, scene: Path, out: Path, iterations: int, *, ours: bool) -> list[str]:
        """The script's arguments: without the plugin, which it could not take."""
        return super().command(scene, out, iterations, ours=False)

    def find_script(self, trainers: Path, work: Path, *, ours: bool) -> Path:
        """As every trial's that is edited."""
        return Trial.find_script(self, trainers, work, ours=ours)

    def edit(self, folder: Path) -> None:
        """Put the lines that docs/hosts/lightning.md prints where it says."""
        for place, lines in zip(self.places, lines_of_the_page("lightning"), strict=True):
            insert_below(folder / self.module, place, lines)


def lines_of_the_page(name: str, first: str = "# with the imports") -> list[str]:
    """The lines that a page of docs/hosts prints: those below each comment of a block.

    `first` is what the block's first comment begins with.
    """
    text = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    (block,) = re.findall(rf"```python\n({re.escape(first)}.*?)```", text, re.S)
    return [lines.strip() for lines in re.split(r"^# .*\n", block, flags=re.M)[1:]]


def lines_that_resume_gsplat() -> list[str]:
    """Those of gsplat's page that save a training, and those that go on from it."""
    return lines_of_the_page("gsplat", "# at the end of an iteration")


def insert_below(script: Path, beginning: str, lines: str) -> None:
    """Insert lines below the only one that begins so, with its indentation.

    Raises:
        ValueError: there is no such line, or more than one.
    """
    text = script.read_text(encoding="utf-8").splitlines()
    found = [at for at, line in enumerate(text) if line.strip().startswith(beginning)]
    if len(found) != 1:
        raise ValueError(f"{script}: {len(found)} lines begin with {beginning!r}, not one")
    spaces = text[found[0]][: -len(text[found[0]].lstrip())]
    text[found[0] + 1 : found[0] + 1] = textwrap.indent(lines, spaces).splitlines()
    script.write_text("\n".join([*text, ""]), encoding="utf-8")


def give_to_scheduler(script: Path, arguments: str) -> None:
    """Give arguments to the PhaseScheduler of an edited script, and import what they name.

    Raises:
        ValueError: it does not have exactly one.
    """
    text = script.read_text(encoding="utf-8")
    names = ", ".join(sorted({*re.findall(r"\b[A-Z]\w+", arguments), "PhaseScheduler"}))
    text = text.replace("opt3dgs_optim import PhaseScheduler", f"opt3dgs_optim import {names}")
    text, number = re.subn(r"(= PhaseScheduler\([^,)]+)", rf"\1, {arguments}", text)
    if number != 1:
        raise ValueError(f"{script}: {number} calls of PhaseScheduler, not one")
    script.write_text(text, encoding="utf-8")


def _gsplat(version: str, *options: str, **said: str) -> Trial:
    video = () if version == "gsplat-1.4.0" else NO_VIDEO
    return Trial(version, GSPLAT, (*options[:1], *SHORT_GSPLAT, *video, *options[1:]), **said)


def _inria(trainer: str, *options: str, different: str = "", script: str = "train.py") -> Trial:
    return Trial(trainer, script, (*INRIA_OPTIONS, *options), different=different)


def _splatfacto(method: str) -> Trial:
    different = "a method, no edit; a resume steps and saves (stock's own stops with a KeyError)"
    options = (method, *SHORT_SPLATFACTO)
    return Nerfstudio("nerfstudio", "nerfstudio/scripts/train.py", options, different=different)


_MINI = "--densify_until_iter 40 --simp_iteration1 40 --simp_iteration2 70 --imp_metric indoor"
# taming cannot clone none or split none: a budget for few refinements, and points of both kinds.
_TAMING = "--mode final_count --budget 6000 --cams 2 --densify_until_iter 60 --percent_dense 0.03"
_TAMING += " --opacity_reset_interval=1000"  # afterwards no gradient is large enough to split
_OWN_STEP = "steps keep its own arithmetic, without bias correction"
_NO_FUSED = "unexpected keyword argument 'fused'"
TRIALS = (
    _gsplat("gsplat-1.4.0", "mcmc"),
    # It resets the opacities in its first iteration, to twice this: to what they begin with.
    _gsplat("gsplat-1.4.0", "default", "--packed", "--strategy.prune_opa", "0.05"),
    _gsplat("gsplat-1.5.3", "mcmc"),
    _gsplat("gsplat-1.5.3", "default"),
    _gsplat("gsplat-1.5.3", "default", "--visible_adam", different=f"SelectiveAdam: {_OWN_STEP}"),
    _gsplat("gsplat-1.5.3", "default", "--packed"),
    _gsplat(
        *("gsplat-1.5.3", "default", "--packed", "--sparse_grad"),
        refused="SparseAdam",
        different="refused: torch's SparseAdam is no Adam",
    ),
    _gsplat("gsplat-1.5.3", "mcmc", "--app_opt", different="its networks stay plain"),
    _gsplat("gsplat-1.5.3", "mcmc", "--pose_opt", different="the poses stay plain"),
    _gsplat("gsplat-1.5.3", "mcmc", "--use_bilateral_grid", different="the grids stay plain"),
    _gsplat("gsplat-1.5.3", "mcmc", "--batch_size", "2"),
    _gsplat("gsplat-main", "mcmc"),
    _gsplat("gsplat-main", "default"),
    _gsplat(
        *("gsplat-main", "default", "--post_processing", "ppisp"),
        *("--ppisp_controller_activation_num_steps", "80"),
        different="a stand-in for ppisp, which freezes the Gaussians",
    ),
    _gsplat(
        *("gsplat-main", "default", "--visible_adam"),
        stock_fails=_NO_FUSED,
        different="none: the stock trainer stops too",
    ),
    _inria("gaussian-splatting", "--disable_viewer", different="exposures stay plain"),
    _inria(
        *("gaussian-splatting", "--disable_viewer", "--optimizer_type", "sparse_adam"),
        different=f"SparseGaussianAdam: {_OWN_STEP}",
    ),
    _inria("3dgs-mcmc", "--cap_max", "2500", "--init_type", "sfm"),
    _inria("taming-3dgs", *_TAMING.split(), different="its second optimizer is upgraded too"),
    _inria(
        *("mini-splatting", *_MINI.split()),
        script="ms/train.py",
        different="upgraded again where the loop sets up anew; prints no PSNR",
    ),
    _splatfacto("splatfacto"),
    _splatfacto("splatfacto-mcmc"),
    Lightning(
        *("gaussian-splatting-lightning", "main.py", ()),
        different="a plugin, no edit; its own density control, `VanillaDensityController`",
    ),
    CityGaussian(
        *("CityGaussian", "main.py", ()),
        different="edited by hand, as its page says",
    ),
)


@dataclass(frozen=True)
class Done:
    """A finished run."""

    code: int
    output: str
    seconds: float

    @property
    def psnr(self) -> float | None:
        """That of the test views, which the trainer printed last, dB."""
        said = r"(?:Evaluating test: .*?PSNR |PSNR: |val/psnr=)([\d.]+)"
        found = re.findall(said, self.output)
        return float(found[-1]) if found else None

    @property
    def reason(self) -> str:
        """The last line that is no progress bar."""
        lines = [line.strip() for line in re.split(r"[\r\n]", self.output)]
        errors = [line for line in lines if re.match(r"[\w.]*(Error|Exit|Exception): ", line)]
        return (errors or [line for line in lines if line] or ["no output"])[-1]


@dataclass(frozen=True)
class Outcome:
    """What one trial came to."""

    stock: Done
    ours: Done
    checkpoint: Path | None = None  # that ours left behind, where it did
    own: Done | None = None  # ours, gone on from it; None where the trainer does not go on
    theirs: Done | None = None  # ours, gone on from the stock run's


def try_out(trial: Trial, trainers: Path, scene: Path, work: Path) -> Outcome:
    """Stock, edited, and going on from both checkpoints, below the folder `work`."""
    stock = trial.start(trainers, scene, work, "stock", ours=False)
    ours = trial.start(trainers, scene, work, "ours", ours=True)
    own = trial.checkpoint(work / "ours", ITERATIONS)
    if not own.is_file():
        return Outcome(stock, ours)
    if trial.gsplat:  # evaluates a checkpoint, and does not go on from one
        return Outcome(stock, ours, own)
    theirs = trial.checkpoint(work / "stock", ITERATIONS)
    again = [
        trial.start(trainers, scene, work, out, *trial.going_on(file), ours=True)
        for out, file in (("own", own), ("theirs", theirs))
    ]
    return Outcome(stock, ours, own, *again)


def commit_of(folder: Path) -> str:
    """The short commit and its date, of git or of a file `.commit` in the folder."""
    if (folder / ".commit").is_file():
        words = (folder / ".commit").read_text().split()
        return f"{words[0][:7]} ({words[-1]})"
    command = ["git", "-C", str(folder), "log", "-1", "--format=%H %cs"]
    words = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    return f"{words[0][:7]} ({words[1]})" if words else "unknown"


def parts_of(output: str) -> str:
    """The parts that an edited run says it has, without those it switched off; or "-"."""
    said, off = SAYS_PARTS.search(output), SAYS_OFF.findall(output)
    return ", ".join(name for name in PART.findall(said[1]) if name not in off) if said else "-"


def copy_scene(source: Path, target: Path) -> Path:
    """A scene as these trainers read it: photos as .png and as .jpg, a part of the points."""
    for folder in ("images", "sparse"):
        shutil.copytree(source / folder, target / folder)
    shutil.copytree(source / "images_4", target / "images_jpg")
    (target / "images_4").mkdir()
    for photo in (source / "images_4").iterdir():
        with Image.open(photo) as image:
            image.save(target / "images_4" / f"{photo.stem}.png")
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


def edited_copy(trial: Trial, trainers: Path, target: Path) -> Path:
    """The trainer's Python files with our lines in the script; returns the script."""
    if not target.is_dir():
        plain = shutil.ignore_patterns(".git", "*.png", "*.jpg", "*.gif", "*.mp4", "*.so")
        shutil.copytree(trainers / trial.trainer, target, ignore=plain)
        trial.edit(target)
    return target / trial.script


def run(script: Path, arguments: list[str], folder: Path, *, trusted: bool = False) -> Done:
    """Run a script on the CPU in `folder`, which some trainers write to.

    `trusted`: its checkpoint may hold more than tensors, as INRIA's do.
    """
    environment = dict(os.environ)
    if trusted:
        environment["TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD"] = "1"
    folder.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, str(ON_CPU), str(script), *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        timeout=LIMIT,
        check=False,
    )
    return Done(done.returncode, done.stdout, time.perf_counter() - start)
