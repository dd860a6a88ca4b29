"""The real scripts of real trainers, stock and edited, on a CPU through `on_cpu.py`.

`python -m pytest -m hosts tests/hosts` with OPT3DGS_TRAINERS: a folder with one subfolder for each
trainer (names in `examples/hosts/trials.py`), and OPT3DGS_SCENE: a scene in COLMAP's layout, with
photos in `images` and `images_4`. Some sixty trainings, each 20 to 40 seconds of a core to itself.
With OPT3DGS_RECORD what came of them goes into docs/hosts/survey.json (use `-n 1` then).
nerfstudio reads images with a Pillow below 13 (11.3 works). gaussian-splatting-lightning and
CityGaussian need `"lightning<2.4" "jsonargparse[signatures]<4.30" "setuptools<80"`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hosts.survey import keep, scripts_of
from hosts.trials import ITERATIONS, TRIALS, Trial, edited_copy, run, try_out
from real_trainers import OURS, TRAINERS, need, no_worse

from opt3dgs_optim.hosts import diff

GAUSSIANS = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
# dB that one which takes a stock run over at half may be worse: opacities that annealing slows do
# not recover from a reset.
TAKEN_OVER = 2.5

pytestmark = pytest.mark.hosts


@pytest.mark.parametrize("trial", [pytest.param(trial, id=trial.name) for trial in TRIALS])
def test_stock_edited_and_resumed(trial: Trial, scene: Path, tmp_path: Path) -> None:
    """Both evaluate and save; the edited one says that it is active, is no worse, and goes on."""
    need(trial)
    got = try_out(trial, TRAINERS, scene, tmp_path)
    if "OPT3DGS_RECORD" in os.environ:
        keep(trial, TRAINERS, scene.name, got)
    if trial.stock_fails is not None:
        assert got.stock.code != 0
        assert trial.stock_fails in got.stock.output
        return
    assert got.stock.code == 0, got.stock.output[-3000:]
    if trial.refused is not None:
        assert got.ours.code != 0
        assert trial.refused in got.ours.reason
        return
    assert got.ours.code == 0, got.ours.output[-3000:]
    assert f"total_steps={ITERATIONS}," in got.ours.output  # the sign of life
    assert got.checkpoint is not None
    no_worse(got.ours, got.stock, OURS)
    if trial.gsplat:
        return
    again = (got.own, got.ours, OURS), (got.theirs, got.stock, TAKEN_OVER)
    for done, begun, allowed in again:
        assert done is not None
        assert done.code == 0, done.output[-3000:]
        no_worse(done, begun, allowed)
    if trial.trainer == "nerfstudio":  # whose own optimizers never step again after a resume
        for out in ("own", "theirs"):
            (last,) = (tmp_path / out).glob(f"run/*/one/*/step-{ITERATIONS - 1:09d}.ckpt")
            saved = torch.load(last, weights_only=False)["optimizers"]
            steps = {float(saved[name]["state"][0]["step"]) for name in GAUSSIANS}
            assert steps == {ITERATIONS}


def test_edited_scripts_use_no_unknown_name(tmp_path: Path) -> None:
    """ruff, which knows nothing of ours, finds no undefined name that the stock script had not."""
    if not TRAINERS.is_dir():
        pytest.skip("no trainers: set OPT3DGS_TRAINERS")
    found: list[Path] = []
    for folder in sorted(path for path in TRAINERS.iterdir() if path.is_dir()):
        for path in scripts_of(folder):
            try:
                new = diff(path).new
            except ValueError:
                continue
            found.append(path)
            (tmp_path / f"{len(found)}_old.py").write_bytes(path.read_bytes())
            (tmp_path / f"{len(found)}_new.py").write_bytes(new)
    assert found
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F82"]
    command += ["--output-format", "json", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = [(Path(e["filename"]).stem, e["message"]) for e in json.loads(done.stdout)]
    old = sorted((name[:-4], message) for name, message in said if name.endswith("_old"))
    new_ones = sorted((name[:-4], message) for name, message in said if name.endswith("_new"))
    assert old == new_ones


def test_a_sign_of_life(scene: Path, tmp_path: Path) -> None:
    trial = next(t for t in TRIALS if t.trainer == "3dgs-mcmc")
    need(trial)
    script = edited_copy(trial, TRAINERS, tmp_path / "edited")
    command = trial.command(scene, tmp_path / "out", 10, ours=True)
    done = run(script, command, tmp_path / "cwd")
    lines = [line.lower() for line in done.output.splitlines() if "opt3dgs" in line.lower()]
    assert any("fading" in line and "10" in line for line in lines)
