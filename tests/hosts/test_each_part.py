"""Each part alone in the real scripts of gsplat and 3dgs-mcmc: it ends, saves and resumes.

`python -m pytest -m hosts tests/hosts` with OPT3DGS_TRAINERS and OPT3DGS_SCENE, as for
`test_trainers.py`. Two trainings of some dozen iterations for each part and trainer.
"""

from __future__ import annotations

import inspect
import re
import shutil
import textwrap
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hosts.trials import (
    GSPLAT,
    INRIA_OPTIONS,
    NO_VIDEO,
    SHORT_GSPLAT,
    Trial,
    lines_that_resume_gsplat,
)
from real_trainers import OURS, TRAINERS, need, no_worse
from torch import Tensor

import opt3dgs_optim
from opt3dgs_optim import Part

SHORT = 30  # iterations
LONG = 90  # of `Averaging`, which acts in a thirtieth of the run, from its second iterate on
PARTS = {
    "Annealing": "Annealing()",
    "Averaging": "Averaging()",
    "ConstantMultiplier": "ConstantMultiplier(1.5)",
    "Curvature": "Curvature()",
    "EnergyHistogram": "EnergyHistogram(warmup=4)",
    "Fading": "Fading()",
    "FreshMoments": "FreshMoments()",
    "IsotropicNoise": "IsotropicNoise(temperature=1e-6)",
    "OutOfView": "OutOfView()",
    "OwnFrame": "OwnFrame()",
    "PositionNoise": "PositionNoise()",
    "SquaredLoss": "SquaredLoss()",
}

pytestmark = pytest.mark.hosts


class Gsplat(Trial):
    """gsplat's script with the lines of its page that save a training, and go on from it."""

    trusted = False  # as a user has it

    def edit(self, folder: Path) -> None:
        """Put the lines of `diff` into the copy, then those of the page where it says."""
        super().edit(folder)
        script = folder / self.script
        text = script.read_text(encoding="utf-8")
        save, resume = lines_that_resume_gsplat()
        made = re.search(r"^ +phases = .*\n +self\.optimizers = phases\.upgrade.*\n", text, re.M)
        assert made is not None
        text = text.replace(made[0], "")
        resume = resume.replace("PATH", 'f"{cfg.result_dir}/begun.pt"')
        save = save.replace("PATH", 'f"{cfg.result_dir}/whole_{step + 1}.pt"')
        rarely = "if (step + 1) % 5_000 == 0:"
        assert rarely in save
        save = save.replace(rarely, "if step + 1 in (max_steps // 2, max_steps):")
        start, end = "        init_step = 0\n", "            # eval the full set\n"
        assert text.count(start) == text.count(end) == 1
        text = text.replace(start, made[0] + textwrap.indent(resume, " " * 8) + "\n")
        text = text.replace(end, textwrap.indent(save, " " * 12) + f"\n\n{end}")
        script.write_text(text, encoding="utf-8")

    def saved(self, out: Path, iteration: int) -> Path:
        """What a run leaves behind after so many iterations."""
        return out / f"whole_{iteration}.pt"

    def go_on(self, file: Path, out: Path) -> list[str]:
        """Have a run in `out` go on from a file; the options for it."""
        out.mkdir()
        shutil.copy(file, out / "begun.pt")
        return []

    def read(self, file: Path) -> tuple[list[Tensor], dict[str, Any]]:
        """The Gaussians, and the state of the phases."""
        splats, state, _ = torch.load(file, weights_only=False)
        return list(splats.values()), state["means"]["param_groups"][0]["opt3dgs"]

    def read_stock(self, out: Path, iterations: int) -> list[Tensor]:
        """The Gaussians that the script itself saves."""
        return list(torch.load(self.checkpoint(out, iterations))["splats"].values())


class Mcmc(Trial):
    """3dgs-mcmc's, whose checkpoints hold everything."""

    def command(self, scene: Path, out: Path, iterations: int, *, ours: bool) -> list[str]:
        """The script's arguments, with a checkpoint at the end, too."""
        when = ("--checkpoint_iterations", str(iterations // 2), str(iterations))
        return [*super().command(scene, out, iterations, ours=ours), *when]

    def saved(self, out: Path, iteration: int) -> Path:
        """What a run leaves behind after so many iterations."""
        return out / f"chkpnt{iteration}.pth"

    def go_on(self, file: Path, out: Path) -> list[str]:
        """The options that have a run go on from a file."""
        return self.going_on(file)

    def read(self, file: Path) -> tuple[list[Tensor], dict[str, Any]]:
        """The Gaussians, and the state of the phases."""
        values, _ = torch.load(file, weights_only=False)
        gaussians: list[Tensor] = [v for v in values if isinstance(v, torch.nn.Parameter)]
        (optimizer,) = [value for value in values if isinstance(value, dict)]
        return gaussians, optimizer["param_groups"][0].get("opt3dgs", {})

    def read_stock(self, out: Path, iterations: int) -> list[Tensor]:
        """The Gaussians that the script itself saves."""
        return self.read(self.saved(out, iterations))[0]


# Without noise of their own: with `PositionNoise` it would be made twice.
TRAINERS_WITH_A_TRIAL: dict[str, Gsplat | Mcmc] = {
    "gsplat": Gsplat(
        *("gsplat-1.5.3", GSPLAT),
        ("mcmc", *SHORT_GSPLAT, *NO_VIDEO, "--strategy.noise_lr", "0"),
    ),
    "3dgs-mcmc": Mcmc(
        *("3dgs-mcmc", "train.py"),
        (
            *(*INRIA_OPTIONS, "--cap_max", "2500", "--init_type", "sfm", "--noise_lr", "0"),
            *("--opacity_lr", "0.3"),  # from 0.5, so that some fade enough to be moved by noise
        ),
    ),
}
WithoutParts = Callable[[str, int], Path]


def with_parts(trainer: str, parts: str) -> Gsplat | Mcmc:
    # Both phases have time to act in.
    trial = replace(TRAINERS_WITH_A_TRIAL[trainer], scheduler=f"switch=0.5, parts=[{parts}]")
    need(trial)
    return trial


@pytest.fixture(scope="module")
def without_parts(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> WithoutParts:
    """Train a trainer with a scheduler that has no parts, once; where it left its files."""
    folder = tmp_path_factory.mktemp("without")

    def find(trainer: str, iterations: int) -> Path:
        out = f"{trainer}-{iterations}"
        if not (folder / out).is_dir():
            trial = with_parts(trainer, "")
            done = trial.start(TRAINERS, scene, folder, out, ours=True, iterations=iterations)
            assert done.code == 0, done.output[-3000:]
        return folder / out

    return find


def test_every_public_part_is_tried() -> None:
    public = [getattr(opt3dgs_optim, name) for name in opt3dgs_optim.__all__]
    kinds = [kind for kind in public if inspect.isclass(kind) and issubclass(kind, Part)]
    assert {kind.__name__ for kind in kinds if kind is not Part} == {*PARTS}


@pytest.mark.parametrize("trainer", TRAINERS_WITH_A_TRIAL)
def test_without_parts_it_is_the_unchanged_trainer(
    trainer: str, scene: Path, without_parts: WithoutParts, tmp_path: Path
) -> None:
    """Bit for bit: what is another with a part is that part's doing."""
    trial = with_parts(trainer, "")
    stock = trial.start(TRAINERS, scene, tmp_path, "stock", ours=False, iterations=SHORT)
    assert stock.code == 0, stock.output[-3000:]
    theirs = trial.read_stock(tmp_path / "stock", SHORT)
    ours = trial.read_stock(without_parts(trainer, SHORT), SHORT)
    assert all(map(torch.equal, ours, theirs))
    assert len(ours) == len(theirs) == 6


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("trainer", TRAINERS_WITH_A_TRIAL)
def test_a_part_alone(
    trainer: str, part: str, scene: Path, without_parts: WithoutParts, tmp_path: Path
) -> None:
    trial, total = with_parts(trainer, PARTS[part]), LONG if part == "Averaging" else SHORT
    whole = trial.start(TRAINERS, scene, tmp_path, "whole", ours=True, iterations=total)
    assert whole.code == 0, whole.output[-3000:]
    assert f"parts {part}(" in whole.output  # the sign of life
    gaussians, phases = trial.read(trial.saved(tmp_path / "whole", total))
    assert phases["iteration"] == phases["num_observed"] == total
    assert all(bool(value.isfinite().all()) for value in gaussians)
    plain, _ = trial.read(trial.saved(without_parts(trainer, total), total))
    same = [a.shape == b.shape and torch.equal(a, b) for a, b in zip(gaussians, plain, strict=True)]
    # `OutOfView` looks, and changes nothing where a photo sees more than a third of the scene.
    assert all(same) == (part == "OutOfView")

    options = trial.go_on(trial.saved(tmp_path / "whole", total // 2), tmp_path / "resumed")
    done = trial.start(TRAINERS, scene, tmp_path, "resumed", *options, ours=True, iterations=total)
    assert done.code == 0, done.output[-3000:]
    assert not trial.saved(tmp_path / "resumed", total // 2).exists()  # it has not begun anew
    gaussians, phases = trial.read(trial.saved(tmp_path / "resumed", total))
    assert phases["iteration"] == phases["num_observed"] == total
    assert all(bool(value.isfinite().all()) for value in gaussians)
    no_worse(done, whole, OURS)
    for output in (whole.output, done.output):
        assert "Warning: PhaseScheduler" not in output
        assert f"Warning: {part}" not in output


class Freezing(Trial):
    """gsplat's script whose schedule ends where it freezes the Gaussians."""

    def edit(self, folder: Path) -> None:
        """Put the lines of `diff` into the copy, with the number that the page advises."""
        super().edit(folder)
        script = folder / self.script
        text, total = script.read_text(encoding="utf-8"), "PhaseScheduler(max_steps"
        assert text.count(total) == 1
        advised = "PhaseScheduler(cfg.ppisp_controller_activation_num_steps"
        script.write_text(text.replace(total, advised), encoding="utf-8")


def test_a_schedule_that_ends_where_the_gaussians_are_frozen(scene: Path, tmp_path: Path) -> None:
    trial = Freezing(
        *("gsplat-main", GSPLAT),
        (
            *("default", *SHORT_GSPLAT, *NO_VIDEO, "--post_processing", "ppisp"),
            *("--ppisp_controller_activation_num_steps", "20"),
        ),
    )
    need(trial)
    done = trial.start(TRAINERS, scene, tmp_path, "out", ours=True, iterations=SHORT)
    assert done.code == 0, done.output[-3000:]
    assert "total_steps=20," in done.output
    assert "Gaussian parameters frozen" in done.output
    assert "Warning: PhaseScheduler" not in done.output
