"""LQNAdam with the CUDA kernel's source, compiled for the host, in the place of pure torch."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from kernel_host import compiler, host_kernels
from problems import gradient, hessians, log_uniform, quadratic
from torch import Tensor

from opt3dgs_optim import LQNAdam, cuda

pytestmark = pytest.mark.compiles

ROWS = 2_000
CONDITIONS = (1.0, 1e3, 1e6, 1e12)
needs_compiler = pytest.mark.skipif(compiler() is None, reason="g++ is not installed")
BACKENDS = ["torch", pytest.param("kernel", marks=needs_compiler, id="kernel on the host")]


def on_the_host(patch: pytest.MonkeyPatch) -> Callable[..., LQNAdam]:
    """LQNAdam with the host's kernels in the place of the CUDA kernels, as on a GPU."""

    def kernel(
        x: Tensor, g: Tensor, history: Tensor, size: int, min_cosine: float, graft: bool
    ) -> Any:
        assert history.is_contiguous()  # laid out for the kernel
        return host_kernels(size, g.dtype).lqn(x, g, history, min_cosine=min_cosine, graft=graft)

    patch.setattr(cuda, "lqn_direction", kernel)
    for name, module in list(sys.modules.items()):
        if name.startswith("opt3dgs_optim.") and hasattr(module, "obstacle"):
            patch.setattr(module, "obstacle", lambda *_: None)
    return partial(LQNAdam, backend="cuda")


@pytest.fixture(params=BACKENDS)
def optimizer_of(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., LQNAdam]:
    """LQNAdam on either backend."""
    return on_the_host(monkeypatch) if request.param == "kernel" else LQNAdam


@pytest.mark.parametrize(("condition", "left"), [(1.0, 1e-10), (10.0, 1e-8), (100.0, 1e-7)])
def test_lqnadam_converges(
    optimizer_of: Callable[..., LQNAdam], condition: float, left: float
) -> None:
    """1,000 steps, the learning rate decayed to 1e-6 of a tenth of the distance."""
    hessian = hessians(300, condition)
    x = torch.nn.Parameter(torch.ones(300, 3, dtype=torch.float64))
    optimizer = optimizer_of([x], lr=0.1, betas=(0.9, 0.95))
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 1e-6 ** (1 / 1000))
    for _ in range(1000):
        x.grad = gradient(quadratic(hessian), x)
        optimizer.step()
        decay.step()
    assert float(x.detach().norm(dim=1).median()) < left


@pytest.mark.parametrize("condition", CONDITIONS)
def test_lqnadam_survives_any_condition(
    optimizer_of: Callable[..., LQNAdam], condition: float
) -> None:
    """Float32, losses in units of 1e-8 to 1e8 in one batch: finite, and never far off."""
    unit = log_uniform(ROWS, 1e-8, 1e8).float()[:, None]
    hessian = hessians(ROWS, condition).float()
    x = torch.nn.Parameter(torch.ones(ROWS, 3))
    optimizer = optimizer_of([x], lr=0.01, eps=1e-30)
    for _ in range(100):
        x.grad = torch.einsum("nij,nj->ni", hessian, x.detach()) * unit
        optimizer.step()
    assert bool(torch.isfinite(x).all())
    # Adam's steps are about 0.01 a coordinate: 100 of them reach no further than 1
    assert float((x.detach() - 1).abs().max()) < 1.5
    loss = 0.5 * torch.einsum("ni,nij,nj->n", x.detach(), hessian, x.detach())
    assert float((loss < 0.5 * hessian.sum((1, 2))).double().mean()) > 0.9


@needs_compiler
def test_both_backends_take_the_same_path(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """100 steps of LQNAdam at condition 1e3, by either: the same points, to rounding."""
    hessian, ends = hessians(200, 1e3), []
    for patched in (False, True):
        make = on_the_host(monkeypatch) if patched else LQNAdam
        x = torch.nn.Parameter(torch.ones(200, 3, dtype=torch.float64))
        optimizer = make([x], lr=0.01)
        for _ in range(100):
            x.grad = gradient(quadratic(hessian), x)
            optimizer.step()
        ends.append(x.detach())
    error = (ends[0] - ends[1]).abs()
    # rounding, amplified where pairs are nearly parallel; a row near the bound of acceptance may go
    # another way by a step
    assert float(error.quantile(0.9)) < 1e-9
    assert float(error.max()) < 1e-2
