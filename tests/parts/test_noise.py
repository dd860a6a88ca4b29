"""Langevin noise: its law against an oracle of matrices, and where it comes from."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from oracles import covariance
from splatting.arms import Longer
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import IsotropicNoise, Phase, PhaseScheduler, PositionNoise
from opt3dgs_optim.parts.noise import covariance_noise


def gaussians(n: int, seed: int = 0) -> dict[str, Tensor]:
    """Gaussians to be moved, in float64: log scales, quaternions, opacity logits."""
    generator = torch.Generator().manual_seed(seed)
    like: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    return {
        "scales": torch.randn(n, 3, **like),
        "quats": 3 * torch.randn(n, 4, **like),
        "opacities": 6 * torch.randn(n, **like) - 4,
    }


def zeros(n: int) -> Tensor:
    return torch.zeros(n, 3, dtype=torch.float64)


def draw(seed: int = 5) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# -- what is drawn ---------------------------------------------------------------------------------


def test_is_gate_times_covariance_times_eta() -> None:
    g = gaussians(40)
    eta = torch.randn(40, 3, generator=draw(), dtype=torch.float64)
    noise = covariance_noise(g["scales"], g["quats"], g["opacities"], eta).numpy()
    for i in range(40):
        opacity = 1 / (1 + np.exp(-g["opacities"][i].item()))
        gate = 1 / (1 + np.exp(100 * (opacity - 0.005)))
        sigma = covariance(g["scales"][i].numpy(), g["quats"][i].numpy())
        np.testing.assert_allclose(noise[i], gate * sigma @ eta[i].numpy(), rtol=1e-9, atol=1e-13)


def test_opacities_may_have_a_second_dimension() -> None:
    g, eta = gaussians(5), torch.ones(5, 3, dtype=torch.float64)
    flat = covariance_noise(g["scales"], g["quats"], g["opacities"], eta)
    column = covariance_noise(g["scales"], g["quats"], g["opacities"].unsqueeze(1), eta)
    assert torch.equal(flat, column)


def test_rows_of_nonsense_do_not_move_and_move_no_other() -> None:
    g, eta = gaussians(6), torch.ones(6, 3, dtype=torch.float64)
    expected = covariance_noise(**g, eta=eta)
    g["scales"][1], g["quats"][3], g["scales"][5] = math.nan, math.inf, 800.0
    found = covariance_noise(**g, eta=eta)
    assert torch.equal(found[::2], expected[::2])
    assert found[1::2].tolist() == [[0.0] * 3] * 3


# -- what is added ---------------------------------------------------------------------------------


@pytest.mark.parametrize("rows", [1, 3, 5])
def test_gaussians_of_another_scene(rows: int) -> None:
    """Where the number of points is one, or that of the coordinates, too."""
    for name, tensor in gaussians(6).items():
        means = zeros(rows)
        wrong = {**gaussians(rows), name: tensor}
        with pytest.raises(ValueError, match=rf"{name} is \[6.*is needed for {rows} means"):
            PositionNoise(wrong).add_to(means, 1.0)
        del wrong[name]
        with pytest.raises(ValueError, match=rf"PositionNoise: {name} is missing"):
            PositionNoise(wrong).add_to(means, 1.0)
        assert not means.any()
    with pytest.raises(ValueError, match="give them to PositionNoise"):
        PositionNoise().add_to(zeros(rows), 1.0)


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
    """On any parameter, of the rate that its group has now."""
    x = Parameter(torch.randn(6, 2, generator=draw(1)))
    phases = PhaseScheduler(10, parts=[IsotropicNoise(**options, generator=draw())])
    groups = [{"params": [Parameter(zeros(2))], "name": "xyz"}, {"params": [x], "lr": 0.02}]
    adam = phases.upgrade(torch.optim.Adam(groups, lr=0.3))
    x.grad, start = torch.zeros(6, 2), x.detach().clone()
    adam.step()
    eta = torch.randn(6, 2, generator=draw())
    torch.testing.assert_close(x.detach(), start + deviation * eta, rtol=1e-6, atol=1e-6)


# -- in a training ---------------------------------------------------------------------------------


def dim(rows: int = 12) -> dict[str, Parameter]:
    """Gaussians that are nearly transparent, so that they move."""
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": ()}
    splats = {
        name: Parameter(torch.randn(rows, *shape, generator=draw(1)))
        for name, shape in shapes.items()
    }
    splats["opacities"].data.fill_(-9.0)
    return splats


def upgraded(splats: dict[str, Parameter], *parts: Any) -> tuple[PhaseScheduler, Any]:
    adams = {name: torch.optim.Adam([param], lr=0.1) for name, param in splats.items()}
    phases = PhaseScheduler(60, 40, parts=list(parts))
    return phases, phases.upgrade(adams)


def moved(splats: dict[str, Parameter], adams: Any) -> Tensor:
    """How far a step without a gradient, in which Adam does nothing, moves the positions."""
    before = splats["means"].detach().clone()
    splats["means"].grad = torch.zeros_like(splats["means"])
    adams["means"].step()
    return splats["means"].detach() - before


@pytest.mark.parametrize("during", [None, *Phase])
def test_it_can_begin_or_stop_at_the_switch(during: Phase | None) -> None:
    splats = dim()
    phases, adams = upgraded(splats, PositionNoise(scale=1.0, during=during))
    found = []
    for iteration in (10, 50):
        phases.observe(iteration=iteration)
        found.append(bool(moved(splats, adams).any()))
    assert found == [during is not Phase.EXPLOITATION, during is not Phase.EXPLORATION]


def test_its_size_goes_by_the_trainers_rate_without_any_factor() -> None:
    """And it finds scales, quaternions and opacities among the upgraded optimizers."""
    splats = dim()
    longer = Longer(8.0)
    _, adams = upgraded(splats, longer, PositionNoise(scale=2.0, generator=draw()))
    adams["means"].param_groups[0]["lr"] = 0.03
    eta = torch.randn(12, 3, generator=draw())
    others = {name: splats[name].detach() for name in ("scales", "quats", "opacities")}
    expected = 2.0 * 0.03 * covariance_noise(**others, eta=eta)
    torch.testing.assert_close(moved(splats, adams), expected, rtol=1e-4, atol=1e-6)


# -- options ---------------------------------------------------------------------------------------


def test_options() -> None:
    for options in ({}, {"temperature": 1.0, "std": 1.0}):
        with pytest.raises(ValueError, match="exactly one of the two"):
            IsotropicNoise(**options)  # pyright: ignore
    for name in ("temperature", "std"):
        with pytest.raises(ValueError, match=rf"IsotropicNoise: {name}=-0\.5"):
            IsotropicNoise(**{name: -0.5})  # pyright: ignore
    for scale in (0.5, 0.0):
        assert PositionNoise({}, scale=scale).scale == scale
    with pytest.raises(ValueError, match=r"scale=-0\.5"):
        PositionNoise({}, scale=-0.5)
    with pytest.raises(ValueError, match="PositionNoise: during='exploration', but None or"):
        PositionNoise(during="exploration")  # pyright: ignore[reportArgumentType]


def test_says_what_it_is() -> None:
    assert repr(PositionNoise()) == "PositionNoise(scale=500000)"
    assert repr(PositionNoise(scale=1.0, during=Phase.EXPLORATION)).endswith(
        "scale=1, during=Phase.EXPLORATION)"
    )
    assert "temperature=0.5" in repr(IsotropicNoise(0.5))
