"""The real scripts of real trainers, stock and with the lines, on a CPU.

`python -m pytest -m hosts tests/hosts` with OPT3DGS_TRAINERS: a folder with the sources of each
trainer (examples/hosts/README.md names them), and OPT3DGS_SCENE: a scene in COLMAP's layout with
photos in `images` and `images_4`. Some forty trainings of half a minute on a core.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from plyfile import PlyData
from trials import HALF, LENGTH, TRAINERS, TRIALS, Done, Trial, missing, num_saved, run

from opt3dgs_optim.hosts import diff
from opt3dgs_optim.hosts.trainers import TRAINERS as TABLE

PLACES = {  # the folder of each trainer's sources; the others' is their name
    "gsplat": "gsplat-main", "gsplat-2dgs": "gsplat-main", "inria": "gaussian-splatting",
    "2dgs": "2d-gaussian-splatting", "mini-splatting-d": "mini-splatting",
    "grendel-gs": "Grendel-GS", "fvdb": "fvdb-0.6.0", "citygaussian": "CityGaussian",
}  # fmt: skip
OLDER = [("gsplat", "gsplat-1.5.3"), ("gsplat", "gsplat-1.4.0"), ("gsplat-2dgs", "gsplat-1.5.3"),
         ("gsplat-2dgs", "gsplat-1.4.0"), ("inria", "gaussian-splatting-2024-04")]  # fmt: skip
FORKS = ("mip-splatting", "gaussian-opacity-fields", "RaDe-GS", "PGSR", "DashGaussian",
         "AbsGS", "Pixel-GS", "StopThePop")  # fmt: skip
SCRIPTS = {"DashGaussian": "train_dash.py"}  # its train.py is INRIA's own
EACH = [(name, PLACES.get(name, name)) for name, each in TABLE.items() if each.signs]

pytestmark = pytest.mark.hosts


@pytest.mark.parametrize(("name", "folder"), [*EACH, *OLDER, *(("inria", each) for each in FORKS)])
def test_the_real_file_gets_its_lines(name: str, folder: str, tmp_path: Path) -> None:
    """And no linter finds a name in it that is not defined."""
    path = TRAINERS / folder / SCRIPTS.get(folder, TABLE[name].title.rpartition(": ")[2])
    if not path.is_file():
        pytest.skip(f"no {path}: put its sources there, set OPT3DGS_TRAINERS")
    found, new = diff.edited(path.read_bytes().decode())
    assert found is TABLE[name]
    (tmp_path / "new.py").write_text(new, encoding="utf-8")
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F821"]
    said = subprocess.run([*command, str(tmp_path)], capture_output=True, text=True, check=False)
    assert not [word for word in ("phases", "Scheduler") if word in said.stdout]


@pytest.mark.parametrize("trial", TRIALS, ids=lambda trial: trial.name)
def test_trains_saves_the_mean_and_resumes(trial: Trial, scene: Path, tmp_path: Path) -> None:
    """Both evaluate; the lines' run ends at the mean, and goes on from its own checkpoint."""
    if (why := missing(trial)) is not None:
        pytest.skip(why)
    stock = trial.train(scene, tmp_path, "stock", ours=False)
    ours = trial.train(scene, tmp_path, "ours", ours=True)
    for done in (stock, ours):
        assert done.code == 0, done.output[-3000:]
    steps = LENGTH if trial.gsplat else LENGTH - 1
    assert f"opt3dgs_optim: {steps} iterations" in ours.output
    assert "no mean" not in ours.output  # said of a training that ends before its end
    for done in (stock, ours):  # an empty scene has a PSNR, too
        assert num_saved(done.saved()) > 1000
    assert stock.psnr is not None
    assert ours.psnr is not None
    assert ours.psnr > stock.psnr - trial.worse
    ends_at_the_mean(trial, ours, ours.saved())
    if trial.gsplat:
        return
    resumed = trial.train(
        *(scene, tmp_path, "resumed", "--start_checkpoint", str(ours.out / f"chkpnt{HALF}.pth")),
        ours=True,
    )
    assert resumed.code == 0, resumed.output[-3000:]
    assert resumed.saved().read_bytes() == ours.saved().read_bytes()


def test_ends_early_with_finish(scene: Path, tmp_path: Path) -> None:
    """The mean of two iterates is saved where `finish()` is called; no line at exit."""
    trial = next(each for each in TRIALS if each.trainer == "3dgs-mcmc")
    if (why := missing(trial)) is not None:
        pytest.skip(why)
    end = LENGTH - 1  # the iteration before the last, which the trainer counts from 1
    done = trial.train(scene, tmp_path, "early", ours=True, end=end)
    assert done.code == 0, done.output[-3000:]
    assert "no mean" not in done.output
    is_the_mean(done, done.out / f"point_cloud/iteration_{end}/point_cloud.ply")


@pytest.mark.parametrize("name", ["gsplat-1.5.3 mcmc", "3dgs-mcmc --cap_max", "gaussian-splatting"])
def test_ends_without_a_plan(name: str, scene: Path, tmp_path: Path) -> None:
    """The trainer saves and evaluates where the mean is, and stops; resumed in its fall, too."""
    trial = next(each for each in TRIALS if each.name.startswith(name))
    if (why := missing(trial)) is not None:
        pytest.skip(why)
    enough = 56  # the end of an epoch, as HALF
    last = enough + enough // 5
    more = [] if trial.gsplat else ["--checkpoint_iterations", str(enough)]
    done = trial.train(scene, tmp_path, "open", *more, ours=True, enough=enough)
    assert done.code == 0, done.output[-3000:]
    assert "opt3dgs_optim: no planned end" in done.output
    assert "no mean" not in done.output
    assert done.psnr is not None
    saved = f"point_cloud/iteration_{last}/point_cloud.ply"
    if trial.gsplat:
        saved = f"ckpts/ckpt_{last - 1}_rank0.pt"
    ends_at_the_mean(trial, done, done.out / saved)
    if trial.gsplat:
        return
    more = ["--start_checkpoint", str(done.out / f"chkpnt{enough}.pth")]
    resumed = trial.train(scene, tmp_path, "resumed", *more, ours=True, enough=enough)
    assert resumed.code == 0, resumed.output[-3000:]
    assert (resumed.out / saved).read_bytes() == (done.out / saved).read_bytes()


@pytest.mark.parametrize(
    ("folder", "method"),
    [("nerfstudio", "splatfacto"), ("nerfstudio", "splatfacto-mcmc"),
     ("nerfstudio-1.1.5", "splatfacto")],
)  # fmt: skip
def test_nerfstudio_trains_and_saves_the_mean(
    folder: str, method: str, scene: Path, tmp_path: Path
) -> None:
    """`ns-train` itself finds the method by its entry point, without a warning of it."""
    sources = TRAINERS / folder / "nerfstudio"
    if not sources.is_dir():
        pytest.skip(f"no {sources}: put its sources there, set OPT3DGS_TRAINERS")
    needs = "nerfacc pytorch_msssim tyro appdirs pathos fpsample mediapy rawpy torchmetrics"
    lacking = [name for name in needs.split() if not importlib.util.find_spec(name)]
    if lacking or not entry_points(group="nerfstudio.method_configs"):
        pytest.skip(f"install opt3dgs_optim beside what nerfstudio needs, as {lacking}")
    end = str(LENGTH)
    command = [
        *(f"{method}-opt3dgs", "--vis", "tensorboard", "--output-dir", str(tmp_path / "out")),
        *("--experiment-name", "run", "--timestamp", "one", "--max-num-iterations", end),
        *("--pipeline.model.warmup-length", "10", "--pipeline.model.refine-every", "10"),
        *("--steps-per-eval-image", "0", "--steps-per-eval-all-images", "0"),
        *("colmap", "--data", str(scene), "--colmap-path", "sparse/0", "--downscale-factor", "1"),
    ]
    done = run(sources / "scripts" / "train.py", command, tmp_path / "out")
    assert done.code == 0, done.output[-3000:]
    assert f"opt3dgs_optim: {LENGTH} iterations" in done.output
    assert "Could entry point" not in done.output
    assert "no mean" not in done.output
    (path,) = done.out.glob(f"run/*/one/nerfstudio_models/step-*{LENGTH - 1}.ckpt")
    saved = torch.load(path, weights_only=False)["pipeline"]
    ends = torch.load(done.out / "end.pt")
    for name, other in {"scales": "scales", "opacities": "opacities", "sh0": "features_dc"}.items():
        assert torch.equal(ends[name][0], ends[name][1]), name
        assert torch.equal(saved[f"_model.gauss_params.{other}"], ends[name][1]), name


def ends_at_the_mean(trial: Trial, done: Done, path: Path) -> None:
    """The parameters are the mean at the end, and what is saved is a mean, too."""
    if not trial.gsplat:
        is_the_mean(done, path, noise=trial.trainer == "3dgs-mcmc")
        return
    ends = torch.load(done.out / "end.pt")
    saved: Any = torch.load(path, weights_only=False)["splats"]
    for name, (param, mean) in ends.items():
        if name == "means" and "mcmc" in trial.options:
            continue  # its noise comes after the last step
        assert torch.equal(param, mean), name
        assert saved[name].shape == mean.shape  # gsplat saves before its last step


def is_the_mean(done: Done, path: Path, *, noise: bool = False) -> None:
    """INRIA's .ply has the means; of the positions what the trainer's `noise` has made of them."""
    ends, vertices = torch.load(done.out / "end.pt"), PlyData.read(str(path))["vertex"]
    names = {"means": "x y z", "opacities": "opacity", "quats": "rot_0 rot_1 rot_2 rot_3"}
    for name, columns in names.items():
        saved = np.stack([vertices[column] for column in columns.split()], 1)
        param, mean = ends[name]
        assert mean is not None, name
        expected = param if noise and name == "means" else mean
        assert np.array_equal(saved, expected.numpy().reshape(saved.shape)), name
