"""What the position noise draws: its law against an oracle of matrices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracles import covariance
from trainers import gaussians

from opt3dgs_optim.lbfgs import pairs
from opt3dgs_optim.parts.noise import covariance_noise


def test_is_gate_times_covariance_times_eta() -> None:
    g = gaussians(40)
    eta = torch.randn(40, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    noise = covariance_noise(g["scales"], g["quats"], g["opacities"], eta).numpy()
    for i in range(40):
        opacity = 1 / (1 + np.exp(-g["opacities"][i].item()))
        gate = 1 / (1 + np.exp(100 * (opacity - 0.005)))
        sigma = covariance(g["scales"][i].numpy(), g["quats"][i].numpy())
        np.testing.assert_allclose(noise[i], gate * sigma @ eta[i].numpy(), rtol=1e-9, atol=1e-13)


def test_gate_is_the_trainers_op_sigmoid() -> None:
    """op_sigmoid(1 - o, k=100, x0=0.995) of 3dgs-mcmc."""
    opacity = torch.tensor([0.0005, 0.005, 0.05, 0.9], dtype=torch.float64)
    ones = torch.ones(4, 3, dtype=torch.float64)
    quats = torch.tensor([[1.0, 0, 0, 0]] * 4, dtype=torch.float64)
    noise = covariance_noise(0 * ones, quats, opacity.logit(), ones)[:, 0]
    expected = 1 / (1 + torch.exp(-100 * ((1 - opacity) - 0.995)))
    torch.testing.assert_close(noise, expected, rtol=1e-9, atol=1e-15)


def test_nerfstudio_opacities_have_a_second_dimension() -> None:
    g = gaussians(5)
    eta = torch.ones(5, 3, dtype=torch.float64)
    flat = covariance_noise(g["scales"], g["quats"], g["opacities"], eta)
    column = covariance_noise(g["scales"], g["quats"], g["opacities"].unsqueeze(1), eta)
    assert torch.equal(flat, column)


def test_quaternions_of_any_length_and_of_none() -> None:
    """As torch.nn.functional.normalize: below 1e-12 there is no direction, and no NaN."""
    g = gaussians(5)
    eta = torch.ones(5, 3, dtype=torch.float64)
    sizes = torch.tensor([1e-6, 0.1, 1.0, 1e6, 1.0], dtype=torch.float64)[:, None]
    unit = torch.nn.functional.normalize(g["quats"])
    found = covariance_noise(g["scales"], unit * sizes, g["opacities"], eta)
    expected = covariance_noise(g["scales"], unit, g["opacities"], eta)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=0)
    none = covariance_noise(g["scales"], 0 * unit, g["opacities"], eta)
    # R = 1 where there is no quaternion: the variances along the axes
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(5, 4)
    assert torch.equal(none, covariance_noise(g["scales"], upright, g["opacities"], eta))


def test_chunks_of_rows_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    # 32 rows fill the registers of every CPU: torch's exp rounds a rest of fewer otherwise.
    g, eta = gaussians(80), torch.ones(80, 3, dtype=torch.float64)
    whole = covariance_noise(**g, eta=eta)
    monkeypatch.setattr(pairs, "CHUNK", 32)
    assert torch.equal(covariance_noise(**g, eta=eta), whole)
    monkeypatch.setattr(pairs, "CHUNK", 8)
    torch.testing.assert_close(covariance_noise(**g, eta=eta), whole, rtol=1e-11, atol=0.0)
