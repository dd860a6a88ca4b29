"""The noise's law against an oracle of matrices."""

from __future__ import annotations

import math
import re
import warnings
from typing import Any

import devices
import numpy as np
import pytest
import torch
from oracles import covariance
from trainers import (
    edit_rows,
    gaussians,
    gsplat_optimizers,
    make_splats,
    only,
    train,
    upgraded,
    values_of,
)

from opt3dgs_optim import (
    Annealing,
    Course,
    IsotropicNoise,
    Phase,
    PhaseScheduler,
    PositionNoise,
)
from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.parts.noise import GATE_OPACITY, GATE_SHARPNESS, covariance_noise


def test_added_noise_has_the_covariance_squared() -> None:
    """Cov(gate Sigma eta) = gate^2 Sigma^2, times (lr scale)^2."""
    n = 40_000
    one = {key: value[:1].expand(n, *value.shape[1:]) for key, value in gaussians(1, 3).items()}
    one["opacities"] = torch.full((n,), -12.0, dtype=torch.float64)
    means = torch.zeros(n, 3, dtype=torch.float64)
    torch.manual_seed(0)
    PositionNoise(one, scale=20.0).add_to(means, 0.05)
    sigma = covariance(one["scales"][0].numpy(), one["quats"][0].numpy())
    gate = 1 / (1 + np.exp(100 * (1 / (1 + np.exp(12.0)) - 0.005)))
    expected = gate**2 * sigma @ sigma
    # relative standard error of a second moment from 40,000 draws: 0.7 %
    np.testing.assert_allclose(np.cov(means.numpy().T), expected, atol=0.04 * expected.max())


def test_host_dict_is_read_anew() -> None:
    g = gaussians(4)
    noise = PositionNoise(g, scale=1.0)
    more = gaussians(6)
    g.update(more)
    means = torch.zeros(6, 3, dtype=torch.float64)
    noise.add_to(means, 1.0)
    assert bool(means.any())


def test_function_as_source() -> None:
    means = torch.zeros(4, 3, dtype=torch.float64)
    PositionNoise(lambda: gaussians(4), scale=1.0).add_to(means, 1.0)
    assert bool(means.any())


def test_generator_makes_it_reproducible() -> None:
    draws = []
    for _ in "ab":
        means = torch.zeros(4, 3, dtype=torch.float64)
        generator = torch.Generator().manual_seed(5)
        PositionNoise(gaussians(4), scale=1.0, generator=generator).add_to(means, 1.0)
        draws.append(means)
    assert torch.equal(*draws)


def test_mistakes_are_named() -> None:
    means = torch.zeros(4, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match=re.escape("['quats', 'opacities']")):
        PositionNoise({"scales": means}).add_to(means, 1.0)
    with pytest.raises(ValueError, match="5 scales for 4 means"):
        PositionNoise(gaussians(5)).add_to(means, 1.0)


def test_the_constants_are_the_trainers() -> None:
    """noise_lr, k and 1 - x0 of 3dgs-mcmc."""
    assert PositionNoise({}).scale == 5e5
    assert (GATE_SHARPNESS, GATE_OPACITY) == (100.0, 0.005)


@pytest.mark.parametrize(
    "lr", [0.05, torch.tensor(0.05, dtype=torch.float64)], ids=["float", "0-d"]
)
def test_added_noise_is_scale_times_learning_rate_times_the_draw(lr: float | torch.Tensor) -> None:
    g = gaussians(7)
    start = torch.randn(7, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    means = start.clone()
    noise = PositionNoise(g, scale=0.25, generator=torch.Generator().manual_seed(5))
    noise.add_to(means, lr)
    eta = torch.randn(7, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    drawn = covariance_noise(g["scales"], g["quats"], g["opacities"], eta)
    torch.testing.assert_close(means, start + 0.25 * 0.05 * drawn, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize(
    ("options", "deviation"),
    [
        ({"temperature": 0.5}, math.sqrt(2 * 0.02 * 0.5)),
        ({"std": 0.3}, 0.3),
        ({"temperature": 0.0}, 0.0),
        ({"std": 0.0}, 0.0),
    ],
    ids=str,
)
def test_isotropic_noise_is_the_deviation_times_the_draw(options: dict, deviation: float) -> None:
    start = torch.randn(6, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    point = start.clone()
    noise = IsotropicNoise(**options, generator=torch.Generator().manual_seed(5))
    noise.after({"lr": 0.02}, point, {}, Course())
    eta = torch.randn(6, 2, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    torch.testing.assert_close(point, start + deviation * eta, rtol=1e-14, atol=0)


def test_isotropic_noise_is_given_in_one_way() -> None:
    options: dict
    for options in ({}, {"temperature": 1.0, "std": 1.0}):
        with pytest.raises(ValueError, match="exactly one of the two"):
            IsotropicNoise(**options)
    for name in ("temperature", "std"):
        options = {name: -0.5}
        with pytest.raises(ValueError, match=rf"IsotropicNoise: {name}=-0\.5"):
            IsotropicNoise(**options)


def test_a_scale_of_a_half_or_none() -> None:
    for scale in (0.5, 0.0):
        assert PositionNoise({}, scale=scale).scale == scale
    with pytest.raises(ValueError, match=r"scale=-0\.5"):
        PositionNoise({}, scale=-0.5)


@pytest.mark.parametrize("rows", [3, 5])
def test_gaussians_of_another_scene(rows: int) -> None:
    """Also where the number of points is that of the coordinates."""
    means = torch.zeros(rows, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match=f"6 scales for {rows} means"):
        PositionNoise(gaussians(6)).add_to(means, 1.0)
    PositionNoise(gaussians(rows)).add_to(means, 1.0)
    assert bool(means.any())


# -- as a part of a training -----------------------------------------------------------------------


def test_it_can_stop_at_the_switch() -> None:
    for during, moves in ((None, True), (Phase.EXPLORATION, False), (Phase.EXPLOITATION, True)):
        splats = make_splats()
        splats["opacities"].data.fill_(-9.0)
        phases = only(60, PositionNoise(splats, 1.0, during=during), switch=40)
        adams = phases.upgrade(gsplat_optimizers(splats))
        means = adams["means"]
        for iteration, expected in ((10, during is not Phase.EXPLOITATION), (50, moves)):
            before = values_of(splats)
            phases.observe(0.1, iteration=iteration)
            splats["means"].grad = torch.zeros(12, 3)
            means.step()
            assert torch.equal(before["means"], splats["means"]) != expected


def test_its_size_goes_by_the_trainers_rate_without_any_factor() -> None:
    """3DGS-MCMC's noise is proportional to the learning rate that the trainer has set."""
    ends = []
    for parts in ([], [Annealing(8.0, 0.5, names=GAUSSIAN)]):
        splats = make_splats()
        splats["opacities"].data.fill_(-9.0)
        noise = PositionNoise(splats, 1.0, generator=torch.Generator().manual_seed(5))
        phases = only(60, *parts, noise)
        adams = phases.upgrade(gsplat_optimizers(splats))
        means = adams["means"]
        phases.observe(0.1)
        splats["means"].grad = torch.zeros(12, 3)  # Adam's step is then zero
        means.step()
        ends.append(splats["means"].detach())
    assert torch.equal(*ends)


@pytest.mark.parametrize("host_adds_noise", [0.01, 0.0, None])
def test_noise_of_a_trainer_that_nobody_told_us_of(host_adds_noise: float | None) -> None:
    """The trainer writes noise into the positions after every step, as ours does.

    gsplat's `mcmc` and 3dgs-mcmc do so with a rate of 0, too: then there is nothing to say.
    """
    splats = make_splats()
    phases = only(60, PositionNoise(splats, 1.0))
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for iteration in range(20):
            train(splats, upgraded, phases, iteration, iteration + 1)
            if host_adds_noise is not None:
                with torch.no_grad():
                    splats["means"].add_(host_adds_noise * torch.randn(splats["means"].shape))
            if iteration % 7 == 0:
                edit_rows(splats, upgraded, torch.arange(len(splats["means"])), 1)
    said = [str(warning.message) for warning in told if "noise_lr to 0" in str(warning.message)]
    assert len(said) == bool(host_adds_noise)


@pytest.mark.parametrize("writes", [(5,), (3, 4, 5), (6,), (5, 6)])
def test_six_writes_in_a_row_are_one_too_many(writes: tuple[int, ...]) -> None:
    """Between two steps each; a step without one begins anew."""
    splats = make_splats()
    phases = only(200, PositionNoise(splats, 1.0))
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    iteration = 0
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for count in writes:
            for written in [False, *[True] * count]:
                if written:
                    with torch.no_grad():
                        splats["means"].add_(0.01)
                train(splats, upgraded, phases, iteration, iteration + 1)
                iteration += 1
    assert any("noise_lr to 0" in str(warning.message) for warning in told) == (writes[-1] == 6)


@pytest.mark.parametrize("kind", [PositionNoise, IsotropicNoise])
def test_a_dropped_step_adds_no_noise_and_draws_as_many_numbers(
    kind: Any, monkeypatch: Any
) -> None:
    """The same training goes the same way where only the device knows which steps count."""
    ends = []
    for on_device in (False, True):
        with monkeypatch.context() as patch:
            if on_device:
                devices.on_a_device(patch)
            splats = make_splats()
            splats["opacities"].data.fill_(-9.0)
            generator = torch.Generator().manual_seed(5)
            options: dict[str, Any] = {"scale": 1e4} if kind is PositionNoise else {"std": 0.5}
            phases = only(60, kind(generator=generator, **options))
            adams = phases.upgrade(gsplat_optimizers(splats, fused=True))
            for i in range(6):
                phases.observe(float("nan") if i in (1, 4) else 0.1)
                before = splats["means"].detach().clone()
                for name in ("means", "scales"):
                    splats[name].grad = torch.ones_like(splats[name])
                    adams[name].step()
                assert torch.equal(before, splats["means"]) == (i in (1, 4))
            ends.append((splats["means"].detach(), generator.get_state()))
    assert torch.equal(ends[0][0], ends[1][0])
    assert torch.equal(ends[0][1], ends[1][1])


def test_a_trainers_noise_is_fine_where_ours_is_off() -> None:
    splats, phases, optimizers = upgraded(60, Annealing(names=GAUSSIAN))
    for iteration in range(10):
        train(splats, optimizers, phases, iteration, iteration + 1)
        with torch.no_grad():
            splats["means"].add_(0.01)


def test_the_phase_is_checked() -> None:
    with pytest.raises(ValueError, match="PositionNoise: during='exploration', but None or"):
        PositionNoise(during="exploration")  # pyright: ignore[reportArgumentType]


def test_what_is_missing_is_said_before_anything_has_moved() -> None:
    means = torch.nn.Parameter(torch.ones(4, 3))
    adam = torch.optim.Adam([{"params": [means], "lr": 0.01, "name": "means"}])
    phases = PhaseScheduler(10, parts=[PositionNoise()])
    phases.upgrade(adam)
    means.grad = torch.ones_like(means)
    phases.observe(0.1)
    with pytest.raises(ValueError, match=r"PositionNoise: .*scales.* are not among"):
        adam.step()
    assert torch.equal(means, torch.ones(4, 3))


@pytest.mark.parametrize("order", [1, -1])
def test_two_noises_do_not_take_each_other_for_the_trainers(order: int) -> None:
    parts = [PositionNoise(scale=1.0), IsotropicNoise(std=1e-6)][::order]
    splats, phases, optimizers = upgraded(60, *parts)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(splats, optimizers, phases, 0, 30)
