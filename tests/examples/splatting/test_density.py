"""MCMC density control: the paper's equation, the edits of optimizer state, the schedule."""

from __future__ import annotations

import copy
import importlib.util
import math
from collections.abc import Mapping
from typing import Any

import pytest
import torch
from splatting.density import MCMCDensityControl, add_noise, regularisers
from splatting.gaussians import gaussians_from_points
from splatting.relocation import relocated_values


def _gaussians(count: int, dtype: torch.dtype = torch.float32, dead: int = 0):
    generator = torch.Generator().manual_seed(2)
    points, colors = (torch.rand(count, 3, generator=generator, dtype=dtype) for _ in range(2))
    gaussians = gaussians_from_points(points, colors, sh_degree=1)
    logits = gaussians["opacities"].data
    logits.copy_(torch.randn(count, generator=generator, dtype=dtype))
    logits[:dead] = -8.0  # opacity 3e-4
    return gaussians


def _optimizers(gaussians: Mapping[str, torch.nn.Parameter], steps: int = 1):
    optimizers = {
        name: torch.optim.Adam([{"params": parameter, "lr": 1e-3, "name": name}], eps=1e-15)
        for name, parameter in gaussians.items()
    }
    for name, parameter in gaussians.items() if steps else ():
        parameter.grad = torch.ones_like(parameter)
        optimizers[name].step()
    return optimizers


def _control(**overrides: Any) -> MCMCDensityControl:
    options: dict[str, Any] = {"cap_max": 10_000, "generator": torch.Generator().manual_seed(9)}
    options |= overrides
    return MCMCDensityControl(**options)


def test_new_opacities_are_clipped_to_the_dead_limit():
    gaussians = _gaussians(30, dead=29)
    gaussians["opacities"].data[29] = math.log(0.02 / 0.98)
    _control(cap_max=0).step(600, gaussians, _optimizers(gaussians))
    # 0.02 among 30 would be 0.00067 each
    torch.testing.assert_close(
        torch.sigmoid(gaussians["opacities"].detach()), torch.full((30,), 0.005)
    )
    saturated = _gaussians(2)
    saturated["opacities"].data.fill_(60.0)
    _control(growth=1.5).step(600, saturated, _optimizers(saturated))
    assert torch.isfinite(saturated["opacities"]).all()


def test_growth_stops_at_the_cap_and_never_shrinks():
    gaussians = _gaussians(100)
    optimizers = _optimizers(gaussians)
    control = _control(cap_max=107, refine_every=10)
    totals = []
    for i in range(501, 541):
        control.step(i, gaussians, optimizers)
        totals.append(len(gaussians["means"]))
    assert totals == [100] * 9 + [105] * 10 + [107] * 21
    _control(cap_max=50).step(600, gaussians, optimizers)
    assert len(gaussians["means"]) == 107


def test_schedule_is_gsplats():
    control = _control(refine_start=10, refine_stop=50, refine_every=10, cap_max=0)
    refined = []
    for i in range(80):
        gaussians = _gaussians(30, dead=1)
        refined += [i] * control.step(i, gaussians, _optimizers(gaussians, steps=0))
    assert refined == [20, 30, 40]  # after the start, before the stop


@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("dead", [False, True])
def test_none_and_one(count, dead):
    gaussians = _gaussians(1, dead=int(dead))
    for name in gaussians:
        gaussians[name] = torch.nn.Parameter(gaussians[name].data[:count])
    assert _control(growth=2.0).step(600, gaussians, _optimizers(gaussians)) == 0
    assert len(gaussians["means"]) == 2 * count
    assert torch.isfinite(gaussians["means"]).all()


def test_a_seeded_generator_repeats_and_leaves_the_global_one_alone():
    torch.manual_seed(0)
    results = []
    for _ in range(2):
        gaussians = _gaussians(60, dead=7)
        _control().step(600, gaussians, _optimizers(gaussians))
        results.append(gaussians)
    for name, parameter in results[0].items():
        assert torch.equal(parameter, results[1][name])
    drawn = torch.rand(3)
    torch.manual_seed(0)
    assert torch.equal(drawn, torch.rand(3))


@pytest.mark.parametrize("iterations", [100, 1500, 3000, 7000, 30_000, 90_000])
def test_for_run_reaches_the_cap(iterations):
    control = MCMCDensityControl.for_run(iterations, 2000, num_points=300)
    assert control.refine_stop == round(iterations * 25_000 / 30_000)
    assert 20 <= control.refine_every <= 100
    count = 300
    for i in range(iterations):
        if control.refine_start < i < control.refine_stop and i % control.refine_every == 0:
            count = min(2000, int(control.growth * count))
    assert count >= 1980  # the growth rounds down, which may cost 1 % of the cap


def test_for_run_at_full_length_is_stock():
    stock, fitted = MCMCDensityControl(7), MCMCDensityControl.for_run(30_000, 7, num_points=7)
    for field in ("refine_start", "refine_stop", "refine_every", "growth", "min_opacity"):
        assert getattr(stock, field) == getattr(fitted, field), field
    short = MCMCDensityControl.for_run(1500, 2000, num_points=2000)
    assert (short.refine_start, short.refine_stop, short.refine_every) == (25, 1250, 20)
    assert short.growth == 1.05


def test_noise_has_the_gaussians_own_covariance_and_fades_with_opacity():
    """Sigma @ eta has the covariance Sigma^2; eq. 2's gate, at opacities on both sides of it."""
    count, lr = 60_000, 1e-6
    quat, scales = torch.tensor([0.8, 0.4, -0.2, 0.4]), torch.tensor([0.5, -0.5, -2.0])
    rotation = torch.tensor(  # of that quaternion, by hand: R = (w^2 - u.u) I + 2 u u^T + 2 w [u]
        [[0.6, -0.8, 0.0], [0.48, 0.36, -0.8], [0.64, 0.48, 0.6]]
    )
    covariance = rotation @ torch.diag((2 * scales).exp()) @ rotation.T
    for opacity in (0.001, 0.02):
        gaussians = {
            "means": torch.nn.Parameter(torch.zeros(count, 3)),
            "quats": torch.nn.Parameter(2 * quat.repeat(count, 1)),
            "scales": torch.nn.Parameter(scales.repeat(count, 1)),
            "opacities": torch.nn.Parameter(torch.full((count,), opacity).logit()),
        }
        add_noise(gaussians, lr, torch.Generator().manual_seed(0))
        moved = gaussians["means"].detach() / (lr * 5e5)
        gate = 1 / (1 + math.exp(-100 * (0.005 - opacity)))
        expected = gate**2 * covariance @ covariance
        # 5 standard errors of a variance of 60,000 draws
        tolerance = 5 * (2 / count) ** 0.5 * float(expected.diagonal().max())
        torch.testing.assert_close(moved.T @ moved / count, expected, rtol=0, atol=tolerance)


def test_regularisers():
    gaussians = _gaussians(10)
    opacities, scales = gaussians["opacities"].detach(), gaussians["scales"].detach()
    expected = 0.01 * torch.sigmoid(opacities).mean() + 0.01 * scales.exp().mean()
    value = regularisers(gaussians)
    torch.testing.assert_close(value.detach(), expected)
    value.backward()
    assert gaussians["opacities"].grad is not None


@pytest.mark.skipif(importlib.util.find_spec("gsplat") is None, reason="gsplat is not installed")
def test_same_draws_give_the_same_bits_as_gsplats_strategy(monkeypatch):
    # gsplat looks for nvcc at import and would build its extension; its relocation is CUDA only.
    monkeypatch.setattr("torch.utils.cpp_extension._find_cuda_home", lambda: None)
    ops = pytest.importorskip("gsplat.strategy.ops", exc_type=ImportError)
    mcmc = pytest.importorskip("gsplat.strategy.mcmc", exc_type=ImportError)

    def compute_relocation(opacities, scales, ratios, binoms):
        return relocated_values(opacities, scales, ratios)

    monkeypatch.setattr(ops, "compute_relocation", compute_relocation)
    ours = _gaussians(500, dead=60)
    theirs = copy.deepcopy(ours)
    our_optimizers, their_optimizers = _optimizers(ours), _optimizers(theirs)
    strategy = mcmc.MCMCStrategy(cap_max=540, noise_lr=0.0)
    state = strategy.initialize_state()
    control = MCMCDensityControl(540)  # torch's global generator, like gsplat
    for iteration in (600, 700, 800):
        torch.manual_seed(iteration)
        control.step(iteration, ours, our_optimizers)
        torch.manual_seed(iteration)
        strategy._relocate_gs(theirs, their_optimizers, state["binoms"])
        strategy._add_new_gs(theirs, their_optimizers, state["binoms"])
        for name in ours:
            assert torch.equal(ours[name], theirs[name]), (iteration, name)
            ours_state = our_optimizers[name].state[ours[name]]
            theirs_state = their_optimizers[name].state[theirs[name]]
            assert list(ours_state) == list(theirs_state)
            for key, value in ours_state.items():
                assert torch.equal(value, theirs_state[key]), (iteration, name, key)
        for gaussians, optimizers in ((ours, our_optimizers), (theirs, their_optimizers)):
            for name, parameter in gaussians.items():
                parameter.grad = torch.full_like(parameter, 0.5)
                optimizers[name].step()
