"""The examples' trainer: its arms, and that a stop changes nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from splatting.arms import ARMS, Arm, find_arm
from splatting.embedded import embedded_scene
from splatting.fit import Fit, FitOptions
from splatting.scenes import Scene

OPTIONS = FitOptions(iterations=90, points=150)
RESUMED = ("stock", "defaults", "x2", "learn2splat", "paper")  # what the others have, too


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The embedded scene with fewer views."""
    whole = embedded_scene()
    return replace(whole, train=whole.train[:6], test=whole.test[:1])


def values(fit: Fit) -> list[torch.Tensor]:
    return [param.detach().clone() for param in fit.gaussians.values()]


def trained(fit: Fit, iterations: int) -> list[float]:
    return [float(fit.step()) for _ in range(iterations)]


@pytest.mark.parametrize("name", RESUMED)
def test_an_arm_trains_and_resumes_bit_for_bit(scene: Scene, name: str, tmp_path: Path) -> None:
    """Stopped in the first phase and in the last thirtieth, it ends where it would have ended."""
    whole = Fit(scene, ARMS[name], OPTIONS)
    losses = trained(whole, 90)
    assert np.mean(losses[50:60]) < np.mean(losses[:10])  # before the loss may turn to L2
    fit = Fit(scene, ARMS[name], OPTIONS)
    for i, stop in enumerate((47, 88, 90)):
        trained(fit, stop - fit.iteration)
        fit.save(tmp_path / f"{i}.pt")
        fit = Fit(scene, ARMS[name], OPTIONS)
        fit.load(tmp_path / f"{i}.pt")
    assert fit.iteration == 90
    assert all(torch.equal(a, b) for a, b in zip(values(whole), values(fit), strict=True))


def test_arms_are_what_they_say(scene: Scene) -> None:
    """Steps times 2; Learn2Splat's rates, beta1 and constant rate of the positions."""
    first = [Fit(scene, ARMS[name], OPTIONS) for name in ("stock", "x2")]
    before = values(first[0])
    for fit in first:
        fit.step()
    stock, doubled = ([a - b for a, b in zip(values(f), before, strict=True)] for f in first)
    for name, one, two in zip(first[0].gaussians, stock, doubled, strict=True):
        if name != "means":  # the noise is not doubled
            torch.testing.assert_close(two, 2 * one, rtol=1e-3, atol=1e-6)
    tuned = Fit(scene, ARMS["learn2splat"], OPTIONS)
    trained(tuned, 20)
    for name, optimizer in tuned.optimizers.items():
        (group,) = optimizer.param_groups
        assert group["lr"] == pytest.approx(5 * first[0].rates[name])
        assert group["betas"][0] == 0.99
    (decayed,) = first[0].optimizers["means"].param_groups
    assert decayed["lr"] == pytest.approx(first[0].rates["means"] * 0.01 ** (1 / 90))


def test_the_number_of_gaussians_grows_to_the_budget(scene: Scene) -> None:
    few = replace(scene, points=scene.points[:20], colors=scene.colors[:20])
    fit = Fit(few, ARMS["stock"], replace(OPTIONS, iterations=200, points=100))
    assert len(fit.gaussians["means"]) == 20
    losses = trained(fit, 200)
    assert len(fit.gaussians["means"]) == 100
    assert np.mean(losses[-20:]) < 0.8 * np.mean(losses[:20])


def test_spherical_harmonics_come_degree_by_degree(scene: Scene) -> None:
    fit = Fit(scene, ARMS["defaults"], replace(OPTIONS, iterations=150, sh_degree=2))
    trained_degrees, degrees = [], []
    for _ in range(12):
        degrees.append(fit.active_sh_degree)
        fit.step()
        # Degree 1 is the first three coefficients, degree 2 the other five.
        shN = fit.gaussians["shN"].detach()
        trained_degrees.append((bool(shN[:, :3].any()), bool(shN[:, 3:].any())))
    assert degrees == [0] * 5 + [1] * 5 + [2] * 2
    assert trained_degrees == [(False, False)] * 5 + [(True, False)] * 5 + [(True, True)] * 2


def test_checkpoints_of_other_trainings_are_refused(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    Fit(scene, ARMS["stock"], OPTIONS).save(path)
    first = scene.train[0]
    smaller = replace(first, image=first.image[::2])
    others: list[tuple[Scene, Arm, FitOptions]] = [
        (scene, ARMS["x2"], OPTIONS),
        (scene, ARMS["stock"], replace(OPTIONS, seed=1)),
        (replace(scene, background=torch.ones(3)), ARMS["stock"], OPTIONS),
        (replace(scene, train=[smaller, *scene.train[1:]]), ARMS["stock"], OPTIONS),
        (replace(scene, train=scene.train[1:]), ARMS["stock"], OPTIONS),
    ]
    kinds = [*[Fit] * len(others), type("OtherFit", (Fit,), {})]
    for kind, other in zip(kinds, [*others, (scene, ARMS["stock"], OPTIONS)], strict=True):
        with pytest.raises(ValueError, match="choose another folder"):
            kind(*other).load(path)
    for content in (b"", b"no checkpoint"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"checkpoint\.pt: no checkpoint of this trainer"):
            Fit(scene, ARMS["stock"], OPTIONS).load(path)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: find_arm("sgd"), "'sgd' is unknown; there are stock, defaults"),
        (lambda: FitOptions(iterations=0), "iterations=0"),
        (lambda: FitOptions(points=0), "points=0"),
        (lambda: FitOptions(threshold=0.0), r"threshold=0\.0"),
    ],
)
def test_bad_options(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
