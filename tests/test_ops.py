"""One schema, two implementations: the operators under torch's own checks, and their routing."""

from __future__ import annotations

import shutil

import pytest
import torch
from kernel_host import expected_noise, noise_case
from torch import Tensor

from opt3dgs_optim import AWSGLD, LQNAdam, curvature, ops
from opt3dgs_optim.noise import CovarianceNoise

CALLS = torch.ops.opt3dgs_optim
# inductor imports parts of torch that torch itself has deprecated
pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")


COMPILERS = pytest.mark.parametrize(
    "compiler",
    [
        "aot_eager",
        pytest.param(
            "inductor",
            marks=pytest.mark.skipif(
                shutil.which("g++") is None, reason="inductor needs g++ on a CPU"
            ),
        ),
    ],
)


def points(n: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor, Tensor]:
    """Position, gradient and a history with two pairs."""
    g = torch.Generator().manual_seed(n)
    draws = torch.randn(6, n, 3, generator=g, dtype=torch.float64).to(dtype)
    history = curvature.new_history(draws[0], 5)
    for x in draws[:3]:
        curvature.record(history, 5, x, 2 * x, torch.ones(n, dtype=torch.bool), min_cosine=1e-6)
    return draws[3], draws[4], history


def lqn_options(**changed: object) -> dict:
    options = {"min_cosine": 1e-6, "powell": False, "graft": True, "gamma_clamp": None}
    return {**options, "backend": "auto", **changed}


NOISE = {"noise_scale": 3.0, "sharpness": 100.0, "threshold": 0.005, "backend": "auto"}


@pytest.mark.parametrize("changed", [{}, {"powell": True, "gamma_clamp": [0.1, 2.0]}], ids=str)
@pytest.mark.parametrize("n", [0, 1, 257])
def test_opcheck_lqn_direction(n: int, changed: dict) -> None:
    torch.library.opcheck(CALLS.lqn_direction.default, (*points(n), 5), lqn_options(**changed))


@pytest.mark.parametrize("n", [0, 1, 257])
def test_opcheck_add_covariance_noise(n: int) -> None:
    means, gaussians, eta = noise_case(n, torch.float32)
    arguments = (means, *gaussians.values(), eta, torch.tensor(0.1))
    torch.library.opcheck(CALLS.add_covariance_noise.default, arguments, NOISE)


@COMPILERS
def test_lqn_direction_compiles_without_a_graph_break(compiler: str) -> None:
    x, grad, history = points(100)
    eager_history = history.clone()

    def both(x: Tensor, grad: Tensor, history: Tensor) -> tuple[Tensor, Tensor]:
        fed, accepted, _ = ops.lqn_direction(
            2 * x, grad, history, 5, min_cosine=1e-6, powell=False, graft=True, gamma_clamp=None
        )
        return 2 * fed, accepted.sum()

    expected = both(x, grad, eager_history)
    compiled = torch.compile(both, fullgraph=True, backend=compiler)(x, grad, history)
    torch.testing.assert_close(compiled[0], expected[0], rtol=0, atol=0)
    assert int(compiled[1]) == int(expected[1])
    assert torch.equal(history, eager_history)


@COMPILERS
def test_add_covariance_noise_compiles_without_a_graph_break(compiler: str) -> None:
    means, gaussians, eta = noise_case(100, torch.float32)
    lr = torch.tensor(0.1)
    expected = means + expected_noise(gaussians, eta) * 0.3

    def add(means: Tensor, lr: Tensor) -> Tensor:
        moved = means * 1
        ops.add_covariance_noise(moved, *gaussians.values(), eta=eta, lr=lr, noise_scale=3.0)
        return moved

    compiled = torch.compile(add, fullgraph=True, backend=compiler)(means, lr)
    torch.testing.assert_close(compiled, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.slow
def test_pure_torch_compiles_with_inductor() -> None:
    """The path of ROCm, MPS and CPU; slow only because of the compiler."""
    _, grad, history = points(1000)
    compiled = torch.compile(curvature.two_loop, fullgraph=True)(grad, history, 5)
    torch.testing.assert_close(compiled, curvature.two_loop(grad, history, 5), rtol=1e-5, atol=1e-6)


def test_operator_is_record_then_direction() -> None:
    x, grad, history = points(300, torch.float64)
    grad[::5] = 0
    grad[1::5, 1] = torch.nan
    twin = history.clone()
    fed, accepted, candidates = ops.lqn_direction(
        x, grad, history, 5, min_cosine=1e-6, powell=True, graft=True, gamma_clamp=(0.1, 3.0)
    )
    visible = (grad != 0).any(1) & grad.isfinite().all(1)
    flags = curvature.record(twin, 5, x, grad, visible, min_cosine=1e-6, powell=True)
    expected = curvature.direction(grad, twin, 5, graft=True, gamma_clamp=(0.1, 3.0))
    assert torch.equal(accepted, flags[0])
    assert torch.equal(candidates, flags[1])
    assert torch.equal(history, twin)
    torch.testing.assert_close(fed, expected, rtol=0, atol=0, equal_nan=True)


def test_both_memory_layouts_give_the_same_numbers() -> None:
    x, grad, history = points(40)
    outcomes = []
    for contiguous in (False, True):
        copy = curvature.laid_out(history.clone(), contiguous=contiguous)
        assert copy.is_contiguous() == contiguous
        fed, _, _ = curvature.step(
            x, grad, copy, 5, min_cosine=1e-6, powell=False, graft=True, gamma_clamp=None
        )
        outcomes.append((fed, copy))
    assert torch.equal(outcomes[0][0], outcomes[1][0])
    assert torch.equal(outcomes[0][1], outcomes[1][1])


def test_wrong_shapes_are_named() -> None:
    x, grad, history = points(7)
    with pytest.raises(ValueError, match=r"lqn_direction: history has shape \(6, 5, 8\)"):
        ops.lqn_direction(
            x, grad, history[:6], 5, min_cosine=0.0, powell=False, graft=True, gamma_clamp=None
        )


def test_optimizers_go_through_the_operators(monkeypatch: pytest.MonkeyPatch) -> None:
    called = []
    for name in ("lqn_direction", "add_covariance_noise"):
        module = {"lqn_direction": "lqnadam", "add_covariance_noise": "noise"}[name]
        real = getattr(ops, name)

        def spy(*args: object, real=real, name=name, **kwargs: object) -> object:
            called.append(name)
            return real(*args, **kwargs)

        monkeypatch.setattr(f"opt3dgs_optim.{module}.{name}", spy)
    means, gaussians, _ = noise_case(20, torch.float32)
    x = torch.nn.Parameter(means)
    flat = torch.nn.Parameter(means[:, :2].clone())
    noise = CovarianceNoise(gaussians, 1.0)
    for optimizer in (AWSGLD([x], noise=noise), LQNAdam([x]), LQNAdam([flat])):
        x.grad, flat.grad = torch.ones_like(x), torch.ones_like(flat)
        optimizer.step()
    assert called == ["add_covariance_noise", "lqn_direction"]
