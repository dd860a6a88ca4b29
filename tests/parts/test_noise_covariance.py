"""The position noise: its law against an oracle of matrices, in place, and who computes it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from oracles import covariance
from trainers import gaussians

from opt3dgs_optim import cuda
from opt3dgs_optim.lbfgs import pairs
from opt3dgs_optim.parts import noise as module
from opt3dgs_optim.parts.noise import add_covariance_noise, covariance_noise, largest_noise


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


def tensors_of(tensors: dict[str, Any]) -> Any:
    """Scales, quats and opacities (and eta), to be starred."""
    return tuple(tensors.values())


@pytest.mark.parametrize(
    "lr", [0.05, torch.tensor(0.05, dtype=torch.float64)], ids=["float", "0-d"]
)
def test_added_noise_is_scale_times_learning_rate_times_the_draw(lr: float | torch.Tensor) -> None:
    g = gaussians(7)
    start, eta = torch.randn(2, 7, 3, generator=torch.Generator().manual_seed(1)).double()
    means = start.clone()
    add_covariance_noise(means, *tensors_of(g), eta=eta, lr=lr, noise_scale=0.25)
    drawn = covariance_noise(*tensors_of(g), eta=eta)
    torch.testing.assert_close(means, start + 0.25 * lr * drawn, rtol=1e-12, atol=1e-15)


def test_chunks_of_rows_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    g, eta = gaussians(40), torch.ones(40, 3, dtype=torch.float64)
    whole = torch.zeros(40, 3, dtype=torch.float64)
    parts = whole.clone()
    add_covariance_noise(whole, *tensors_of(g), eta=eta, lr=0.5, noise_scale=2.0)
    monkeypatch.setattr(pairs, "CHUNK", 8)
    add_covariance_noise(parts, *tensors_of(g), eta=eta, lr=0.5, noise_scale=2.0)
    assert torch.equal(parts, whole)
    assert torch.equal(covariance_noise(*tensors_of(g), eta=eta), whole)


def test_largest_noise_is_that_of_the_longest_axis() -> None:
    scales = torch.tensor([[0.0, 1.0, -1.0], [2.0, 0.0, 0.0]], dtype=torch.float64)
    opacity = torch.tensor([0.005, 0.5], dtype=torch.float64)  # half open, and shut
    found = largest_noise(scales, opacity.logit(), 10.0)
    assert float(found) == pytest.approx(10.0 * 0.5 * np.exp(2.0), rel=1e-9)
    assert float(largest_noise(scales[:0], opacity[:0], 10.0)) == 0.0


def test_cuda_on_a_cpu_is_an_error() -> None:
    means = torch.zeros(4, 3, dtype=torch.float64)
    with pytest.raises(RuntimeError, match="backend='cuda' was asked for on cpu"):
        add_covariance_noise(
            means, *tensors_of(gaussians(4)), eta=means + 1, lr=1.0, noise_scale=1.0, backend="cuda"
        )


@pytest.mark.parametrize("spoiled", [None, "scales", "quats", "opacities", "eta"])
def test_the_kernel_gets_what_it_can_read(
    spoiled: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    called = []
    monkeypatch.setattr(module, "uses_kernel", lambda *_: True)
    monkeypatch.setattr(cuda, "launch", lambda *given: called.append(given))
    means = torch.zeros(4, 3, dtype=torch.float64)
    tensors = {**gaussians(4), "eta": means + 1}
    tensors["opacities"] = tensors["opacities"].unsqueeze(1)
    if spoiled is None:
        add_covariance_noise(means, *tensors_of(tensors), lr=0.5, noise_scale=2.0)
        assert called[0][-5:] == (0, 1.0, 100.0, 0.005, 4)  # no address of a rate; 0.5 * 2
        return
    for wrong in (tensors[spoiled][:3], tensors[spoiled].float()):
        with pytest.raises(ValueError, match=f"add_covariance_noise: {spoiled} is"):
            add_covariance_noise(
                means, *tensors_of({**tensors, spoiled: wrong}), lr=0.5, noise_scale=2.0
            )
    assert not called
