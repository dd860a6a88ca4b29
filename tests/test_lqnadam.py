"""LQNAdam by itself: Adam without usable pairs, a quasi-Newton direction with them."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch
from gaussians import through_a_file
from torch.nn import Parameter

from opt3dgs_optim import Curvature, LQNAdam
from opt3dgs_optim.parts.curvature import HISTORY

OPTIONS: list[dict[str, Any]] = [
    {},
    {"betas": (0.5, 0.99), "eps": 1e-15},
    {"weight_decay": 0.1},
]


def points(n: int = 6, dtype: torch.dtype = torch.float32, seed: int = 0) -> Parameter:
    generator = torch.Generator().manual_seed(seed)
    return Parameter(torch.randn(n, 3, generator=generator, dtype=torch.float64).to(dtype))


@pytest.mark.parametrize("options", OPTIONS, ids=str)
@pytest.mark.parametrize("rows", [1, 6, 50_000])
def test_without_pairs_it_is_torch_adam_bit_for_bit(rows: int, options: dict[str, Any]) -> None:
    """Gradients of a concave function: no pair is ever accepted."""
    ours, theirs = points(rows), points(rows)
    a = LQNAdam([ours], lr=0.01, **options)
    b = torch.optim.Adam([theirs], lr=0.01, foreach=False, **options)
    start = ours.detach().clone()
    assert a.accepted_share is None
    for _ in range(6):
        for x, optimizer in ((ours, a), (theirs, b)):
            x.grad = -(x.detach() - start) + 0.3
            optimizer.step()
    assert torch.equal(ours, theirs)
    assert torch.equal(a.state[ours]["exp_avg_sq"], b.state[theirs]["exp_avg_sq"])
    assert float(a.accepted_share) == 0.0  # pyright: ignore[reportArgumentType]


def test_weight_decay_moves_the_minimum_as_adams_does() -> None:
    """To H x + decay x = b; behind the direction it would be another."""
    hessian = torch.tensor([[2.0, 0.9], [0.9, 1.0]], dtype=torch.float64)
    b = torch.tensor([1.0, -2.0], dtype=torch.float64)
    x = Parameter(torch.zeros(1, 2, dtype=torch.float64))
    optimizer = LQNAdam([x], lr=0.1, weight_decay=1.0)
    for step in range(600):
        optimizer.param_groups[0]["lr"] = 0.1 * (1 - step / 600)
        x.grad = x.detach() @ hessian - b
        optimizer.step()
    minimum = torch.linalg.solve(hessian + torch.eye(2, dtype=torch.float64), b)
    torch.testing.assert_close(x.detach()[0], minimum, rtol=0, atol=1e-4)


def test_it_resumes_bit_for_bit() -> None:
    x, stiff = points(), torch.tensor([1.0, 5.0, 25.0])
    optimizer = LQNAdam([{"params": [x], "name": "means"}], lr=0.01)

    def go(x: Parameter, optimizer: Any) -> None:
        for _ in range(8):
            x.grad = x.detach() * stiff
            optimizer.step()

    go(x, optimizer)
    y = Parameter(x.detach().clone())
    twin = LQNAdam([{"params": [y], "name": "means"}], lr=0.3)
    twin.load_state_dict(through_a_file(optimizer.state_dict()))
    go(x, optimizer)
    go(y, twin)
    assert torch.equal(x, y)
    assert torch.equal(optimizer.state[x][HISTORY], twin.state[y][HISTORY])


def test_a_parameter_of_one_dimension_is_warned_of() -> None:
    with pytest.warns(UserWarning, match=r"\[7\] is 7 problems .* \[1, 7\] is one problem"):
        LQNAdam([Parameter(torch.ones(7))])
    optimizer = LQNAdam([Parameter(torch.ones(1, 7))])
    with pytest.warns(UserWarning, match="dimension 0 is the batch"):
        optimizer.add_param_group({"params": [Parameter(torch.ones(2))]})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        LQNAdam([Parameter(torch.tensor(s)) for s in (1.0, [1.0], [[1.0, 2.0]])])


def test_defaults_are_adams_and_curvatures() -> None:
    ours, theirs = LQNAdam([points()]), torch.optim.Adam([points()]).defaults
    assert all(ours.defaults[name] == theirs[name] for name in ("lr", "betas", "eps"))
    part, curvature = ours.training.part(Curvature), Curvature()
    for name in ("history_size", "min_cosine", "graft", "backend"):
        assert getattr(part, name) == getattr(curvature, name), name


def test_what_is_outside_is_refused() -> None:
    with pytest.raises(TypeError, match="amsgrad"):
        LQNAdam([points()], amsgrad=True)  # pyright: ignore
    for dtype in (torch.float16, torch.complex64):
        with pytest.raises(ValueError, match=str(dtype)):
            LQNAdam([Parameter(torch.ones(2, 2, dtype=dtype))])
    with pytest.raises(ValueError, match="Curvature: history_size=17"):
        LQNAdam([points()], history_size=17)
