"""LQNAdam: Adam without usable pairs, a quasi-Newton direction with them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracles import dense_bfgs
from torch import Tensor

from opt3dgs_optim import LQNAdam, two_loop
from opt3dgs_optim.lbfgs.history import header

PATHS = [{}, {"foreach": True}, {"fused": True}, {"amsgrad": True, "weight_decay": 0.1}]


def points(n: int = 6, dtype: torch.dtype = torch.float32, seed: int = 0) -> torch.nn.Parameter:
    generator = torch.Generator().manual_seed(seed)
    return torch.nn.Parameter(torch.randn(n, 3, generator=generator, dtype=torch.float64).to(dtype))


def noise_gradient(n: int, seed: int) -> Tensor:
    return torch.randn(n, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("path", PATHS, ids=str)
def test_without_pairs_it_is_torch_adam_bit_for_bit(path: dict) -> None:
    """Gradients of a concave function: no pair is ever accepted."""
    ours, theirs = points(), points()
    a, b = LQNAdam([ours], lr=0.01, **path), torch.optim.Adam([theirs], lr=0.01, **path)
    start = ours.detach().clone()
    for _ in range(20):
        ours.grad = -(ours.detach() - start) + 0.3
        theirs.grad = -(theirs.detach() - start) + 0.3
        a.step()
        b.step()
    assert float(header(a.state[ours]["Curvature.history"], 5).counter.max()) == 1
    assert torch.equal(ours, theirs)
    assert float(a.accepted_share) == 0.0  # pyright: ignore[reportArgumentType]


def test_feeds_adam_the_two_loop_direction() -> None:
    """Against the dense recursion over the last K accepted pairs, and Adam by hand."""
    n, size = 5, 4
    matrix = torch.diag(torch.tensor([1.0, 10.0, 100.0], dtype=torch.float64))
    x = points(n, torch.float64)
    optimizer = LQNAdam([x], lr=0.01, history_size=size, graft=False, min_cosine=0.0)
    xs, gs, m, v = [], [], np.zeros((n, 3)), np.zeros((n, 3))
    for t in range(1, 15):
        x.grad = x.detach() @ matrix
        xs.append(x.detach().numpy().copy())
        gs.append(x.grad.numpy().copy())
        fed = gs[-1].copy()
        s, y = np.diff(np.array(xs), axis=0), np.diff(np.array(gs), axis=0)
        for row in range(n if t > 1 else 0):
            fed[row] = dense_bfgs(s[-size:, row], y[-size:, row]) @ gs[-1][row]
        m, v = 0.9 * m + 0.1 * fed, 0.999 * v + 0.001 * fed**2
        step = 0.01 * (m / (1 - 0.9**t)) / (np.sqrt(v / (1 - 0.999**t)) + 1e-8)
        expected = xs[-1] - step
        optimizer.step()
        np.testing.assert_allclose(x.detach().numpy(), expected, rtol=1e-7, atol=1e-9)


def rotated_hessians(n: int, condition: float) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    rotation = torch.linalg.qr(torch.randn(n, 3, 3, generator=generator, dtype=torch.float64)).Q
    scale = torch.tensor([1.0, condition**0.5, condition], dtype=torch.float64)
    return rotation @ torch.diag(scale) @ rotation.mT


@pytest.mark.parametrize(("condition", "at_least"), [(1e1, 0.97), (1e2, 0.9), (1e3, 0.65)])
def test_direction_points_at_the_minimum_where_steps_span_the_space(
    condition: float, at_least: float
) -> None:
    """Positions that Langevin noise moves in all directions give pairs that span the space."""
    hessian, generator = rotated_hessians(200, condition), torch.Generator().manual_seed(1)
    x = torch.nn.Parameter(torch.ones(200, 3, dtype=torch.float64))
    optimizer = LQNAdam([x], lr=1e-3, history_size=16)
    for _ in range(30):
        x.grad = torch.einsum("nij,nj->ni", hessian, x.detach())
        optimizer.step()
        with torch.no_grad():
            x += 0.05 * torch.randn(x.shape, generator=generator, dtype=x.dtype)
    gradient = torch.einsum("nij,nj->ni", hessian, x.detach())
    found = two_loop(gradient, optimizer.state[x]["Curvature.history"], 16)
    cosine = torch.nn.functional.cosine_similarity
    plain, newton = cosine(gradient, x.detach()).mean(), cosine(found, x.detach()).mean()
    assert float(newton) > max(at_least, float(plain) + 0.05)


def test_smooth_adam_steps_give_collinear_pairs() -> None:
    """The limit of the method, kept as a fact: Adam's own small steps probe one direction only.

    On a rotated quadratic of condition 100 without noise, the two-loop direction is then no
    better than the gradient, and LQNAdam converges, but more slowly than Adam.
    """
    hessian = rotated_hessians(200, 100.0)
    errors = {}
    for cls in (torch.optim.Adam, LQNAdam):
        x = torch.nn.Parameter(torch.ones(200, 3, dtype=torch.float64))
        optimizer = cls([x], lr=0.05)
        decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.99)
        for _ in range(600):
            x.grad = torch.einsum("nij,nj->ni", hessian, x.detach())
            optimizer.step()
            decay.step()
        errors[cls.__name__] = float(x.detach().norm(dim=1).log10().mean())
    assert errors["LQNAdam"] < -1.0  # from +0.24
    assert errors["Adam"] < errors["LQNAdam"]


def test_pairs_of_another_history_size_are_refused() -> None:
    x, y = points(), points()
    first, second = LQNAdam([x], lr=0.01), LQNAdam([y], lr=0.01, history_size=7)
    for step in range(4):
        x.grad = noise_gradient(6, step)
        first.step()
    with pytest.raises(ValueError, match="history_size=5, but pairs of history_size=7"):
        second.load_state_dict(first.state_dict())
    assert not second.state[y]


def test_complex_parameters_are_refused() -> None:
    x = torch.nn.Parameter(torch.ones(2, 1, dtype=torch.complex64))
    x.grad = torch.ones_like(x)
    with pytest.raises(ValueError, match="complex"):
        LQNAdam([x]).step()


def test_half_precision_that_a_direction_would_leave() -> None:
    """Grafting puts the length of a whole gradient into one coordinate."""
    stiff, goal = torch.tensor([1.0, 100.0, 100.0]), torch.tensor([[3.0, 1.0, -1.0]])
    x = torch.nn.Parameter(torch.zeros(1, 3).half())
    optimizer = LQNAdam([x], lr=0.1, eps=1e-4)
    for i in range(12):
        grad = (x.detach().float() - goal) * stiff
        x.grad = (grad if i < 11 else torch.tensor([[-6e4, 6e4, 6e4]])).half()
        optimizer.step()
    assert x.isfinite().all()
    assert optimizer.state[x]["exp_avg"].isfinite().all()
