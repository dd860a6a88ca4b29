"""LQNAdam: Adam without usable pairs, a quasi-Newton direction with them."""

from __future__ import annotations

import copy
import io

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
    assert float(header(a.state[ours]["history"], 5).counter.max()) == 1
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
    found = two_loop(gradient, optimizer.state[x]["history"], 16)
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


def test_invisible_points_keep_their_pairs() -> None:
    x = points()
    optimizer = LQNAdam([x], lr=0.01)
    for _ in range(4):
        x.grad = 2 * x.detach()
        optimizer.step()
    before = optimizer.state[x]["history"].clone()
    x.grad = 2 * x.detach()
    x.grad[::2] = 0.0
    optimizer.step()
    after = optimizer.state[x]["history"]
    assert torch.equal(after[::2], before[::2])
    assert not torch.equal(after[1::2], before[1::2])


def test_dropped_when_the_parameter_is_another_object() -> None:
    """What density control does: a new Parameter that inherits the state, of the same size."""
    x = points()
    optimizer = LQNAdam([x], lr=0.01)
    for _ in range(4):
        x.grad = 2 * x.detach()
        optimizer.step()
    new = torch.nn.Parameter(x.detach()[[3, 2, 1, 0, 5, 4]])
    optimizer.state[new] = optimizer.state.pop(x)
    optimizer.param_groups[0]["params"] = [new]
    plain, twin = torch.nn.Parameter(new.detach().clone()), None
    twin = torch.optim.Adam([plain], lr=0.01)
    twin.state[plain] = {
        k: v.clone()
        for k, v in optimizer.state[new].items()
        if k in ("step", "exp_avg", "exp_avg_sq")
    }
    new.grad = noise_gradient(6, 0)
    plain.grad = noise_gradient(6, 0)
    optimizer.step()
    twin.step()
    assert torch.equal(new, plain)


def test_dropped_when_rows_were_resized_in_place_of_the_state() -> None:
    """The INRIA family carries unknown state keys over untouched: they keep the old N."""
    x = points(6)
    optimizer = LQNAdam([x], lr=0.01)
    for _ in range(3):
        x.grad = 2 * x.detach()
        optimizer.step()
    new = torch.nn.Parameter(x.detach()[:4].clone())
    state = optimizer.state.pop(x)
    state["exp_avg"], state["exp_avg_sq"] = state["exp_avg"][:4], state["exp_avg_sq"][:4]
    optimizer.state[new] = state
    optimizer.param_groups[0]["params"] = [new]
    new.grad = torch.ones(4, 3)
    optimizer.step()
    assert optimizer.state[new]["history"].shape == (4, 5, 8)
    assert header(optimizer.state[new]["history"], 5).counter.tolist() == [1.0] * 4


def test_state_is_float32_with_points_first() -> None:
    """What density control edits by rows must be just that."""
    x = points(7)
    optimizer = LQNAdam([x], lr=0.01)
    x.grad = torch.ones(7, 3)
    optimizer.step()
    for key, value in optimizer.state[x].items():
        if key != "step":
            assert isinstance(value, Tensor)
            assert value.dtype == torch.float32
            assert value.shape[0] == 7


@pytest.mark.parametrize("options", [{}, {"history_size": 2, "graft": False}], ids=str)
def test_resume_is_exact(options: dict) -> None:
    def run(x: torch.nn.Parameter, optimizer: LQNAdam, first: int, last: int) -> None:
        for step in range(first, last):
            x.grad = 2 * x.detach() * torch.tensor([1.0, 5.0, 25.0]) + noise_gradient(6, step) * 0.1
            optimizer.step()

    whole = points()
    run(whole, LQNAdam([whole], lr=0.01, **options), 0, 20)
    first = points()
    before = LQNAdam([first], lr=0.01, **options)
    run(first, before, 0, 11)
    buffer = io.BytesIO()
    torch.save([first.detach(), before.state_dict()], buffer)
    buffer.seek(0)
    values, state = torch.load(buffer, weights_only=True)
    second = torch.nn.Parameter(values)
    after = LQNAdam([second], lr=0.01, **options)
    after.load_state_dict(state)
    run(second, after, 11, 20)
    assert torch.equal(whole, second)


def test_deepcopy_goes_on_alike() -> None:
    x = points()
    optimizer = LQNAdam([x], lr=0.01)
    for _ in range(4):
        x.grad = 2 * x.detach()
        optimizer.step()
    twin = copy.deepcopy(optimizer)
    y = twin.param_groups[0]["params"][0]
    for param, each in ((x, optimizer), (y, twin)):
        param.grad = 2 * param.detach()
        each.step()
    assert torch.equal(x, y)


def test_maximize_mirrors_minimize() -> None:
    a, b = points(), points()
    down, up = LQNAdam([a], lr=0.01), LQNAdam([b], lr=0.01, maximize=True)
    for _ in range(10):
        a.grad, b.grad = 2 * a.detach(), -2 * b.detach()
        down.step()
        up.step()
    assert torch.equal(a, b)


@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (4,), (), (3, 2, 2)])
def test_any_shape_whose_first_dimension_is_points(shape: tuple[int, ...]) -> None:
    x = torch.nn.Parameter(torch.ones(shape))
    optimizer = LQNAdam([x], lr=0.01)
    for _ in range(3):
        x.grad = 2 * x.detach()
        optimizer.step()
    assert x.shape == shape
    assert bool((x < 1).all())


def test_non_finite_rows_keep_their_pairs() -> None:
    x = points()
    optimizer = LQNAdam([x], lr=0.01)
    for step in range(6):
        x.grad = 2 * x.detach()
        if step == 4:
            x.grad[1] = float("nan")
            before = optimizer.state[x]["history"][1].clone()
            optimizer.step()
            assert torch.equal(before, optimizer.state[x]["history"][1])
        else:
            optimizer.step()
    assert bool(torch.isfinite(x).all())


def test_bfloat16_points_keep_float32_history() -> None:
    x = points(4, torch.bfloat16)
    optimizer = LQNAdam([x], lr=0.01)
    for _ in range(3):
        x.grad = 2 * x.detach()
        optimizer.step()
    assert optimizer.state[x]["history"].dtype == torch.float32
    assert x.dtype == torch.bfloat16


def test_decoupled_weight_decay_is_adamws() -> None:
    x, y = points(), points()
    a = LQNAdam([x], lr=0.01, weight_decay=0.1, decoupled_weight_decay=True, min_cosine=1 - 1e-12)
    b = torch.optim.AdamW([y], lr=0.01, weight_decay=0.1)
    for step in range(10):
        x.grad, y.grad = noise_gradient(6, step), noise_gradient(6, step)
        a.step()
        b.step()
    assert torch.equal(x, y)


def test_pairs_of_another_history_size_are_collected_anew() -> None:
    x, y = points(), points()
    first, second = LQNAdam([x], lr=0.01), LQNAdam([y], lr=0.01, history_size=7)
    for step in range(4):
        x.grad = noise_gradient(6, step)
        first.step()
    second.load_state_dict(first.state_dict())
    y.grad = torch.ones(6, 3)
    second.step()
    assert second.state[y]["history"].shape == (6, 7, 8)


def test_complex_parameters_are_refused() -> None:
    x = torch.nn.Parameter(torch.ones(2, dtype=torch.complex64))
    x.grad = torch.ones_like(x)
    with pytest.raises(ValueError, match="complex"):
        LQNAdam([x]).step()
