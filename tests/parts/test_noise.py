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

from opt3dgs_optim import IsotropicNoise, PhaseScheduler, PositionNoise
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
    """Refused before the step; also where there is one point, or as many as coordinates."""
    for name in ("scales", "quats", "opacities"):
        splats = dim(rows)
        splats[name] = dim(6)[name]
        start = splats["means"].detach().clone()
        for said in (rf"{name} is \[6.*is needed for {rows} means", rf"{name} is missing"):
            adams, splats["means"].grad = upgraded(splats, PositionNoise()), torch.ones_like(start)
            with pytest.raises(ValueError, match=f"PositionNoise: {said}"):
                adams["means"].step()
            splats.pop(name, None)
        assert torch.equal(splats["means"], start)


@pytest.mark.parametrize("temperature", [0.5, 0.0])
def test_isotropic_noise_is_the_deviation_times_the_draw(temperature: float) -> None:
    """On any parameter, of the rate that its group has now."""
    x = Parameter(torch.randn(6, 2, generator=draw(1)))
    phases = PhaseScheduler(10, parts=[IsotropicNoise(temperature, generator=draw())])
    groups = [{"params": [Parameter(zeros(2))], "name": "xyz"}, {"params": [x], "lr": 0.02}]
    adam = phases.upgrade(torch.optim.Adam(groups, lr=0.3))
    x.grad, start = torch.zeros(6, 2), x.detach().clone()
    adam.step()
    eta = math.sqrt(2 * 0.02 * temperature) * torch.randn(6, 2, generator=draw())
    torch.testing.assert_close(x.detach(), start + eta, rtol=1e-6, atol=1e-6)


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


def upgraded(splats: dict[str, Parameter], *parts: Any) -> Any:
    adams = {name: torch.optim.Adam([param], lr=0.1) for name, param in splats.items()}
    return PhaseScheduler(60, parts=list(parts)).upgrade(adams)


def moved(splats: dict[str, Parameter], adams: Any) -> Tensor:
    """How far a step without a gradient, in which Adam does nothing, moves the positions."""
    before = splats["means"].detach().clone()
    splats["means"].grad = torch.zeros_like(splats["means"])
    adams["means"].step()
    return splats["means"].detach() - before


def test_its_size_goes_by_the_trainers_rate_without_any_factor() -> None:
    """And it finds scales, quaternions and opacities among the upgraded optimizers."""
    splats = dim()
    longer = Longer(8.0)
    adams = upgraded(splats, longer, PositionNoise(scale=2.0, generator=draw()))
    adams["means"].param_groups[0]["lr"] = 0.03
    eta = torch.randn(12, 3, generator=draw())
    others = {name: splats[name].detach() for name in ("scales", "quats", "opacities")}
    expected = 2.0 * 0.03 * covariance_noise(**others, eta=eta)
    torch.testing.assert_close(moved(splats, adams), expected, rtol=1e-4, atol=1e-6)


# -- options ---------------------------------------------------------------------------------------


def test_options() -> None:
    with pytest.raises(ValueError, match=r"IsotropicNoise: temperature=-0\.5"):
        IsotropicNoise(-0.5)
    with pytest.raises(ValueError, match=r"PositionNoise: scale=-0\.5"):
        PositionNoise(-0.5)
    assert PositionNoise(0.0).scale == 0.0


def test_says_what_it_is() -> None:
    assert repr(PositionNoise()) == "PositionNoise(scale=500000.0, generator=None)"
    assert "temperature=0.5" in repr(IsotropicNoise(0.5))
