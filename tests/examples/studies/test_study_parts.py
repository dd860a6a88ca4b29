"""The study's own parts, cut-up scenes and adaptive density control."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from splatting.fit import Fit, FitOptions
from splatting.scenes import Scene, load_scene
from studies.scenes import costs
from studies.scenes.arms import find_study_arm
from studies.scenes.records import read_costs
from studies.scenes.training import Spec, scene_of, train


@cache
def embedded() -> Scene:
    return load_scene("embedded")


def fit_with(arm: str, kind: type[Fit] = Fit, iterations: int = 60) -> Fit:
    return kind(embedded(), find_study_arm(arm), FitOptions(iterations, 120))


def same_after_resuming(make: Any, path: Path, before: int, after: int) -> bool:
    """Whether a training that was saved and loaded goes on as the one that was not."""
    whole = make()
    for _ in range(before):
        whole.step()
    whole.save(path)
    for _ in range(after):
        whole.step()
    resumed = make()
    resumed.load(path)  # the noise's random numbers, too
    for _ in range(after):
        resumed.step()
    return all(torch.equal(p, resumed.gaussians[n]) for n, p in whole.gaussians.items())


def test_fewer_views_are_evenly_spaced() -> None:
    every = scene_of(Spec("embedded", "mcmc", 0, 10, 10)).train
    few = scene_of(Spec("embedded", "mcmc", 0, 10, 10, views=4)).train
    assert [view.name for view in few] == [every[i * len(every) // 4].name for i in range(4)]
    with pytest.raises(ValueError, match="views=1, but 2 to"):
        scene_of(Spec("embedded", "mcmc", 0, 10, 10, views=1))


@pytest.mark.thorough
def test_adaptive_density_control_grows_and_resumes(tmp_path: Path) -> None:
    pytest.importorskip("gsplat")
    from studies.scenes.adaptive import AdaptiveFit

    def make() -> Fit:
        fit = fit_with("adc+annealed+faded-but-scales", AdaptiveFit, 120)
        strategy: Any = vars(fit.density)["strategy"]
        strategy.refine_start_iter, strategy.refine_every = 20, 30
        return fit

    assert same_after_resuming(make, tmp_path / "at.pt", 45, 20)
    fit = make()
    for _ in range(65):
        fit.step()
    assert len(fit.gaussians["means"]) > 120
    assert fit.relocated == 0


def test_adaptive_density_control_resets_the_opacities() -> None:
    pytest.importorskip("gsplat")
    from studies.scenes.adaptive import AdaptiveFit

    fit = fit_with("adc", AdaptiveFit)
    strategy: Any = vars(fit.density)["strategy"]
    strategy.reset_every, strategy.refine_stop_iter = 10, 20
    largest = []
    for _ in range(22):
        fit.step()
        largest.append(torch.sigmoid(fit.gaussians["opacities"]).max().item())
        if len(largest) == 11:  # density control counts from 0
            assert (
                not fit.optimizers["opacities"].state[fit.gaussians["opacities"]]["exp_avg"].any()
            )
    low = [i for i, value in enumerate(largest) if value == pytest.approx(0.01)]
    assert low == [10]  # neither at the start nor after density control has ended


def test_smaller_images_raise_the_density_threshold() -> None:
    pytest.importorskip("gsplat")
    from studies.scenes.adaptive import AdaptiveFit

    scene, arm, options = embedded(), find_study_arm("adc"), FitOptions(60, 120)
    width = scene.train[0].camera.width
    for name, factor in (("embedded", 1.0), ("lego", 800 / width)):
        fit = AdaptiveFit(replace(scene, name=name), arm, options)
        strategy: Any = vars(fit.density)["strategy"]
        assert strategy.grow_grad2d == pytest.approx(2e-4 * factor)


def test_a_trainer_with_other_rates_makes_other_steps() -> None:
    usual, doubled = (
        Fit(embedded(), find_study_arm("faded"), FitOptions(60, 120, rates=rates))
        for rates in (1.0, 2.0)
    )
    start = usual.gaussians["sh0"].detach().clone()
    for fit in (usual, doubled):
        fit.step()
    ratio = (doubled.gaussians["sh0"] - start) / (usual.gaussians["sh0"] - start)
    assert ratio.nanmedian().item() == pytest.approx(2.0, rel=1e-3)
    with pytest.raises(ValueError, match=r"rates=0\.0, must be above 0"):
        FitOptions(rates=0.0)


@pytest.mark.thorough
def test_costs_are_measured_in_turns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("ROUNDS", 2), ("STEPS", 1), ("FIRST", 0)):
        monkeypatch.setattr(costs, name, value)
    for arm in ("mcmc", "faded"):
        folder = tmp_path / arm
        folder.mkdir()
        spec = Spec("embedded", arm, 0, 20, 60, rotated=True)
        call = {"spec": {**asdict(spec), "tiled": 0}, "mean_nu": None}  # as of before 2026-11-25
        (folder / "call.json").write_text(json.dumps(call), encoding="utf-8")
        train(spec, folder, None, None)
    (made,) = costs.measure_all(tmp_path, [20])
    assert made["checkpoints"] == ["at-10.pt", "at-15.pt", "at-18.pt"]
    assert made["shares"]["mcmc"] == 1.0
    assert made["shares"]["faded"] > 0
    path = tmp_path / "costs.json"
    path.write_text(json.dumps([made]), encoding="utf-8")
    assert read_costs(path)["embedded", "images_4", 20, 0, 0, "mcmc"] == 1.0
    assert costs.main(["--runs", str(tmp_path), "--iterations", "30"]) == 2
