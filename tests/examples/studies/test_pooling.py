"""One second moment per point: what it is, whom it touches, and what it survives."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from studies.scenes.parts.pooling import Pooling
from torch import Tensor
from trainers import (
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    train,
    upgraded,
)

from opt3dgs_optim import Course

TOTAL = 60
GEOMETRY = ("means", "scales", "quats")
BETAS, EPS = (0.9, 0.999), 1e-15


def _reference(start: Tensor, gradients: list[Tensor], lr: float) -> tuple[np.ndarray, np.ndarray]:
    """Adam in float64 whose second moments are averaged over each row after every step."""
    x = start.double().numpy().copy()
    m, v = np.zeros_like(x), np.zeros_like(x)
    for t, gradient in enumerate(gradients, 1):
        g = gradient.double().numpy()
        m = BETAS[0] * m + (1 - BETAS[0]) * g
        v = BETAS[1] * v + (1 - BETAS[1]) * g * g
        corrected = np.sqrt(v / (1 - BETAS[1] ** t)) + EPS
        x -= lr * m / (1 - BETAS[0] ** t) / corrected
        v = np.repeat(v.mean(axis=1, keepdims=True), v.shape[1], axis=1)
    return x, v


@pytest.mark.parametrize("fused", [None, True])
def test_it_is_adam_with_the_mean_of_the_second_moments(fused: bool | None) -> None:
    splats = make_splats(9)
    start = {name: param.detach().clone() for name, param in splats.items()}
    phases = only(TOTAL, Pooling())
    optimizers = phases.upgrade(gsplat_optimizers(splats, fused=fused))
    plain = {name: torch.nn.Parameter(value.clone()) for name, value in start.items()}
    adam = gsplat_optimizers(plain, fused=fused)
    generator = torch.Generator().manual_seed(3)
    gradients: dict[str, list[Tensor]] = {name: [] for name in splats}
    for _ in range(40):
        phases.observe(0.1)
        for name, param in splats.items():
            size = 10.0 ** torch.randint(-3, 2, param.shape, generator=generator)
            param.grad = size * torch.randn(param.shape, generator=generator)
            plain[name].grad = param.grad.clone()
            gradients[name].append(param.grad.clone())
            optimizers[name].step()
            adam[name].step()
    for name, param in splats.items():
        if name not in GEOMETRY:
            assert torch.equal(param, plain[name]), name
            continue
        lr = optimizers[name].param_groups[0]["lr"]
        x, v = _reference(start[name], gradients[name], lr)
        np.testing.assert_allclose(param.detach().numpy(), x, rtol=2e-5, atol=2e-6)
        moment = optimizers[name].state[param]["exp_avg_sq"]
        np.testing.assert_allclose(moment.numpy(), v, rtol=2e-5)
        assert moment.shape == param.shape
        assert not torch.allclose(param, plain[name])


def test_a_step_has_the_direction_of_the_mean_gradient() -> None:
    """Whatever the axes: Adam alone turns it towards the diagonal, and a rotation changes it."""
    generator = torch.Generator().manual_seed(0)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]
    axes = torch.tensor([1.0, 1e-2, 1e-4], dtype=torch.float64)
    cosines: dict[str, float] = {}
    for kind, pooling in (("adam", []), ("pooled", [Pooling()])):
        param = torch.nn.Parameter(torch.zeros(50, 3, dtype=torch.float64))
        phases = only(TOTAL, *pooling)
        optimizer = phases.upgrade({"means": torch.optim.Adam([param], lr=1e-3, eps=EPS)})["means"]
        draws = torch.Generator().manual_seed(1)
        before = param.detach().clone()
        for _ in range(60):
            phases.observe(0.1)
            noise = 0.1 * torch.randn(50, 3, generator=draws, dtype=torch.float64)
            param.grad = ((1.0 + noise) * axes) @ rotation.T
            before = param.detach().clone()
            optimizer.step()
        step, mean = param.detach() - before, -optimizer.state[param]["exp_avg"]
        cosines[kind] = float(torch.cosine_similarity(step, mean, dim=1).min())
    assert cosines["pooled"] > 1 - 1e-4
    assert cosines["adam"] < 0.95


def test_an_axis_without_evidence_does_not_make_full_steps() -> None:
    """The regulariser's pull on an axis that no view constrains: the case it is made for."""
    moved: dict[str, Tensor] = {}
    for kind, pooling in (("adam", []), ("pooled", [Pooling()])):
        param = torch.nn.Parameter(torch.zeros(20, 3))
        phases = only(TOTAL, *pooling)
        optimizer = phases.upgrade({"means": torch.optim.Adam([param], lr=1e-3, eps=EPS)})["means"]
        draws = torch.Generator().manual_seed(1)
        for _ in range(TOTAL):
            phases.observe(0.1)
            param.grad = torch.randn(20, 3, generator=draws)  # what the views say, back and forth
            param.grad[:, 2] = 1e-6  # the regulariser alone
            optimizer.step()
        moved[kind] = param.detach()[:, 2].abs().mean()
    assert moved["adam"] == pytest.approx(TOTAL * 1e-3, rel=0.01)  # full steps
    assert moved["pooled"] < 0.005  # but for the first, which is Adam's own


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_every_trainers_names_are_pooled(make: Any) -> None:
    pooling = Pooling(("xyz", "scales"))
    assert pooling.names == ("means", "scales")
    splats, phases, optimizers = upgraded(TOTAL, pooling, make=make)
    train(splats, optimizers, phases, 0, 5)
    for name, param in splats.items():
        moment = state_of(optimizers, param)["exp_avg_sq"].reshape(len(param), -1)
        equal = bool((moment == moment[:, :1]).all())
        assert equal == (name in ("means", "scales", "opacities")), name


def test_a_training_that_began_without_it_is_pooled_from_the_next_step() -> None:
    splats = make_splats()
    stock = gsplat_optimizers(splats)
    train(splats, stock, None, 0, 10)
    mean = stock["scales"].state[splats["scales"]]["exp_avg_sq"].mean(1)
    phases = only(TOTAL, Pooling())
    optimizers = phases.upgrade(stock)
    train(splats, optimizers, phases, 10, 11)
    pooled = optimizers["scales"].state[splats["scales"]]["exp_avg_sq"]
    assert (pooled == pooled[:, :1]).all()
    assert (pooled[:, 0] >= 0.99 * mean).all()


def test_amsgrads_maxima_are_pooled_too() -> None:
    splats, phases, optimizers = upgraded(TOTAL, Pooling(), amsgrad=True)
    train(splats, optimizers, phases, 0, 5)
    state = optimizers["quats"].state[splats["quats"]]
    for key in ("exp_avg_sq", "max_exp_avg_sq"):
        assert (state[key] == state[key][:, :1]).all(), key


@pytest.mark.parametrize("shape", [(0, 3), (4,), (3, 1), (2, 15, 3), ()], ids=str)
def test_empty_and_odd_shapes(shape: tuple[int, ...]) -> None:
    moment = torch.rand(shape)
    state = {"exp_avg_sq": moment.clone()}
    Pooling().after({}, torch.zeros(()), state, Course())
    assert state["exp_avg_sq"].shape == shape
    if moment.dim() > 1 and moment.numel():
        mean = moment.reshape(shape[0], -1).mean(1)
        torch.testing.assert_close(state["exp_avg_sq"].reshape(shape[0], -1)[:, -1], mean)
    else:
        assert torch.equal(state["exp_avg_sq"], moment)
    Pooling().after({}, torch.zeros(()), {}, Course())
