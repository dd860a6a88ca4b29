"""Noise that would be made of wrong tensors, of wrong generators, or of half a temperature."""

from __future__ import annotations

import copy
import itertools
import math
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from simulated_device import SimulatedDevice
from torch import Tensor
from torch.nn import Parameter, ParameterDict
from torch.optim import Adam
from trainers import assert_same, gaussians, values_of

from opt3dgs_optim import (
    AWSGLD,
    Averaging,
    IsotropicNoise,
    Part,
    PhaseScheduler,
    PositionNoise,
)
from opt3dgs_optim.frames import LARGEST
from opt3dgs_optim.parts.noise import LEFT_AT, covariance_noise

ROWS = 4
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": ()}
RATE = 0.1


def tensors(rows: int = ROWS) -> dict[str, Tensor]:
    """Gaussians that are nearly transparent, so that they move."""
    generator = torch.Generator().manual_seed(0)
    found = {n: torch.randn(rows, *shape, generator=generator) for n, shape in SHAPES.items()}
    found["opacities"].fill_(-6.0)
    return found


def numbers(*shape: int) -> Callable[[], Tensor]:
    return lambda: torch.ones(shape)


# By the tensor: what it cannot be, and what is said of it.
WRONG: dict[str, dict[str, tuple[Callable[[], Any], type[Exception], str]]] = {
    "scales": {
        "other rows": (numbers(9, 3), ValueError, "9 scales for 4 means"),
        "two axes, as in 2DGS": (numbers(4, 2), ValueError, r"scales has .*\[N, 3\]"),
        "one number per point": (numbers(4), ValueError, r"scales has .*\[N, 3\]"),
        "no rows": (numbers(0, 3), ValueError, "0 scales for 4 means"),
        "integers": (lambda: torch.ones(4, 3, dtype=torch.int64), ValueError, "floating-point"),
        "a list": (lambda: [[0.0] * 3] * 4, TypeError, "a tensor is needed"),
    },
    "quats": {
        "other rows": (numbers(9, 4), ValueError, "9 quats for 4 means"),
        "three numbers": (numbers(4, 3), ValueError, r"quats has .*\[N, 4\]"),
        "matrices": (numbers(4, 3, 3), ValueError, r"quats has .*\[N, 4\]"),
        "one for all": (numbers(4), ValueError, r"quats has .*\[N, 4\]"),
        "complex": (lambda: torch.ones(4, 4) * 1j, ValueError, "floating-point"),
        "None": (lambda: None, TypeError, "a tensor is needed"),
    },
    "opacities": {
        "other rows": (numbers(9), ValueError, "9 opacities for 4 means"),
        "a column of other rows": (numbers(9, 1), ValueError, "9 opacities for 4 means"),
        "as many as there are coordinates": (numbers(4, 3), ValueError, r"\[N\] or \[N, 1\]"),
        "a number": (numbers(), ValueError, r"opacities has .*\[N\] or \[N, 1\]"),
        "a float": (lambda: -6.0, TypeError, "a tensor is needed"),
        "bool": (lambda: torch.ones(4, dtype=torch.bool), ValueError, "floating-point"),
    },
}
CASES = [(name, kind) for name, kinds in WRONG.items() for kind in kinds]
GIVEN = {"a dict": lambda source: source, "a function": lambda source: lambda: source}


class Trained:
    """The four tensors of some Gaussians, and a step of them."""

    def __init__(self, splats: dict[str, Parameter], noise: Any, layout: str = "dict") -> None:
        self.splats, self.phases = splats, PhaseScheduler(100, parts=[noise])
        groups = {n: {"params": [p], "lr": RATE, "name": n} for n, p in splats.items()}
        made: Any = Adam(groups.values())
        if layout == "dict":
            made = {name: Adam([group]) for name, group in groups.items()}
        self.optimizers = self.phases.upgrade(made)
        self.every = list(made.values()) if layout == "dict" else [made]

    def step(self) -> None:
        for param in self.splats.values():
            param.grad = torch.ones_like(param)
        self.phases.observe(0.1)
        for optimizer in self.every:
            optimizer.step()

    def moments(self) -> list[Tensor]:
        states = [state for optimizer in self.every for state in optimizer.state.values()]
        return [each for state in states for each in state.values()]


def assert_refused(training: Trained, error: type[Exception], said: str) -> None:
    """The step is refused, and has left no trace."""
    before = values_of(training.splats)
    with pytest.raises(error, match=f"PositionNoise: .*{said}"):
        training.step()
    assert_same(training.splats, before)
    assert not any(bool(each.any()) for each in training.moments())


@pytest.mark.parametrize("given", GIVEN)
@pytest.mark.parametrize("layout", ["dict", "single"])
@pytest.mark.parametrize(("name", "kind"), CASES)
def test_a_tensor_that_cannot_be(name: str, kind: str, layout: str, given: str) -> None:
    make, error, said = WRONG[name][kind]
    source = GIVEN[given]({**tensors(), name: make()})
    splats = {n: Parameter(each) for n, each in tensors().items()}
    generator = torch.Generator().manual_seed(3)
    drawn = generator.get_state()
    noise = PositionNoise(source, 1.0, generator=generator)
    assert_refused(Trained(splats, noise, layout), error, said)
    means = torch.ones(ROWS, 3)
    with pytest.raises(error, match=f"PositionNoise: .*{said}"):
        noise.add_to(means, 1.0)
    assert torch.equal(means, torch.ones(ROWS, 3))
    assert torch.equal(generator.get_state(), drawn)


@pytest.mark.parametrize(
    ("name", "shape"), [("scales", (9, 3)), ("quats", (4, 3)), ("opacities", (9,))]
)
def test_one_of_the_upgraded_optimizers_tensors(name: str, shape: tuple[int, ...]) -> None:
    splats = {n: Parameter(each) for n, each in tensors().items()}
    splats[name] = Parameter(torch.ones(shape))
    assert_refused(Trained(splats, PositionNoise(scale=1.0), "single"), ValueError, f"{name}")


@pytest.mark.parametrize("shape", [(4, 2), (4,), (4, 3, 1)])
def test_means_of_other_dimensions(shape: tuple[int, ...]) -> None:
    noise, means = PositionNoise(tensors(), 1.0), torch.ones(shape)
    with pytest.raises(ValueError, match=r"PositionNoise: means has shape .*\[N, 3\]"):
        noise.add_to(means, 1.0)
    assert torch.equal(means, torch.ones(shape))


@pytest.mark.parametrize("returned", [None, 3, [torch.ones(4, 3)]], ids=str)
def test_a_function_that_returns_no_dict(returned: Any) -> None:
    splats = {n: Parameter(each) for n, each in tensors().items()}
    noise = PositionNoise(lambda: returned, 1.0)
    assert_refused(Trained(splats, noise), TypeError, "a dict of tensors is needed")


@pytest.mark.parametrize("given", [3, "splats", [torch.ones(4, 3)], torch.ones(4, 3)], ids=str)
def test_what_has_no_tensors_is_refused_at_once(given: Any) -> None:
    with pytest.raises(TypeError, match=r"PositionNoise: gaussians is a .* None is needed"):
        PositionNoise(given)


def test_a_parameter_dict_of_torch_is_a_dict() -> None:
    """gsplat's trainers have one. It is a module, and so it can be called."""
    moved = []
    for kind in (dict, ParameterDict):
        means, noise = torch.zeros(ROWS, 3), PositionNoise(kind(tensors()), 1.0)
        torch.manual_seed(0)
        noise.add_to(means, 1.0)
        moved.append(means)
    assert bool(moved[0].any())
    assert torch.equal(*moved)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
@pytest.mark.parametrize("column", [False, True])
def test_what_trainers_have_is_taken(dtype: torch.dtype, column: bool) -> None:
    source = {name: each.to(dtype) for name, each in tensors().items()}
    if column:
        source["opacities"] = source["opacities"][:, None]
    means = torch.zeros(ROWS, 3)
    PositionNoise(source, 1.0).add_to(means, 1.0)
    assert bool(means.any())


# -- generators ------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [0, 3, "cpu", torch.Generator, True], ids=str)
def test_what_is_no_generator_is_refused_at_once(given: Any) -> None:
    with pytest.raises(TypeError, match=r"IsotropicNoise: generator=.* torch\.Generator or None"):
        IsotropicNoise(std=0.1, generator=given)
    with pytest.raises(TypeError, match=r"PositionNoise: generator=.* torch\.Generator or None"):
        PositionNoise(generator=given)


@pytest.mark.parametrize("layout", ["dict", "single"])
@pytest.mark.parametrize("of", ["cpu", "cuda:0"])
@pytest.mark.parametrize("kind", ["PositionNoise", "IsotropicNoise"])
def test_a_generator_of_another_device(kind: str, of: str, layout: str) -> None:
    at = "cuda:0" if of == "cpu" else "cpu"
    with SimulatedDevice():
        splats = {n: Parameter(each.to(at)) for n, each in tensors().items()}
        generator = torch.Generator(of)
        options: dict[str, Any] = {"generator": generator}
        noise = PositionNoise(scale=1.0, **options)
        if kind == "IsotropicNoise":
            noise = IsotropicNoise(std=0.1, **options)
        training = Trained(splats, noise, layout)
        before = {name: each.detach().clone() for name, each in splats.items()}
        for param in splats.values():
            param.grad = torch.ones_like(param)
        training.phases.observe(0.1)
        with pytest.raises(ValueError, match=f"{kind}: generator is one of {of}, but"):
            training.every[0].step()
        for name, param in splats.items():
            assert torch.equal(param, before[name])
        assert not any(bool(each.any()) for each in training.moments())


def test_a_parameter_without_a_gradient_asks_for_no_generator() -> None:
    """It is not moved, and no noise is drawn for it."""
    here = Parameter(torch.ones(3))
    away = Parameter(torch.ones(3, device="meta"))
    walk = AWSGLD([here, away], 0.1, noise=IsotropicNoise(std=0.1, generator=torch.Generator()))
    here.grad = torch.ones(3)
    walk.step()
    assert bool((here != 1).all())


# -- complex parameters ----------------------------------------------------------------------------

COMPLEX = {torch.complex64: torch.float32, torch.complex128: torch.float64}


@pytest.mark.parametrize("dtype", COMPLEX)
def test_a_complex_number_has_the_temperature_of_its_two_coordinates(dtype: torch.dtype) -> None:
    """Bit for bit what happens to [N, 2] real numbers."""
    whole = Parameter(torch.zeros(50, dtype=dtype))
    pair = Parameter(torch.zeros(50, 2, dtype=COMPLEX[dtype]))
    for param in (whole, pair):
        generator = torch.Generator().manual_seed(1)
        noise = IsotropicNoise(temperature=2.0, generator=generator)
        walk = AWSGLD([param], lr=0.05, noise=noise, preconditioner="none")
        for _ in range(20):
            param.grad = param.detach().clone()
            walk.step()
    assert bool(pair.any())
    torch.testing.assert_close(torch.view_as_real(whole.detach()), pair.detach())


def test_a_complex_walk_samples_its_law() -> None:
    torch.manual_seed(0)
    x = Parameter(torch.zeros(4000, dtype=torch.complex64))
    lr, temperature, seen = 0.1, 0.7, list[Tensor]()
    noise = IsotropicNoise(temperature=temperature)
    walk = AWSGLD([x], lr=lr, noise=noise, preconditioner="none")
    for step in range(120):
        x.grad = x.detach().clone()  # of |x|^2 / 2
        walk.step()
        if step >= 60:
            seen.append(torch.view_as_real(x.detach()).square().mean(0))
    # The law of the discrete walk. Relative standard error: 8,000 coordinates, some 6 independent
    # times: 0.6 % together, 0.9 % for each part alone.
    expected = torch.full((2,), temperature / (1 - lr / 2))
    torch.testing.assert_close(torch.stack(seen).mean(0), expected, rtol=0.04, atol=0)


@pytest.mark.parametrize("dtype", [*COMPLEX, torch.float32, torch.float64])
def test_a_fixed_deviation_is_that_of_the_whole_number(dtype: torch.dtype) -> None:
    x = torch.zeros(40_000, dtype=dtype)
    IsotropicNoise(std=0.3, generator=torch.Generator().manual_seed(2)).after(
        {"lr": 0.1},
        x,
        {},
        None,  # pyright: ignore[reportArgumentType]
    )
    drawn = torch.randn(40_000, dtype=dtype, generator=torch.Generator().manual_seed(2))
    assert torch.equal(x, drawn * 0.3)
    # 40,000 draws: a relative standard error of at most 0.7 %
    assert float(x.abs().square().mean()) == pytest.approx(0.3**2, rel=0.04)
    if dtype.is_complex:
        assert float(x.real.square().mean()) == pytest.approx(0.3**2 / 2, rel=0.04)


# -- noise that is there twice ---------------------------------------------------------------------


def warned(sets: str, rates: dict[str, float], parts: int = 1) -> int:
    """How often a training says it, to some of whose sets the trainer adds noise of these rates."""
    sizes = {"xyz": (3,), "scaling": (3,), "rotation": (4,), "opacity": (1,)}
    torch.manual_seed(0)
    params = {f"{c}#{k}": Parameter(torch.randn(6, *v)) for c in sets for k, v in sizes.items()}
    phases = PhaseScheduler(300, parts=[PositionNoise(scale=1.0) for _ in range(parts)])
    adam = phases.upgrade(Adam([{"params": [p], "lr": 0.01, "name": k} for k, p in params.items()]))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        for iteration in range(40):
            if iteration == 20:  # a copy goes on
                adam.load_state_dict(copy.deepcopy(adam.state_dict()))
            for param in params.values():
                param.grad = torch.randn_like(param)
            phases.observe(0.1)
            adam.step()
            with torch.no_grad():
                for name, rate in rates.items():
                    params[f"{name}#xyz"].add_(rate * torch.randn(6, 3))
    return sum("noise_lr to 0" in str(each.message) for each in said)


@pytest.mark.parametrize("sets", ["A", "AB", "ABC"])
@pytest.mark.parametrize("parts", [1, 2])
def test_it_is_said_once_of_whichever_sets(sets: str, parts: int) -> None:
    for count in range(len(sets) + 1):
        for noisy in itertools.combinations(sets, count):
            assert warned(sets, dict.fromkeys(noisy, 0.01), parts) == bool(noisy), noisy


@pytest.mark.parametrize(
    ("rates", "expected"),
    [({"A": 0.0}, 0), ({"A": 0.0, "B": 0.0}, 0), ({"A": 0.0, "B": 0.01}, 1), ({"B": 0.0}, 0)],
    ids=str,
)
def test_a_rate_of_zero_is_not_said_and_hides_no_other(
    rates: dict[str, float], expected: int
) -> None:
    assert warned("AB", rates) == expected


def upgraded_by(phases: PhaseScheduler) -> tuple[dict[str, Parameter], dict[str, Adam]]:
    """Six Gaussians, and an Adam for each of their parameters."""
    params = {name: Parameter(torch.randn(6, *shape)) for name, shape in SHAPES.items()}
    return params, phases.upgrade({name: Adam([each], lr=0.01) for name, each in params.items()})


def step(params: dict[str, Parameter], adams: dict[str, Adam], phases: PhaseScheduler) -> None:
    """One iteration with random gradients."""
    for param in params.values():
        param.grad = torch.randn_like(param)
    phases.observe(0.1)
    for adam in adams.values():
        adam.step()


@pytest.mark.parametrize("noise_first", [True, False])
def test_the_mean_of_the_iterates_is_no_noise_of_the_trainers(noise_first: bool) -> None:
    """Averaging puts it in the positions' place in the last steps, after the noise or before."""
    parts: list[Part] = [PositionNoise(scale=1.0), Averaging()]
    phases = PhaseScheduler(600, parts=parts if noise_first else parts[::-1])
    params, adams = upgraded_by(phases)
    for _ in range(600):
        step(params, adams, phases)


def test_positions_are_copied_in_one_step_only() -> None:
    """That in which they are compared; a copy in every step would cost as much as the noise."""
    phases = PhaseScheduler(300, parts=[PositionNoise(scale=1.0)])
    params, adams = upgraded_by(phases)
    copies = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(40):
            step(params, adams, phases)
            _, _, copied = phases.published(LEFT_AT, params["means"])
            copies += copied is not None
            with torch.no_grad():
                params["means"].add_(0.01)
    assert copies == 1


def test_gaussians_of_this_file_move() -> None:
    """Else nothing above would be shown."""
    source = {name: each.float() for name, each in gaussians(ROWS).items()}
    source["opacities"].fill_(-6.0)
    means = torch.zeros(ROWS, 3)
    PositionNoise(source, 1.0).add_to(means, 1.0)
    assert bool((means != 0).all())


@pytest.mark.parametrize("log_scale", [44.5, 80.0, 800.0, float("inf"), float("nan"), -1e4])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_gaussians_of_any_size_leave_the_noise_finite(log_scale: float, dtype: torch.dtype) -> None:
    """One whose variance is infinite, or unknown, is not moved; the others are, as without it."""
    draw = torch.Generator().manual_seed(3)
    eta, quats = torch.randn(5, 3, generator=draw), torch.randn(5, 4, generator=draw)
    scales, opacities = torch.zeros(5, 3), torch.full((5,), -9.0)
    without = covariance_noise(*(t.to(dtype) for t in (scales, quats, opacities, eta)))
    scales[2, 1] = log_scale
    found = covariance_noise(*(t.to(dtype) for t in (scales, quats, opacities, eta)))
    assert bool(found.isfinite().all())
    others = torch.arange(5) != 2
    assert torch.equal(found[others], without[others])
    if not math.exp(min(log_scale, 700.0)) < LARGEST[dtype]:
        assert bool((found[2] == 0).all())
