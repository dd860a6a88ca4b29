"""AWSGLD: torch's Adam where nu is off, the sampler's law where it samples."""

from __future__ import annotations

import copy
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from oracles import adam_steps
from simulated_device import SimulatedDevice
from torch import Tensor
from trainers import gaussians

from opt3dgs_optim import AWSGLD, EnergyHistogram, IsotropicNoise, PositionNoise

PATHS = [
    {},
    {"foreach": True},
    {"foreach": False},
    {"fused": True},
    {"amsgrad": True},
    {"weight_decay": 0.1},
    {"maximize": True},
    {"fused": True, "amsgrad": True, "weight_decay": 0.1},
    {"foreach": True, "maximize": True, "weight_decay": 0.1},
    {"decoupled_weight_decay": True, "weight_decay": 0.1},
]
SHAPES = [(5, 3), (5, 1, 3), (5,), ()]


def parameters(seed: int = 0) -> list[torch.nn.Parameter]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]


def set_gradients(params: list[torch.nn.Parameter], seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for param in params:
        param.grad = torch.randn(param.shape, generator=generator)


class FixedNu(EnergyHistogram):
    """A histogram that always says the same."""

    def __init__(self, nu: float) -> None:
        super().__init__()
        self.nu = nu

    def factor(self, group: object, course: object = None) -> float:  # type: ignore[override]
        """The step's factor."""
        return self.nu


@pytest.mark.parametrize("path", PATHS, ids=str)
@pytest.mark.parametrize("histogram", ["none", "warm-up", "a computed nu of one"])
def test_is_torch_adam_bit_for_bit_with_nu_off(path: dict, histogram: str) -> None:
    ours, theirs = parameters(), parameters()
    made = {"warm-up": EnergyHistogram(warmup=1000), "a computed nu of one": FixedNu(1.0)}
    source = made.get(histogram)
    if source is not None:  # beside a histogram nothing is maximised
        path = {**path, "maximize": False}
    a = AWSGLD(ours, lr=0.01, histogram=source, **path)
    b = torch.optim.Adam(theirs, lr=0.01, **path)
    for step in range(30):
        set_gradients(ours, step)
        set_gradients(theirs, step)
        if source is not None:
            source.observe(0.1)
        a.step()
        b.step()
    for x, y in zip(ours, theirs, strict=True):
        assert torch.equal(x, y)
        for key in b.state[y]:
            assert torch.equal(a.state[x][key], b.state[y][key])


@pytest.mark.parametrize("path", [{}, {"foreach": True}, {"fused": True}], ids=str)
def test_nu_multiplies_adams_output(path: dict) -> None:
    """Against a float64 Adam with a factor on every step; nu negative at times."""
    start = np.random.default_rng(0).normal(size=(4, 3))
    param = torch.nn.Parameter(torch.tensor(start))
    histogram = EnergyHistogram(8, (0.0, 1.0), temperature=60.0, warmup=5)
    optimizer = AWSGLD([param], lr=0.05, histogram=histogram, **path)
    rng, grads, factors = np.random.default_rng(1), [], []
    for _ in range(60):
        grads.append(rng.normal(size=(4, 3)))
        param.grad = torch.tensor(grads[-1])
        factors.append(float(histogram.observe(float(rng.uniform(0.2, 0.9)))))
        optimizer.step()
    assert min(factors) < 0 < max(factors)
    expected = adam_steps(start, grads, 0.05, factors)
    np.testing.assert_allclose(param.detach().numpy(), expected, rtol=1e-9, atol=1e-9)


def test_energy_comes_from_the_closure() -> None:
    x = torch.nn.Parameter(torch.tensor([3.0]))
    histogram = EnergyHistogram(8, (0.0, 10.0), temperature=0.1, warmup=0)
    optimizer = AWSGLD([x], lr=0.1, histogram=histogram)

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = (x**2).sum()
        loss.backward()
        return loss

    assert float(optimizer.step(closure).detach()) == 9.0
    assert histogram.num_observed == 1


@pytest.mark.parametrize("path", [{}, {"foreach": True}, {"fused": True}], ids=str)
def test_non_finite_energy_skips_the_step(path: dict) -> None:
    params = parameters()
    histogram = EnergyHistogram.paper(warmup=0)
    optimizer = AWSGLD(params, lr=0.1, histogram=histogram, noise=IsotropicNoise(std=1.0), **path)
    set_gradients(params, 0)
    histogram.observe(0.1)
    optimizer.step()
    before = [p.detach().clone() for p in params]
    state = copy.deepcopy(optimizer.state_dict())
    histogram.observe(float("nan"))
    optimizer.step()
    assert all(torch.equal(p, q) for p, q in zip(params, before, strict=True))
    for a, b in zip(state["state"].values(), optimizer.state_dict()["state"].values(), strict=True):
        assert all(torch.equal(a[key], b[key]) for key in a)


def test_without_any_energy_it_says_so_once() -> None:
    params = parameters()
    optimizer = AWSGLD(params, lr=0.01, histogram=EnergyHistogram())
    set_gradients(params, 0)
    with pytest.warns(UserWarning, match="no energy has been observed yet"):
        optimizer.step()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        optimizer.step()


def test_isotropic_noise_has_the_stated_deviation() -> None:
    torch.manual_seed(0)
    x = torch.nn.Parameter(torch.zeros(20_000))
    optimizer = AWSGLD([x], lr=0.25, noise=IsotropicNoise(temperature=2.0))
    x.grad = torch.zeros_like(x)
    optimizer.step()
    # sqrt(2 lr T) = 1; standard error of a deviation from 20,000 draws: 0.005
    assert float(x.detach().std()) == pytest.approx(1.0, abs=0.025)


def test_covariance_noise_moves_the_positions_only() -> None:
    torch.manual_seed(0)
    means, scales = [torch.nn.Parameter(torch.zeros(50, 3)) for _ in "ab"]
    gaussians = {"scales": scales, "quats": torch.ones(50, 4), "opacities": torch.full((50,), -9.0)}
    optimizer = AWSGLD(
        [{"params": [means], "name": "means"}, {"params": [scales], "name": "scales"}],
        lr=0.1,
        noise=PositionNoise(gaussians, scale=1.0),
    )
    means.grad, scales.grad = torch.zeros(50, 3), torch.zeros(50, 3)
    optimizer.step()
    assert float(means.detach().std()) == pytest.approx(
        0.1 * 0.62, rel=0.3
    )  # gate sigmoid(.5) = .62
    assert not scales.any()


def test_plain_drift_samples_a_gaussian() -> None:
    """SGLD on x^2 / 2 at temperature T samples N(0, T / (1 - lr / 2)) exactly (AR(1) process)."""
    torch.manual_seed(0)
    x = torch.nn.Parameter(torch.zeros(4000))
    lr, temperature = 0.2, 0.5
    optimizer = AWSGLD(
        [x], lr=lr, preconditioner="none", noise=IsotropicNoise(temperature=temperature)
    )
    moments = []
    for step in range(120):
        x.grad = x.detach().clone()
        optimizer.step()
        if step >= 60 and step % 15 == 0:
            moments.append(x.detach().square().mean())
    expected = temperature / (1 - lr / 2)
    # relative standard error of a variance from 16,000 nearly independent draws: 1.1 %
    assert float(torch.stack(moments).mean()) == pytest.approx(expected, rel=0.04)
    # kurtosis of a Gaussian
    z = x.detach() / x.detach().std()
    assert float((z**4).mean()) == pytest.approx(3.0, abs=0.4)


def test_plain_drift_samples_a_double_well() -> None:
    """Both wells, and the density between them, at a small step."""
    torch.manual_seed(1)
    height, temperature, lr = 1.0, 1.0, 0.01
    x = torch.nn.Parameter(torch.linspace(-1.5, 1.5, 8000, dtype=torch.float64))
    optimizer = AWSGLD(
        [x], lr=lr, preconditioner="none", noise=IsotropicNoise(temperature=temperature)
    )
    for _ in range(600):
        x.grad = 4 * height * x.detach() * (x.detach() ** 2 - 1)
        optimizer.step()
    grid = torch.linspace(-2.5, 2.5, 2001, dtype=torch.float64)
    density = torch.exp(-height * (grid**2 - 1) ** 2 / temperature)
    cdf = density.cumsum(0) / density.sum()
    draws = x.detach().sort().values
    empirical = torch.searchsorted(draws, grid).double() / draws.numel()
    # Kolmogorov-Smirnov of 8,000 draws: 1 % critical value 0.018; 0.01 for the step's own bias
    assert float((empirical - cdf).abs().max()) < 0.03


def test_plain_drift_takes_nu() -> None:
    x = torch.nn.Parameter(torch.tensor([1.0], dtype=torch.float64))
    histogram = FixedNu(-0.5)
    optimizer = AWSGLD([x], lr=0.1, preconditioner="none", histogram=histogram)
    x.grad = torch.tensor([3.0], dtype=torch.float64)
    histogram.observe(0.0)
    optimizer.step()
    assert x.item() == pytest.approx(1.0 + 0.1 * 0.5 * 3.0)


def test_optimizers_may_share_a_histogram() -> None:
    histogram = EnergyHistogram(warmup=4)
    params = parameters()
    optimizers = [AWSGLD([p], lr=0.01, histogram=histogram) for p in params]
    for step in range(8):
        set_gradients(params, step)
        histogram.observe(0.1 + 0.01 * step)
        for optimizer in optimizers:
            optimizer.step()
    assert histogram.num_observed == 8


def test_a_second_group_takes_the_positions_noise_from_an_unnamed_one() -> None:
    """Of one group alone it is clear that it holds the positions."""
    means = torch.nn.Parameter(torch.zeros(4, 3, dtype=torch.float64))
    other = torch.nn.Parameter(torch.zeros(2))
    optimizer = AWSGLD([means], lr=0.1, noise=PositionNoise(gaussians(4), scale=1.0))
    moved = []
    for groups in (1, 2):
        if groups == 2:
            optimizer.add_param_group({"params": [other]})
        before = means.detach().clone()
        means.grad, other.grad = torch.zeros_like(means), torch.zeros_like(other)
        optimizer.step()
        moved.append(not torch.equal(means, before))
    assert moved == [True, False]


def by_adam(x: torch.nn.Parameter) -> torch.optim.Optimizer:
    return torch.optim.Adam([x], lr=0.01, betas=(0.8, 0.99), eps=1e-6)


def by_adams_drift(x: torch.nn.Parameter) -> torch.optim.Optimizer:
    return AWSGLD([x], lr=0.01, betas=(0.8, 0.99), eps=1e-6)


def by_plain_drift(x: torch.nn.Parameter) -> torch.optim.Optimizer:
    return AWSGLD([x], lr=0.01, preconditioner="none")


def begun(make: Any) -> tuple[torch.nn.Parameter, Any]:
    x = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))
    optimizer = make(x)
    x.grad = torch.tensor([1.0, 2.0, -4.0], dtype=torch.float64)
    optimizer.step()
    return x, optimizer


@pytest.mark.parametrize("groups", ["as they are", "with eps and betas of their own"])
@pytest.mark.parametrize("theirs", [by_adam, by_adams_drift, by_plain_drift])
def test_the_plain_drift_stays_one_whatever_the_checkpoint(theirs: Any, groups: str) -> None:
    """Its betas and eps are no options: those of a checkpoint of Adam would hold it still."""
    saved = begun(theirs)[1].state_dict()
    y = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))
    own = {"betas": (0.5, 0.99), "eps": 1e-8} if "own" in groups else {}
    optimizer = AWSGLD([{"params": [y], **own}], lr=0.01, preconditioner="none")
    if theirs is by_plain_drift:
        optimizer.load_state_dict(saved)
    else:
        with pytest.warns(UserWarning, match="another preconditioner.* it stays 'none'"):
            optimizer.load_state_dict(saved)
    y.grad = torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    before = y.detach().clone()
    optimizer.step()
    assert torch.allclose(y.detach(), before - 0.01 * y.grad, rtol=0, atol=1e-12)


def test_adams_drift_stays_one_after_a_checkpoint_of_the_plain_one() -> None:
    saved = begun(by_plain_drift)[1].state_dict()
    y = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))
    optimizer = by_adams_drift(y)
    with pytest.warns(UserWarning, match="another preconditioner.* it stays 'adam'"):
        optimizer.load_state_dict(saved)
    assert (optimizer.param_groups[0]["betas"], optimizer.param_groups[0]["eps"]) == (
        (0.8, 0.99),
        1e-6,
    )
    y.grad = torch.ones(3, dtype=torch.float64)
    optimizer.step()
    assert bool(((1.0 - y.detach()).abs() > 1e-4).all())


def test_options_of_a_stock_adam_are_loaded_as_torch_loads_them() -> None:
    saved = begun(by_adam)[1].state_dict()
    y = torch.nn.Parameter(torch.ones(3, dtype=torch.float64))
    optimizer = AWSGLD([y], lr=0.5)
    optimizer.load_state_dict(saved)
    group = optimizer.param_groups[0]
    assert (group["lr"], group["betas"], group["eps"]) == (0.01, (0.8, 0.99), 1e-6)


@pytest.mark.parametrize(
    "path", [{}, {"foreach": True}, {"fused": False, "foreach": False}], ids=str
)
def test_every_step_on_a_device_has_the_nu_of_its_energy(path: dict) -> None:
    """Paths that need a number on the host read it anew after each energy."""

    def steps(device: str) -> list[float]:
        draw, histogram = torch.Generator().manual_seed(0), EnergyHistogram(warmup=10)
        x = torch.nn.Parameter(torch.zeros(1, device=device))
        optimizer = AWSGLD([x], lr=1.0, betas=(0.0, 0.999), histogram=histogram, **path)
        made = []
        for _ in range(40):
            x.grad = torch.ones(1, device=device)
            histogram.observe((0.1 + 0.1 * torch.rand((), generator=draw)).to(device))
            before = float(x.detach()[0])
            optimizer.step()
            made.append(before - float(x.detach()[0]))
        return made

    expected = steps("cpu")
    assert max(expected) - min(expected) > 0.5
    with SimulatedDevice():
        assert steps("cuda:0") == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("made", ["noise", "a plain drift", "a histogram"])
def test_an_energy_that_is_not_finite_skips_the_step(made: str) -> None:
    """Whoever looks at it, noise and all; the next step, of which nothing is known, is made."""
    options: Any = {
        "noise": {"noise": IsotropicNoise(std=1.0)},
        "a plain drift": {"preconditioner": "none", "noise": IsotropicNoise(std=1.0)},
        "a histogram": {"histogram": EnergyHistogram()},
    }[made]
    x = torch.nn.Parameter(torch.ones(3))
    x.grad = torch.ones(3)
    optimizer = AWSGLD([x], lr=0.1, **options)
    optimizer.step(lambda: torch.tensor(float("nan")))
    assert torch.equal(x, torch.ones(3))
    if made == "a histogram":
        options["histogram"].observe(0.5)
    optimizer.step()
    assert not torch.equal(x, torch.ones(3))


@pytest.mark.parametrize("schedule", ["CyclicLR", "OneCycleLR"])
def test_schedules_that_write_betas_give_the_plain_drift_no_momentum(schedule: str) -> None:
    x = torch.nn.Parameter(torch.zeros(1))
    optimizer = AWSGLD([x], lr=0.1, preconditioner="none")
    made = {"CyclicLR": {"base_lr": 0.1, "max_lr": 0.2}, "OneCycleLR": {"max_lr": 0.1}}[schedule]
    more: Any = {"OneCycleLR": {"total_steps": 10}}.get(schedule, {})
    rates = getattr(torch.optim.lr_scheduler, schedule)(optimizer, **made, **more)
    for gradient in (1.0, -1.0, 1.0, -1.0):
        group, before = optimizer.param_groups[0], x.item()
        x.grad, written, rate = torch.tensor([gradient]), group["betas"], group["lr"]
        optimizer.step()
        assert (before - x.item()) / rate == pytest.approx(gradient, rel=1e-5)
        assert group["betas"] == written != (0.0, 0.999)  # the schedule's own, for its next step
        rates.step()


def test_a_plain_drift_of_float16_is_refused_where_it_would_stand_still() -> None:
    half = torch.nn.Parameter(torch.zeros(2, dtype=torch.float16))
    with pytest.raises(ValueError, match=r"AWSGLD: a parameter of torch.float16 .* fused=True"):
        AWSGLD([half], preconditioner="none")
    optimizer = AWSGLD([torch.nn.Parameter(torch.zeros(2))], preconditioner="none")
    with pytest.raises(ValueError, match="float16"):
        optimizer.add_param_group({"params": [half]})
    assert len(optimizer.param_groups) == 1
    AWSGLD([half], preconditioner="none", fused=True)
    AWSGLD([half])


def test_an_energy_that_is_not_finite_drops_one_step() -> None:
    """And not those after it for which nothing was observed."""
    x = torch.nn.Parameter(torch.ones(3))
    histogram = EnergyHistogram()
    optimizer = AWSGLD([x], lr=0.01, histogram=histogram)
    moved = []
    for energy in (0.1, float("nan"), None, None, 0.1):
        before = x.detach().clone()
        if energy is not None:
            histogram.observe(energy)
        x.grad = torch.ones_like(x)
        optimizer.step()
        moved.append(not torch.equal(x, before))
    assert moved == [True, False, True, True, True]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_plain_drift_forgets_a_large_gradient(dtype: torch.dtype) -> None:
    """And none is so large that it makes a NaN."""
    x = torch.nn.Parameter(torch.zeros(2, dtype=dtype))
    walk = AWSGLD([x], lr=1e-3, preconditioner="none")
    for large in (1e16, 1e21, 1e27):
        x.grad = torch.tensor([large, 1.0], dtype=dtype)
        walk.step()
        before = x.detach().clone()
        x.grad = torch.ones_like(x)
        walk.step()
        assert x.isfinite().all()
        moved = (before - x.detach())[1].item()
        assert moved == pytest.approx(1e-3, rel=1e-3 if dtype == torch.float32 else 1e-12)
    x.data.zero_()
    x.grad = torch.full_like(x, 1e12)
    walk.step()
    assert x[0].item() == pytest.approx(-1e9, rel=2e-3)
