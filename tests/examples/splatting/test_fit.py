"""The examples' trainer: arms, checkpoints, interruption."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from splatting.arms import ARMS, HISTOGRAM_ARM, find_arm, in_order
from splatting.embedded import embedded_scene
from splatting.fit import Fit, FitOptions, run
from splatting.scenes import Scene

from opt3dgs_optim import Phase, PhaseScheduler
from opt3dgs_optim.runs import read_run

CONSTANT_ARM = "constant"
EXAMPLES = Path(__file__).resolve().parents[3] / "examples"
OPTIONS = FitOptions(iterations=90, points=150, switch=2 / 3, evaluations=3)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The embedded scene with fewer views: an evaluation is most of a run this short."""
    whole = embedded_scene()
    return replace(whole, train=whole.train[:6], test=whole.test[:1])


def values(fit: Fit) -> list[torch.Tensor]:
    return [param.detach().clone() for param in fit.gaussians.values()]


@pytest.mark.parametrize("name", ARMS)
def test_every_arm_trains_and_resumes_bit_for_bit(scene: Scene, name: str, tmp_path: Path) -> None:
    """Interrupted in either phase, the run ends where it would have ended."""
    whole = Fit(scene, ARMS[name], OPTIONS, mean_nu=1.3)
    losses = [float(whole.step()) for _ in range(90)]
    assert np.mean(losses[50:60]) < np.mean(losses[:10])  # before the loss may turn to L2
    first = Fit(scene, ARMS[name], OPTIONS, mean_nu=1.3)
    for _ in range(47):
        first.step()
    first.save(tmp_path / "one.pt")
    second = Fit(scene, ARMS[name], OPTIONS, mean_nu=1.3)
    second.load(tmp_path / "one.pt")
    for _ in range(24):
        second.step()
    second.save(tmp_path / "two.pt")
    third = Fit(scene, ARMS[name], OPTIONS, mean_nu=1.3)
    third.load(tmp_path / "two.pt")
    while third.iteration < 90:
        third.step()
    assert all(torch.equal(a, b) for a, b in zip(values(whole), values(third), strict=True))


def test_without_parts_it_is_the_trainers_own_adam(scene: Scene) -> None:
    """Noise apart (another order within the step): the arms differ by what they name, no more."""
    plain = Fit(scene, ARMS["adam"], OPTIONS)
    ours = Fit(scene, ARMS["adam"], OPTIONS)
    ours.phases = PhaseScheduler(OPTIONS.iterations, parts=[])
    ours.phases.upgrade(ours.optimizers)
    for _ in range(90):
        plain.step()
        ours.step()
    assert all(torch.equal(a, b) for a, b in zip(values(plain), values(ours), strict=True))


def test_a_branch_starts_where_its_trunk_was(scene: Scene, tmp_path: Path) -> None:
    """Clock and phase are the trunk's, whether its checkpoint has a clock or is a stock one's."""
    for trunk in ("mcmc", "defaults"):
        whole, branch = (Fit(scene, ARMS[name], OPTIONS) for name in (trunk, "paper"))
        for _ in range(60):
            whole.step()
        whole.save(tmp_path / "at.pt")
        branch.load(tmp_path / "at.pt", trunk=trunk)
        assert branch.phase is Phase.EXPLOITATION
        branch.step()
        assert branch.phases is not None
        assert branch.phases.iteration == 61
        state = branch.optimizers["means"].state[branch.gaussians["means"]]
        assert float(state["step"]) == 1.0  # the moments started anew


def test_run_logs_what_the_report_needs(scene: Scene, tmp_path: Path) -> None:
    metrics = run(Fit(scene, ARMS["paper"], OPTIONS), tmp_path)
    log = read_run(tmp_path / "log.jsonl")
    assert log.evaluations["iteration"].tolist() == [0, 30, 60, 90]
    for name in ("psnr", "ssim", "train_psnr", "seconds", "num_points"):
        assert np.isfinite(log.evaluations[name]).all(), name
    assert log.evaluations["psnr"][-1] == pytest.approx(metrics["psnr"])
    assert log.steps["iteration"].tolist() == list(range(1, 91))
    assert set(log.steps["phase"][:60]) == {"exploration"}
    assert set(log.steps["phase"][60:]) == {"exploitation"}
    assert np.isfinite(log.steps["nu"][8:60]).all()
    assert np.isnan(log.steps["nu"][60:]).all()
    assert np.isfinite(log.steps["accepted"][61:]).all()
    assert log.events[-1]["event"] == "finished"
    assert run(Fit(scene, ARMS["paper"], OPTIONS), tmp_path)["psnr"] == metrics["psnr"]
    assert len(read_run(tmp_path / "log.jsonl").records) == len(log.records)  # not run again


def test_a_run_that_was_stopped_at_its_end_is_finished_by_the_next_start(
    scene: Scene, tmp_path: Path
) -> None:
    run(Fit(scene, ARMS["mcmc"], OPTIONS), tmp_path)
    path = tmp_path / "log.jsonl"
    *lines, last = path.read_text().splitlines(keepends=True)
    assert '"finished"' in last
    while '"evaluation"' in lines[-1]:  # stopped in the last one
        lines.pop()
    path.write_text("".join(lines))
    metrics = run(Fit(scene, ARMS["mcmc"], OPTIONS), tmp_path)
    log = read_run(path)
    assert log.events[-1]["event"] == "finished"
    assert log.evaluations["psnr"][-1] == pytest.approx(metrics["psnr"])
    assert log.evaluations["iteration"][-1] == OPTIONS.iterations
    before = path.read_bytes()
    run(Fit(scene, ARMS["mcmc"], OPTIONS), tmp_path)
    assert path.read_bytes() == before


@pytest.mark.processes
def test_ctrl_c_leaves_a_checkpoint_and_a_readable_log(tmp_path: Path) -> None:
    """A real signal to a real process; the second start ends like a run without it."""
    out = tmp_path / "cut"
    words = [sys.executable, str(EXAMPLES / "train.py"), "--iterations", "400", "--points", "150"]
    words += ["--arm", "paper", "--switch", "0.5"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [*words, "-o", str(out)], env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE
    )
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if (out / "log.jsonl").exists() and (out / "log.jsonl").read_bytes().count(b"\n") > 21:
            break
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    assert b"goes on from the checkpoints" in stderr
    stopped = read_run(out / "log.jsonl")
    assert stopped.events[-1]["event"] == "interrupted"
    at = stopped.events[-1]["iteration"]
    assert 19 <= at < 400
    subprocess.run([*words, "-o", str(out), "--quiet"], env=environment, check=True, timeout=120)
    resumed = read_run(out / "log.jsonl")
    assert resumed.steps["iteration"].tolist() == list(range(1, 401))
    subprocess.run(
        [*words, "-o", str(tmp_path / "whole"), "--quiet"],
        env=environment,
        check=True,
        timeout=120,
    )
    whole = read_run(tmp_path / "whole" / "log.jsonl")
    assert whole.steps["loss"].tolist() == resumed.steps["loss"].tolist()
    cut, uncut = ((f / "gaussians.ply").read_bytes() for f in (out, tmp_path / "whole"))
    assert cut == uncut


def test_random_initialisation_grows_to_the_budget(scene: Scene) -> None:
    options = replace(OPTIONS, init="random", iterations=300, points=200)
    fit = Fit(scene, ARMS["mcmc"], options)
    assert len(fit.gaussians["means"]) == 20
    losses = [float(fit.step()) for _ in range(300)]
    assert len(fit.gaussians["means"]) == 200
    assert np.mean(losses[-20:]) < 0.8 * np.mean(losses[:20])


def test_spherical_harmonics_are_trained(scene: Scene) -> None:
    options = replace(OPTIONS, sh_degree=2, sh_degree_interval=5)
    fit = Fit(scene, ARMS["paper"], options)
    assert fit.gaussians["shN"].shape[1:] == (8, 3)
    trained, degrees = [], []
    for _ in range(12):
        degrees.append(fit.active_sh_degree)
        fit.step()
        # Degree 1 is the first three coefficients, degree 2 the other five.
        shN = fit.gaussians["shN"].detach()
        trained.append((bool(shN[:, :3].any()), bool(shN[:, 3:].any())))
    assert degrees == [0] * 5 + [1] * 5 + [2] * 2
    assert trained == [(False, False)] * 5 + [(True, False)] * 5 + [(True, True)] * 2


def test_checkpoint_from_before_an_option_is_read(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    fit = Fit(scene, ARMS["adam"], OPTIONS)
    fit.step()
    fit.save(path)
    state = torch.load(path, weights_only=True)
    del state["options"]["sh_degree_interval"]
    torch.save(state, path)
    again = Fit(scene, ARMS["adam"], OPTIONS)
    again.load(path)
    assert again.iteration == 1


def test_checkpoint_of_another_run_is_refused(scene: Scene, tmp_path: Path) -> None:
    Fit(scene, ARMS["mcmc"], OPTIONS).save(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="choose another folder"):
        Fit(scene, ARMS["adam"], OPTIONS).load(tmp_path / "checkpoint.pt")


def test_control_runs_after_what_it_controls() -> None:
    assert [arm.name for arm in in_order([CONSTANT_ARM, "mcmc"])] == [
        HISTOGRAM_ARM,
        CONSTANT_ARM,
        "mcmc",
    ]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: find_arm("sgd"), "'sgd' is unknown; there are mcmc, rates-x3"),
        (lambda: FitOptions(iterations=0), "iterations=0"),
        (lambda: FitOptions(points=0), "points=0"),
        (lambda: FitOptions(sh_degree_interval=0), "sh_degree_interval=0"),
        (lambda: FitOptions(init="colmap"), "init='colmap'"),  # pyright: ignore[reportArgumentType]
        (lambda: FitOptions(switch=0.0), "switch=0.0"),
    ],
)
def test_bad_options(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_constant_arm_without_its_source_says_so(scene: Scene) -> None:
    with pytest.raises(ValueError, match="needs the mean nu"):
        Fit(scene, ARMS[CONSTANT_ARM], OPTIONS)


@pytest.mark.parametrize("content", [b"", b"no checkpoint", None])
def test_a_file_that_is_no_checkpoint_is_named(
    scene: Scene, tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "checkpoint.pt"
    if content is None:
        torch.save({"weights": torch.ones(2)}, path)
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"checkpoint\.pt: no checkpoint"):
        Fit(scene, ARMS["mcmc"], OPTIONS).load(path)


def test_a_checkpoint_of_other_photos_is_refused(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    Fit(scene, ARMS["mcmc"], OPTIONS).save(path)
    on_white = replace(scene, background=torch.ones(3))
    first = scene.train[0]
    smaller = replace(first, image=first.image[::2])
    for other in (on_white, replace(scene, train=[smaller, *scene.train[1:]])):
        with pytest.raises(ValueError, match="other sizes or on another background"):
            Fit(other, ARMS["mcmc"], OPTIONS).load(path)
    Fit(scene, ARMS["mcmc"], OPTIONS).load(path)
