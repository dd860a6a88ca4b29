"""The recursion against the dense one, and its step against one point at a time in numpy."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import dense_bfgs
from torch import Tensor

from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history, two_loop

F64 = torch.float64
SIZES = st.tuples(st.integers(1, 6), st.integers(1, 4), st.integers(1, 9), st.integers(0, 2**31))


def convex_pairs(k: int, d: int, n: int, seed: int) -> tuple[Tensor, Tensor]:
    """Random s [K, N, D], y = A s with A [N, D, D] positive definite (condition about 10)."""
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(n, d, d, generator=generator, dtype=F64)
    matrix = root @ root.mT + torch.eye(d, dtype=F64)
    s = torch.randn(k, n, d, generator=generator, dtype=F64)
    return s, torch.einsum("nij,knj->kni", matrix, s)


def gradients(n: int, d: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed + 1)
    return torch.randn(n, d, generator=generator, dtype=F64)


@settings(max_examples=150, deadline=None)
@given(SIZES, st.integers(0, 2**31))
def test_equals_dense_bfgs(sizes: tuple[int, int, int, int], which: int) -> None:
    """Over those of a point's pairs that describe curvature, as if the others had not been given.

    A third have negative curvature or none, or are not finite: points hold none to K pairs.
    """
    k, d, n, seed = sizes
    s, y = convex_pairs(k, d, n, seed)
    kind = torch.randint(0, 12, (k, n), generator=torch.Generator().manual_seed(which))
    y[kind == 0] *= -1
    y[kind == 1] = 0.0
    s[..., 0][kind == 2] = torch.nan
    y[..., -1][kind == 3] = torch.inf
    g = gradients(n, d, seed)
    found = two_loop(g, history_from_pairs(s, y), k)
    for row in range(n):
        good = kind[:, row] > 3
        h = dense_bfgs(s[good, row].numpy(), y[good, row].numpy()) if good.any() else np.eye(d)
        # two orders of the same float64 sums; conditioning amplifies to at most 1e4 ulp here
        np.testing.assert_allclose(found[row].numpy(), h @ g[row].numpy(), rtol=1e-9, atol=1e-9)


# -- a step ----------------------------------------------------------------------------------------


@dataclass
class Point:
    """One point's history, as the docstring of `lqn_direction` tells it."""

    size: int
    min_cosine: float
    position: np.ndarray | None = None
    gradient: np.ndarray | None = None
    pairs: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)  # oldest first

    def step(self, x: np.ndarray, g: np.ndarray, graft: bool) -> tuple[Any, bool, bool]:
        """(fed, accepted, candidate)."""
        if not np.isfinite(g).all() or not g.any():  # not visible
            return g, False, False
        accepted, candidate = False, self.position is not None
        if self.position is not None and self.gradient is not None:
            s, y = x - self.position, g - self.gradient
            length = np.linalg.norm(s) * np.linalg.norm(y)
            accepted = bool(length > 0 and s @ y > self.min_cosine * length)
            if accepted:
                self.pairs = [*self.pairs, (s, y)][-self.size :]
        self.position, self.gradient = x, g
        if not self.pairs:
            return g, accepted, candidate
        s, y = (np.array(v) for v in zip(*self.pairs, strict=True))
        fed = dense_bfgs(s, y) @ g
        length = np.linalg.norm(g) / np.linalg.norm(fed) if graft else 1.0
        return fed * length, accepted, candidate


@pytest.mark.parametrize("graft", [True, False])
@pytest.mark.parametrize(("size", "dim"), [(1, 1), (1, 3), (2, 2), (3, 3), (4, 3), (5, 3), (6, 4)])
def test_every_point_is_its_own_history(size: int, dim: int, graft: bool) -> None:
    """Of functions with some negative curvature; a fifth of the gradients is zero or not finite."""
    rows, steps, generator = 15, 3 * size + 6, torch.Generator().manual_seed(10 * size + dim)
    hessian = torch.randn(rows, dim, dim, generator=generator, dtype=F64)
    hessian = hessian @ hessian.mT - 0.3 * torch.eye(dim, dtype=F64)
    x = torch.randn(steps, rows, dim, generator=generator, dtype=F64)
    g = torch.einsum("nij,knj->kni", hessian, x)
    unseen = torch.rand(steps, rows, generator=generator)
    g[unseen < 0.2] = 0.0
    g[..., -1][unseen < 0.1] = math.nan
    g[..., 0][unseen < 0.05] = -math.inf
    history = new_history(x[0], size)
    points, rejected = [Point(size, 0.05) for _ in range(rows)], 0
    for k in range(steps):
        found = lqn_direction(x[k], g[k], history, size, min_cosine=0.05, graft=graft)
        for row, (fed, *said) in enumerate(zip(*found, strict=True)):
            expected, *flags = points[row].step(x[k, row].numpy(), g[k, row].numpy(), graft)
            assert [bool(each) for each in said] == flags
            rejected += flags == [False, True]
            # pairs of a cosine of 0.05 and more, in float64
            np.testing.assert_allclose(fed.numpy(), expected, rtol=1e-6, atol=1e-8)
            if not points[row].pairs:  # every bit: scaling there and back would round
                assert torch.equal(fed.nan_to_num(9.0), g[k, row].nan_to_num(9.0))
    assert rejected > 0
    assert max(len(point.pairs) for point in points) == size


def test_a_pair_at_right_angles_is_none() -> None:
    """The bound itself is not enough."""
    s, y = torch.tensor([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]])[:, None]
    history = history_from_pairs(s, y)
    assert not bool(history.any())
    assert torch.equal(two_loop(y[0], history, 1), y[0])
    _, accepted, candidates = lqn_direction(s[0], y[0], history, 1, min_cosine=0.0, graft=True)
    assert not bool(accepted | candidates)
    found = lqn_direction(2 * s[0], y[0] + y[0], history, 1, min_cosine=0.0, graft=True)
    assert torch.equal(torch.stack(found[1:]), torch.tensor([[False], [True]]))


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_poisoned_history_falls_back_to_the_gradient(poison: float) -> None:
    s, y = convex_pairs(5, 3, 4, 0)
    history, g = history_from_pairs(s, y), gradients(4, 3, 0)
    history[1, 2, 0] = poison
    fed, *_ = lqn_direction(g, g, history, 5, min_cosine=0.0, graft=True)
    assert torch.equal(fed[1], g[1])
    assert bool(torch.isfinite(fed).all())


# -- numbers ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("small", [1e-35, 0.0])
def test_components_of_all_sizes_in_one_gradient(small: float) -> None:
    """Divided by the largest: by the smallest, float32 would overflow."""
    s = torch.randn(4, 20, 3, generator=torch.Generator().manual_seed(2)) * 1e8
    y = s * 1e-8 * torch.tensor([1.0, 2.0, 3.0])
    grad = torch.tensor([3e37, 1.0, small]).repeat(20, 1)
    found = two_loop(grad, history_from_pairs(s, y * 1e8), 4)
    expected = two_loop(grad.double(), history_from_pairs(s.double(), y.double() * 1e8), 4)
    # float32: four pairs, of cosines of 0.9 and more
    torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e32)


def test_gradients_too_small_for_products() -> None:
    """Pairs of much curvature are short: their product with the gradient has no digits left."""
    s = torch.tensor([[[0.0, 1e-9, 0.0]], [[1.0, 0.0, 0.0]]])
    y = torch.tensor([[[0.0, 1.0, 0.5]], [[1.0, 0.0, 0.0]]])
    grad, history = torch.ones(1, 3), history_from_pairs(s, y)
    expected = two_loop(grad.double(), history_from_pairs(s.double(), y.double()), 2)
    found = two_loop(1e-36 * grad, history, 2)
    torch.testing.assert_close(found.double() * 1e36, expected, rtol=1e-6, atol=1e-6)


def test_a_direction_beyond_float32_leaves_the_gradient() -> None:
    """Long along x, and as long as a gradient of three components of 3e38."""
    y = torch.eye(3)[:2, None]
    s = y * torch.tensor([1e3, 1e-3]).reshape(2, 1, 1)
    history = history_from_pairs(torch.cat([s[:1], s]), torch.cat([y[:1], y]))
    grad = torch.full((1, 3), 3e38)
    fed, *_ = lqn_direction(grad, grad, history, 3, min_cosine=1e-6, graft=True)
    assert torch.equal(fed, grad)


def test_a_gradient_that_is_not_finite_is_nan_and_the_others_are_not() -> None:
    history, g = history_from_pairs(*convex_pairs(3, 3, 4, 0)), gradients(4, 3, 0)
    expected = two_loop(g, history, 3)
    g[1, 2], g[2, 0] = torch.nan, -torch.inf
    found = two_loop(g, history, 3)
    assert bool(found[1:3].isnan().all())
    assert torch.equal(found[[0, 3]], expected[[0, 3]])


@pytest.mark.parametrize("dtype", [torch.float32, F64], ids=str)
def test_the_result_has_the_gradients_dtype_and_no_graph(dtype: torch.dtype) -> None:
    s, y = (each.to(dtype) for each in convex_pairs(3, 3, 4, 0))
    history = history_from_pairs(s.requires_grad_(), y)
    before = history.clone()
    found = two_loop(gradients(4, 3, 0).to(dtype).requires_grad_(), history, 3)
    for each in (found, history):
        assert (each.dtype, each.requires_grad) == (dtype, False)
    assert torch.equal(history, before)


# -- what is refused -------------------------------------------------------------------------------

ONES, PAIRS = torch.ones(4, 3), torch.ones(2, 4, 3)
HISTORY = new_history(ONES, 4)


@pytest.mark.parametrize(
    ("call", "given", "error", "message"),
    [
        (two_loop, (None, HISTORY, 4), TypeError, "grad is None, but a tensor of float32 or float"),
        (two_loop, (ONES.half(), HISTORY, 4), TypeError, r"grad is \(4, 3\) torch\.float16 on cpu"),
        (two_loop, (ONES[0], HISTORY, 4), ValueError, r"\(3,\) .*, but \[N, D\] with D at least 1"),
        (two_loop, (ONES, HISTORY, 5), ValueError, r"but \(4, 5, 8\) .* for history_size=5"),
        (two_loop, (ONES.double(), HISTORY, 4), ValueError, r"but \(4, 4, 8\) torch\.float64"),
        (two_loop, (ONES, HISTORY.to("meta"), 4), ValueError, "on meta, but .* on cpu is needed"),
        (two_loop, (ONES, HISTORY, 0), ValueError, "history_size=0, but an integer at least 1"),
        (history_from_pairs, ([1.0], [1.0]), TypeError, r"s is \[1\.0\], but a tensor of float32"),
        (history_from_pairs, (ONES, ONES), ValueError, r"s is \(4, 3\) .*, but \[K, N, D\] with"),
        (history_from_pairs, (PAIRS[:0], PAIRS[:0]), ValueError, r"s is \(0, 4, 3\) .*, but \[K,"),
        (history_from_pairs, (PAIRS, PAIRS.double()), ValueError, r"y is .* torch\.float64"),
    ],
)
def test_what_does_not_fit_is_named(call: Any, given: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        call(*given)
    assert str(caught.value).startswith(f"{call.__name__}: ")
    assert "\n" not in str(caught.value)
