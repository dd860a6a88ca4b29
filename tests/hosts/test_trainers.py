"""The real scripts of real trainers, stock and edited, on a CPU through `on_cpu.py`.

`python -m pytest -m hosts tests/hosts` with OPT3DGS_TRAINERS: a folder with one subfolder for each
trainer (names in `examples/hosts/trials.py`), and OPT3DGS_SCENE: a scene in COLMAP's layout, with
photos in `images` and `images_4`.
"""

from __future__ import annotations

import importlib.util
import math
import os
from pathlib import Path

import pytest
from hosts.trials import ITERATIONS, TRIALS, Done, Trial, copy_scene, edited_copy, run

TRAINERS = Path(os.environ.get("OPT3DGS_TRAINERS", "/no/trainers"))
BESIDE = Path(__file__).resolve().parents[3] / "shared" / "scenes" / "banana"
SCENE = Path(os.environ.get("OPT3DGS_SCENE", BESIDE))
NEEDED = ("torchmetrics", "tyro", "cv2", "sklearn", "yaml", "imageio")
OURS = 1.5  # dB that an edited run of 100 iterations may be worse than the stock one

pytestmark = pytest.mark.hosts


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not (SCENE / "images_4").is_dir():
        pytest.skip(f"no scene at {SCENE}: set OPT3DGS_SCENE")
    return copy_scene(SCENE, tmp_path_factory.mktemp("scene") / "small")


@pytest.fixture(scope="session")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("trainers")


def of_trials(trials: tuple[Trial, ...]) -> list:
    return [pytest.param(trial, id=trial.name) for trial in trials]


def need(trial: Trial) -> None:
    if not (TRAINERS / trial.trainer / trial.script).is_file():
        pytest.skip(f"no {TRAINERS / trial.trainer}: put its sources there, set OPT3DGS_TRAINERS")
    missing = [name for name in NEEDED if trial.gsplat and not importlib.util.find_spec(name)]
    if missing:
        pytest.skip(f"gsplat's examples need {', '.join(missing)}: pip install them")


def train(trial: Trial, script: Path, scene: Path, out: Path, *more: str) -> Done:
    command = trial.command(scene, out, ITERATIONS)
    return run(script, [*command, *more], out / "cwd", trusted=True)


@pytest.mark.parametrize("trial", of_trials(TRIALS))
def test_stock_and_edited(trial: Trial, scene: Path, work: Path, tmp_path: Path) -> None:
    """Both evaluate and save; the edited one says that it is active and is no worse."""
    need(trial)
    stock = train(trial, TRAINERS / trial.trainer / trial.script, scene, tmp_path / "stock")
    if trial.stock_fails is not None:
        assert stock.code != 0
        assert trial.stock_fails in stock.output
        return
    assert stock.code == 0, stock.output[-3000:]
    script = edited_copy(trial, TRAINERS, work / trial.trainer)
    ours = train(trial, script, scene, tmp_path / "ours")
    if trial.refused is not None:
        assert ours.code != 0
        assert trial.refused in ours.reason
        return
    assert ours.code == 0, ours.output[-3000:]
    assert stock.psnr is not None
    assert ours.psnr is not None
    assert math.isfinite(ours.psnr)
    assert ours.psnr > stock.psnr - OURS
    assert trial.checkpoint(tmp_path / "ours", ITERATIONS).is_file()


RESUMING = tuple(
    trial
    for trial in TRIALS
    if trial.trainer in ("gaussian-splatting", "3dgs-mcmc") and "sparse_adam" not in trial.options
)


@pytest.mark.parametrize("first", ["stock", "edited"])
@pytest.mark.parametrize("trial", of_trials(RESUMING))
def test_resume(trial: Trial, first: str, scene: Path, work: Path, tmp_path: Path) -> None:
    """The edited trainer goes on from its own checkpoint, and from the stock trainer's."""
    need(trial)
    edited = edited_copy(trial, TRAINERS, work / trial.trainer)
    stock = TRAINERS / trial.trainer / trial.script
    begun = train(trial, stock if first == "stock" else edited, scene, tmp_path / "first")
    assert begun.code == 0, begun.output[-3000:]
    more = trial.going_on(trial.checkpoint(tmp_path / "first", ITERATIONS))
    done = train(trial, edited, scene, tmp_path / "second", *more)
    assert done.code == 0, done.output[-3000:]
    assert begun.psnr is not None
    assert done.psnr is not None
    assert done.psnr > begun.psnr - OURS


def test_a_sign_of_life(scene: Path, work: Path, tmp_path: Path) -> None:
    trial = next(t for t in TRIALS if t.trainer == "3dgs-mcmc")
    need(trial)
    script = edited_copy(trial, TRAINERS, work / trial.trainer)
    done = run(script, trial.command(scene, tmp_path / "out", 10), tmp_path / "cwd")
    lines = [line.lower() for line in done.output.splitlines() if "opt3dgs" in line.lower()]
    assert any("annealing" in line and "10" in line for line in lines)
