"""AWSGLD by itself: torch's Adam where nothing is on, eq. 15 where something is; its contract."""

from __future__ import annotations

import copy
import re
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from gaussians import through_a_file
from oracles import adam_steps
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import AWSGLD, EnergyHistogram, IsotropicNoise, PhaseScheduler, PositionNoise

SHAPES = [(5, 3), (5, 1, 3), (5,), (), (0, 3), (70_000, 3)]
OPTIONS: list[dict[str, Any]] = [
    {},
    {"betas": (0.5, 0.99), "eps": 1e-15},
    {"weight_decay": 0.1},
]


def parameters(shapes: Any = SHAPES) -> list[Parameter]:
    generator = torch.Generator().manual_seed(0)
    return [Parameter(torch.randn(shape, generator=generator)) for shape in shapes]


def set_gradients(params: list[Parameter], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for param in params:
        param.grad = torch.randn(param.shape, generator=generator)


# -- Adam ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("with_parts", [False, True], ids=["nothing on", "a warm-up"])
def test_is_torch_adam_bit_for_bit_where_nothing_is_on(
    options: dict[str, Any], with_parts: bool
) -> None:
    """Torch's step and the package's own, which is made where there is a part; state too."""
    ours, theirs = parameters(), parameters()
    histogram = EnergyHistogram(warmup=1000) if with_parts else None
    a = AWSGLD(ours, lr=0.01, histogram=histogram, **options)
    b = torch.optim.Adam(theirs, lr=0.01, foreach=False, **options)
    for step in range(8):
        set_gradients(ours, step)
        set_gradients(theirs, step)
        if histogram is not None:
            histogram.observe(0.1 + 0.01 * step)
        a.step()
        b.step()
    for x, y in zip(ours, theirs, strict=True):
        assert torch.equal(x, y)
        for key in ("step", "exp_avg", "exp_avg_sq"):
            assert torch.equal(a.state[x][key], b.state[y][key])


@pytest.mark.parametrize("named", [False, True])
def test_nu_multiplies_adams_output(named: bool) -> None:
    """Eq. 15 against a float64 Adam with a factor on every step; nu negative at times."""
    start = np.random.default_rng(0).normal(size=(4, 3))
    param = Parameter(torch.tensor(start))
    histogram = EnergyHistogram(8, (0.0, 1.0), temperature=60.0, warmup=5)
    group = {"params": [param], **({"name": "means"} if named else {})}
    optimizer = AWSGLD([group], lr=0.05, histogram=histogram)
    rng, grads, factors = np.random.default_rng(1), [], []
    for _ in range(40):
        grads.append(rng.normal(size=(4, 3)))
        param.grad = torch.tensor(grads[-1])
        factors.append(float(histogram.observe(float(rng.uniform(0.2, 0.9)))))
        optimizer.step()
    assert min(factors) < 0 < max(factors)
    expected = adam_steps(start, grads, 0.05, factors)
    np.testing.assert_allclose(param.detach().numpy(), expected, rtol=1e-9, atol=1e-9)


def moved_by(optimizer: AWSGLD, x: Parameter, gradient: list[float]) -> list[float]:
    x.grad, before = torch.tensor(gradient, dtype=x.dtype), x.detach().clone()
    optimizer.step()
    return (before - x.detach()).tolist()


def test_the_plain_drift_is_rate_times_nu_times_gradient() -> None:
    """Without moments: a gradient is forgotten after its step, and a NaN moves nothing."""
    x, histogram, nu = Parameter(torch.zeros(2).double()), EnergyHistogram(warmup=4), 1.0
    walk = AWSGLD([x], lr=0.1, preconditioner="none", histogram=histogram)
    for energy in np.random.default_rng(0).normal(size=20):
        nu = float(histogram.observe(float(energy)))
        assert moved_by(walk, x, [3.0, -1e9]) == pytest.approx([0.3 * nu, -1e8 * nu], rel=1e-6)
        assert moved_by(walk, x, [0.0, float("nan")]) == [0.0, 0.0]
    assert abs(nu - 1) > 0.01
    decayed = AWSGLD([x], lr=0.1, preconditioner="none", weight_decay=0.5)
    x.data.fill_(2.0)
    assert moved_by(decayed, x, [1.0, 0.0]) == pytest.approx([0.2, 0.1])


@pytest.mark.parametrize("preconditioner", ["adam", "none"])
def test_noise_comes_after_the_step_and_is_not_scaled_by_nu(preconditioner: Any) -> None:
    """Of temperature T it is sqrt(2 lr T) times a standard normal draw."""
    x, y = Parameter(torch.ones(6, 2)), Parameter(torch.ones(6, 2))
    noise = IsotropicNoise(temperature=0.5, generator=torch.Generator().manual_seed(5))
    histograms = [EnergyHistogram(8, (0.0, 1.0), temperature=9.0, warmup=0) for _ in "ab"]
    both: dict[str, Any] = {"lr": 0.02, "preconditioner": preconditioner}
    with_noise = AWSGLD([x], noise=noise, histogram=histograms[0], **both)
    without = AWSGLD([y], histogram=histograms[1], **both)
    for histogram in histograms:
        for energy in (0.3, 0.3, 0.4, 0.4, 0.4, 0.3):
            histogram.observe(energy)
    assert abs(float(histograms[0].multiplier) - 1) > 0.1
    x.grad, y.grad = torch.ones(6, 2), torch.ones(6, 2)
    with_noise.step()
    without.step()
    eta = torch.randn(6, 2, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(x - y, (2 * 0.02 * 0.5) ** 0.5 * eta, rtol=1e-4, atol=1e-6)


def test_position_noise_moves_the_positions_only() -> None:
    """Of Gaussians that are nearly transparent, so that it moves them."""
    params = {
        "xyz": torch.zeros(4, 3),
        "scaling": torch.zeros(4, 3),
        "rotation": torch.tensor([[1.0, 0, 0, 0]] * 4),
        "opacity": torch.full((4, 1), -9.0),
    }
    groups = [{"params": [Parameter(p.clone())], "name": name} for name, p in params.items()]
    optimizer = AWSGLD(groups, lr=0.1, noise=PositionNoise(1.0))
    for group in groups:
        group["params"][0].grad = torch.zeros_like(group["params"][0])
    optimizer.step()
    for group in groups:
        moved = not torch.equal(group["params"][0], params[group["name"]])
        assert moved == (group["name"] == "xyz")


# -- energies --------------------------------------------------------------------------------------


@pytest.mark.parametrize("on", [False, True])
def test_a_closure_is_evaluated_once_and_its_value_is_returned_and_taken(on: bool) -> None:
    x = Parameter(torch.tensor([3.0]))
    histogram = EnergyHistogram(8, (0.0, 10.0), temperature=0.1, warmup=0) if on else None
    optimizer, calls = AWSGLD([x], lr=0.1, histogram=histogram), []

    def closure() -> Tensor:
        calls.append(1)
        optimizer.zero_grad()
        loss = (x**2).sum()
        loss.backward()
        return loss

    with torch.no_grad():  # as in a trainer's; the closure has gradients
        assert float(optimizer.step(closure).detach()) == 9.0
    assert x.item() == pytest.approx(2.9)
    assert len(calls) == 1
    if histogram is not None:
        assert histogram.num_observed == 1
        assert optimizer.step(lambda: None) is None
        assert optimizer.step(lambda: 4.0) == 4.0  # a number is one, too
        assert histogram.num_observed == 2
        with pytest.raises(ValueError, match="one real number is needed"):
            optimizer.step(lambda: torch.ones(2))


def test_without_any_energy_it_says_so_once() -> None:
    x = Parameter(torch.ones(2))
    optimizer = AWSGLD([x], lr=0.01, histogram=EnergyHistogram())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for _ in range(4):
            x.grad = torch.ones(2)
            optimizer.step()
    assert len(told) == 1
    cure = r"no energy .*phases\.observe\(loss\) .*histogram\.observe\(loss\) or step\(closure\)"
    assert re.search(cure, str(told[0].message))
    assert told[0].filename == __file__


# -- state -----------------------------------------------------------------------------------------


def made(params: list[Parameter], preconditioner: Any = "adam") -> AWSGLD:
    noise = IsotropicNoise(0.5, generator=torch.Generator().manual_seed(1))
    histogram = EnergyHistogram(warmup=4)
    optimizer = AWSGLD(
        params, 0.01, histogram=histogram, noise=noise, preconditioner=preconditioner
    )
    return optimizer


def go(optimizer: AWSGLD, params: list[Parameter], first: int, last: int) -> list[Tensor]:
    assert optimizer.histogram is not None
    for step in range(first, last):
        set_gradients(params, step)
        optimizer.histogram.observe(0.1 + 0.03 * (step * step % 7))
        optimizer.step()
    return [param.detach().clone() for param in params]


@pytest.mark.parametrize("road", ["torch.save", "deepcopy"])
@pytest.mark.parametrize("preconditioner", ["adam", "none"])
def test_it_resumes_bit_for_bit(road: str, preconditioner: str) -> None:
    params = parameters([(5, 3), ()])
    optimizer = made(params, preconditioner)
    go(optimizer, params, 0, 20)
    noise: Any = optimizer.training.parts[1]
    if road == "torch.save":
        others = [Parameter(p.detach().clone()) for p in params]
        twin = made(others, preconditioner)
        twin.load_state_dict(through_a_file(optimizer.state_dict()))
        generator: Any = twin.training.parts[1]
        generator.generator.set_state(noise.generator.get_state())
    else:
        twin = copy.deepcopy(optimizer)
    others = [param for group in twin.param_groups for param in group["params"]]
    assert twin.histogram is not optimizer.histogram
    expected = go(optimizer, params, 20, 40)
    for ours, theirs in zip(go(twin, others, 20, 40), expected, strict=True):
        assert torch.equal(ours, theirs)
    assert twin.training.iteration == optimizer.training.iteration == 39


# -- groups, schedules, options --------------------------------------------------------------------


def test_groups_may_be_added_and_are_stepped_with_nu() -> None:
    params, histogram = parameters([(5, 3), (2,)]), EnergyHistogram(warmup=4)
    optimizer = AWSGLD(params[:1], lr=0.01, histogram=histogram, preconditioner="none")
    optimizer.add_param_group({"params": params[1:], "lr": 0.5})
    for energy in np.random.default_rng(0).normal(size=12):
        histogram.observe(float(energy))
    assert moved_by(optimizer, params[1], [2.0, 0.0])[0] == pytest.approx(
        float(histogram.multiplier), rel=1e-5
    )
    half = Parameter(torch.zeros(3, dtype=torch.float16))
    for wrong, message in (
        ({"params": [half]}, "float16"),
        ({"params": [Parameter(torch.zeros(3))], "lr": torch.tensor(0.1)}, "tensor as lr"),
        ({"params": [Parameter(torch.zeros(3))], "amsgrad": True}, "amsgrad=True"),
    ):
        with pytest.raises(ValueError, match=message):
            optimizer.add_param_group(wrong)
        assert len(optimizer.param_groups) == 2
    moved_by(optimizer, params[1], [1.0, 1.0])


def test_wrong_options_are_named() -> None:
    def build(**options: Any) -> AWSGLD:
        return AWSGLD([Parameter(torch.zeros(2, 2))], **options)

    for options, error, said in (
        ({"preconditioner": "rms"}, ValueError, "preconditioner='rms', but 'adam' or 'none'"),
        ({"histogram": IsotropicNoise(1.0)}, TypeError, "but an EnergyHistogram is needed"),
        ({"noise": EnergyHistogram()}, TypeError, "but IsotropicNoise or PositionNoise is needed"),
    ):
        with pytest.raises(error, match=re.escape(said)):
            build(**options)


def test_a_histogram_serves_one_optimizer_or_one_training() -> None:
    histogram, x = EnergyHistogram(), Parameter(torch.zeros(2))
    with pytest.raises(ValueError, match="tensor as lr"):
        AWSGLD([x], lr=torch.tensor(0.1), histogram=histogram)  # pyright: ignore
    AWSGLD([x], histogram=histogram)  # a constructor that failed has not taken it
    with pytest.raises(ValueError, match="serves another training already"):
        AWSGLD([x], histogram=histogram)
    with pytest.raises(ValueError, match="serves another training already"):
        PhaseScheduler(10, parts=[histogram])
