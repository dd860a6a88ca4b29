"""Extremes: dtypes, step sizes and visibility at the edge of what can be computed."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from problems import MULTIMODAL, SMOOTH, gradient, hessians, quadratic
from torch import Tensor

from opt3dgs_optim import AWSGLD, LQNAdam
from opt3dgs_optim.lbfgs.history import header

BOTH = [AWSGLD, LQNAdam]
DTYPES = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


def points(rows: int = 8, dtype: torch.dtype = torch.float32, value: float = 1.0) -> Tensor:
    return torch.nn.Parameter(torch.full((rows, 3), value, dtype=dtype))


def run(optimizer: torch.optim.Optimizer, x: Tensor, gradients: list[Tensor]) -> Tensor:
    for g in gradients:
        x.grad = g.to(x.dtype)
        optimizer.step()
    return x.detach()


def rows_of_noise(steps: int, rows: int = 8, seed: int = 0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.randn(rows, 3, generator=generator) for _ in range(steps)]


# -- dtypes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("cls", BOTH)
def test_moments_have_the_parameters_dtype_and_the_history_float32(
    cls: Any, dtype: torch.dtype
) -> None:
    """torch's rule for the moments; pairs are differences and need the digits."""
    x = points(dtype=dtype)
    optimizer = cls([x], lr=0.01)
    run(optimizer, x, rows_of_noise(5))
    state = optimizer.state[x]
    assert {state[key].dtype for key in ("exp_avg", "exp_avg_sq")} == {dtype}
    assert state["step"].dtype == torch.float32
    assert all(value.shape[0] == 8 for key, value in state.items() if key != "step")
    if cls is LQNAdam:
        wide = torch.float64 if dtype == torch.float64 else torch.float32
        assert state["Curvature.history"].dtype == wide
    assert bool(torch.isfinite(x).all())


@pytest.mark.parametrize("cls", BOTH)
@pytest.mark.parametrize(
    ("dtype", "lr", "share"),
    [
        (torch.float64, 1e-4, 1.0),
        (torch.float32, 1e-4, 1.0),
        (torch.float32, 2e-8, 0.0),  # a unit in the last place below 1 is 6e-8, half of it 3e-8
        (torch.float16, 1e-3, 0.98),  # 4.9e-4: a step of 1e-3 is rounded to two of them
        (torch.float16, 1e-4, 0.0),
        (torch.bfloat16, 1e-2, 1.17),  # 3.9e-3: 1e-2 is rounded to three
        (torch.bfloat16, 1e-3, 0.0),
    ],
    ids=str,
)
def test_steps_below_half_a_unit_in_the_last_place_are_lost(
    cls: Any, dtype: torch.dtype, lr: float, share: float
) -> None:
    """As in torch's Adam, measured: the share of 10 steps of `lr` by which a parameter at 1 moves.

    There is no compensated sum here. Keep the parameters in float32, as every 3DGS trainer does.
    """
    moved = []
    for kind in (cls, torch.optim.Adam):
        x = points(dtype=dtype)
        run(kind([x], lr=lr, eps=1e-4), x, [torch.ones(8, 3)] * 10)
        moved.append(float((1 - x.detach().double()).max()) / (10 * lr))
    assert moved[0] == moved[1]
    assert moved[0] == pytest.approx(share, abs=0.02)  # float32's own rounding, and eps


def test_float16_needs_a_larger_eps() -> None:
    """torch's fact: 1e-8 is zero in float16, and a small gradient's square too. 0 / 0 follows."""
    ends = {}
    for eps in (1e-8, 1e-4):
        x = points(dtype=torch.float16)
        run(LQNAdam([x], lr=0.01, eps=eps), x, [torch.full((8, 3), 1e-5)] * 5)
        y = points(dtype=torch.float16)
        run(torch.optim.Adam([y], lr=0.01, eps=eps), y, [torch.full((8, 3), 1e-5)] * 5)
        assert torch.equal(x.isfinite(), y.isfinite())
        ends[eps] = bool(x.isfinite().all())
    assert ends == {1e-8: False, 1e-4: True}


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_every_dtype_goes_downhill(dtype: torch.dtype) -> None:
    x = points(50, dtype)
    hessian = hessians(50, 30.0)
    optimizer = LQNAdam([x], lr=0.02, eps=1e-4)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.97)
    for _ in range(150):
        x.grad = gradient(quadratic(hessian), x.detach().double()).to(dtype)
        optimizer.step()
        decay.step()
    left = quadratic(hessian)(x.detach().double()) / quadratic(hessian)(torch.ones(50, 3).double())
    # 150 steps decayed to 1 % of 0.02 walk 0.67 of the distance of 1: 0.3^2 of the loss, and the
    # flat axis is slower
    assert float(left.median()) < 0.25


# -- step sizes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("lr", [0.0, torch.tensor(0.0)], ids=["float", "tensor"])
@pytest.mark.parametrize("path", [{}, {"fused": True}, {"foreach": False}], ids=str)
@pytest.mark.parametrize("cls", BOTH)
def test_learning_rate_zero_moves_nothing(cls: Any, path: dict, lr: Any) -> None:
    """Equal successive positions make no pair either (s = 0), and the moments go on."""
    x = points()
    optimizer = cls([x], lr=lr, **path)
    run(optimizer, x, rows_of_noise(20))
    assert torch.equal(x, torch.ones(8, 3))
    assert bool((optimizer.state[x]["exp_avg_sq"] > 0).all())
    if cls is LQNAdam:
        assert float(header(optimizer.state[x]["Curvature.history"], 5).counter.max()) == 1.0


@pytest.mark.parametrize("path", [{}, {"fused": True}, {"foreach": False}], ids=str)
@pytest.mark.parametrize("cls", BOTH)
def test_tensor_learning_rate_is_the_number(cls: Any, path: dict) -> None:
    ends = []
    for lr in (0.01, torch.tensor(0.01)):
        x = points()
        optimizer = cls([x], lr=lr, **path)
        ends.append(run(optimizer, x, rows_of_noise(20)))
        assert optimizer.param_groups[0]["lr"] is lr
    # 0.01 in float32 is another number than in float64, by 2e-8 of it
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-5, atol=1e-7)


def test_far_from_the_origin_a_step_below_the_last_place_makes_no_pair() -> None:
    """|x| = 1e6 and steps of 1e-6: nothing moves in float32, and no curvature is made up."""
    x = points(value=1e6)
    optimizer = LQNAdam([x], lr=1e-6)
    for g in rows_of_noise(100):
        x.grad = g
        optimizer.step()
        assert float(optimizer.accepted_share or 0.0) == 0.0
    assert torch.equal(x, torch.full((8, 3), 1e6))
    assert bool(torch.isfinite(optimizer.state[x]["Curvature.history"]).all())


def test_far_from_the_origin_float64_has_the_digits() -> None:
    """1e6 with steps of 1e-6 leaves four digits for s in float64: the pairs are used."""
    x = points(dtype=torch.float64, value=1e6)
    optimizer = LQNAdam([x], lr=1e-6)
    weights = torch.tensor([1.0, 10.0, 100.0], dtype=torch.float64)
    for _ in range(20):
        x.grad = (x.detach() - 1e6 + 1e-3) * weights
        optimizer.step()
    assert float(optimizer.accepted_share or 0.0) == 1.0
    # twenty steps of 1e-6; the direction turns a little as the pairs come in
    torch.testing.assert_close(x.detach() - 1e6, torch.full_like(x, -2e-5), rtol=0.1, atol=0)


def test_identical_successive_gradients_make_no_pair() -> None:
    """y = 0: a linear function has no curvature, and the step is Adam's."""
    x, y = points(), points()
    ours, theirs = LQNAdam([x], lr=0.01), torch.optim.Adam([y], lr=0.01)
    assert torch.equal(
        run(ours, x, [torch.ones(8, 3)] * 20), run(theirs, y, [torch.ones(8, 3)] * 20)
    )
    assert float(header(ours.state[x]["Curvature.history"], 5).counter.max()) == 1.0


def test_alternating_gradients_make_no_pair_of_negative_curvature() -> None:
    """The sign changes each step: half of the differences have s.y > 0, and all are survived."""
    x = points()
    optimizer = LQNAdam([x], lr=0.01)
    run(optimizer, x, [g * (-1) ** k for k, g in enumerate([torch.ones(8, 3)] * 200)])
    history = optimizer.state[x]["Curvature.history"]
    s, y = history[:, :, :3], history[:, :, 4:7]
    assert bool(((s * y).sum(2) >= 0).all())
    assert float((x.detach() - 1).abs().max()) < 0.1  # they cancel


# -- visibility ------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.3, 0.9, 0.99])
def test_most_rows_unseen_in_each_step(share: float) -> None:
    """Zero gradients of the unseen rows make no pair; the seen ones' pairs are of seen steps."""
    rows, weights = 2_000, torch.tensor([1.0, 5.0, 25.0])
    generator = torch.Generator().manual_seed(0)
    x = points(rows)
    optimizer = LQNAdam([x], lr=0.01)
    seen = torch.zeros(rows)
    for _ in range(100):
        visible = torch.rand(rows, generator=generator) >= share
        seen += visible
        x.grad = x.detach() * weights * visible[:, None]
        optimizer.step()
    counter = header(optimizer.state[x]["Curvature.history"], 5).counter
    assert torch.equal(counter == 0, seen == 0)
    assert bool((counter <= seen).all())
    assert bool(torch.isfinite(x).all())
    assert float((x.detach() ** 2 * weights).sum()) < float((weights * rows).sum())


@pytest.mark.parametrize("steps", [1_000])
def test_all_rows_unseen_for_long(steps: int) -> None:
    """Zero gradients for 1,000 steps: moments fade, as torch's do; pairs stay, bit for bit."""
    x, y = points(), points()
    ours, theirs = LQNAdam([x], lr=0.01), torch.optim.Adam([y], lr=0.01)
    run(ours, x, [torch.ones(8, 3)] * 3)
    run(theirs, y, [torch.ones(8, 3)] * 3)
    history = ours.state[x]["Curvature.history"].clone()
    unseen = [torch.zeros(8, 3)] * steps
    assert torch.equal(run(ours, x, unseen), run(theirs, y, unseen))
    assert torch.equal(ours.state[x]["Curvature.history"], history)
    back = run(ours, x, [torch.ones(8, 3)] * 3)
    assert bool(torch.isfinite(back).all())


@pytest.mark.filterwarnings("ignore:LQNAdam:UserWarning")  # of one dimension
@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (4,), (), (3, 2, 2)], ids=str)
@pytest.mark.parametrize("cls", BOTH)
def test_any_shape_whose_first_dimension_is_points(cls: Any, shape: tuple[int, ...]) -> None:
    x = torch.nn.Parameter(torch.ones(shape))
    optimizer = cls([x], lr=0.01)
    for _ in range(3):
        x.grad = 2 * x.detach()
        optimizer.step()
    assert x.shape == shape
    assert bool((x < 1).all())


# -- everything at once ----------------------------------------------------------------------------


@pytest.mark.parametrize("problem", [*SMOOTH, *MULTIMODAL], ids=lambda p: p.name)
@pytest.mark.parametrize("cls", BOTH)
def test_every_problem_in_float32_from_its_start(cls: Any, problem: Any) -> None:
    """Gradients of 1e12 and more beside others of 1e-6: finite, and lower than at the start."""
    x = torch.nn.Parameter(problem.starts(20, torch.float32))
    x.data += 0.01 * torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    optimizer = cls([x], lr=1e-3)
    start = problem.value(x.detach().double()).median()
    for _ in range(300):
        x.grad = problem.gradient(x)
        optimizer.step()
    end = problem.value(x.detach().double())
    assert bool(torch.isfinite(end).all())
    assert float(end.median()) < float(start)
