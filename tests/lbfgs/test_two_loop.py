"""The two-loop recursion against the dense BFGS recursion, and what makes it per-point."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import dense_bfgs
from points_first import direction, header, record, stored_pairs
from torch import Tensor

from opt3dgs_optim.lbfgs import history_from_pairs, new_history, two_loop

SIZES = st.tuples(st.integers(1, 6), st.integers(1, 4), st.integers(1, 9), st.integers(0, 2**31))


def convex_pairs(k: int, d: int, n: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random s [K, N, D], y = A s with A [N, D, D] positive definite (condition about 10)."""
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn(n, d, d, generator=generator, dtype=torch.float64)
    matrix = root @ root.mT + torch.eye(d, dtype=torch.float64)
    s = torch.randn(k, n, d, generator=generator, dtype=torch.float64)
    return s, torch.einsum("nij,knj->kni", matrix, s), matrix


def dyadic(x: Tensor) -> Tensor:
    """To multiples of 2^-30: sums of a few dozen such numbers are exact in float64."""
    grid = 2.0**-30
    rounded = (x / grid).round() * grid
    return torch.where(rounded == 0, grid, rounded)  # a difference of 0 would be no pair


def gradients(n: int, d: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed + 1)
    return torch.randn(n, d, generator=generator, dtype=torch.float64)


@settings(max_examples=150, deadline=None)
@given(SIZES, st.integers(0, 9))
def test_equals_dense_bfgs(sizes: tuple[int, int, int, int], taken: int) -> None:
    """With room for K pairs, of which `taken` were: fewer, as many, or more."""
    k, d, n, seed = sizes
    s, y = map(dyadic, convex_pairs(taken, d, n, seed)[:2])
    g = gradients(n, d, seed)
    history = empty(n, d, k)
    feed(history, k, s, y)
    result = two_loop(g, history, k)
    for row in range(n):
        last_s, last_y = (each[-k:, row].numpy() for each in (s, y))
        h = dense_bfgs(last_s, last_y) if taken else np.eye(d)
        # two orders of the same float64 sums; conditioning amplifies to at most 1e4 ulp here
        np.testing.assert_allclose(result[row].numpy(), h @ g[row].numpy(), rtol=1e-9, atol=1e-9)


@settings(max_examples=100, deadline=None)
@given(SIZES)
def test_secant_equation(sizes: tuple[int, int, int, int]) -> None:
    """H y = s for the newest pair, whatever came before."""
    k, d, n, seed = sizes
    s, y, _ = convex_pairs(k, d, n, seed)
    torch.testing.assert_close(
        two_loop(y[-1], history_from_pairs(s, y), k), s[-1], rtol=1e-8, atol=1e-9
    )


@settings(max_examples=100, deadline=None)
@given(SIZES)
def test_descent(sizes: tuple[int, int, int, int]) -> None:
    k, d, n, seed = sizes
    s, y, _ = convex_pairs(k, d, n, seed)
    g = gradients(n, d, seed)
    assert bool(((two_loop(g, history_from_pairs(s, y), k) * g).sum(1) > 0).all())


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(-40, 40), st.integers(-40, 40))
def test_scale_equivariance(sizes: tuple[int, int, int, int], a: int, b: int) -> None:
    """x -> 2^a x and f -> 2^b f scale H g by 2^(a), exactly up to rounding."""
    k, d, n, seed = sizes
    s, y, _ = convex_pairs(k, d, n, seed)
    g = gradients(n, d, seed)
    plain = two_loop(g, history_from_pairs(s, y), k)
    x, f = 2.0**a, 2.0**b
    scaled = two_loop(g * f / x, history_from_pairs(s * x, y * f / x), k)
    torch.testing.assert_close(scaled, plain * x, rtol=1e-9, atol=1e-12 * x)


@settings(max_examples=60, deadline=None)
@given(SIZES)
def test_rotation_equivariance(sizes: tuple[int, int, int, int]) -> None:
    k, d, n, seed = sizes
    s, y, _ = convex_pairs(k, d, n, seed)
    g = gradients(n, d, seed)
    rotation = torch.linalg.qr(gradients(d, d, seed + 7)).Q
    plain = two_loop(g, history_from_pairs(s, y), k)
    turned = two_loop(g @ rotation, history_from_pairs(s @ rotation, y @ rotation), k)
    torch.testing.assert_close(turned, plain @ rotation, rtol=1e-8, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(SIZES)
def test_points_do_not_see_each_other(sizes: tuple[int, int, int, int]) -> None:
    k, d, n, seed = sizes
    s, y, _ = convex_pairs(k, d, n, seed)
    g = gradients(n, d, seed)
    history = history_from_pairs(s, y)
    order = torch.randperm(n, generator=torch.Generator().manual_seed(seed))
    whole = two_loop(g, history, k)
    # other rows, other SIMD lanes: equal to rounding
    torch.testing.assert_close(
        two_loop(g[order], history[order], k), whole[order], rtol=1e-13, atol=0
    )


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(1, 16))
def test_partly_filled_is_a_shorter_history(sizes: tuple[int, int, int, int], room: int) -> None:
    k, d, n, seed = sizes
    size = min(k + room, 16)
    s, y = map(dyadic, convex_pairs(k, d, n, seed)[:2])
    g = gradients(n, d, seed)
    roomy = empty(n, d, size)
    feed(roomy, size, s, y)
    torch.testing.assert_close(
        two_loop(g, roomy, size), two_loop(g, history_from_pairs(s, y), k), rtol=1e-12, atol=1e-13
    )


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(1, 40))
def test_ring_keeps_the_newest_pairs(sizes: tuple[int, int, int, int], more: int) -> None:
    k, d, n, seed = sizes
    s, y = map(dyadic, convex_pairs(k + more, d, n, seed)[:2])
    g = gradients(n, d, seed)
    ring = empty(n, d, k)
    feed(ring, k, s, y)
    last = history_from_pairs(s[-k:], y[-k:])
    assert torch.equal(two_loop(g, ring, k), two_loop(g, last, k))


def empty(n: int, d: int, size: int) -> Tensor:
    history = new_history(torch.zeros(n, d, dtype=torch.float64), size)
    header(history, size).steps.fill_(1)
    return history


def feed(history: Tensor, size: int, s: Tensor, y: Tensor) -> None:
    """Record pairs the way an optimizer does: positions and gradients that differ by s and y.

    Of dyadic s and y: then their differences are s and y to the last digit.
    """
    n, d = s.shape[1:]
    history.zero_()
    x, g = torch.zeros(n, d, dtype=s.dtype), torch.zeros(n, d, dtype=s.dtype)
    visible = torch.ones(n, dtype=torch.bool)
    record(history, size, x, g, visible, min_cosine=0.0)
    for k in range(s.shape[0]):
        x, g = x + s[k], g + y[k]
        record(history, size, x, g, visible, min_cosine=0.0)


def test_grafting_keeps_the_gradients_length() -> None:
    s, y, _ = convex_pairs(4, 3, 20, 3)
    g = gradients(20, 3, 3) * 10.0 ** torch.arange(-10, 10, dtype=torch.float64).unsqueeze(1)
    history = history_from_pairs(s * 1e-3, y)
    grafted = direction(g, history, 4, graft=True)
    torch.testing.assert_close(grafted.norm(dim=1), g.norm(dim=1), rtol=1e-12, atol=0)
    free = direction(g, history, 4, graft=False)
    torch.testing.assert_close(free, two_loop(g, history, 4))


@pytest.mark.parametrize("exponent", [-36, -30, -20, 0, 20, 29])
def test_no_overflow_or_underflow_in_float32(exponent: int) -> None:
    """Gradients from 1e-36 to 1e29: s.y and y.y themselves would leave the range."""
    s, y, _ = convex_pairs(5, 3, 50, 11)
    g = gradients(50, 3, 5)
    size = 10.0**exponent
    expected = direction(g, history_from_pairs(s, y), 5, graft=True)
    history = history_from_pairs((s * 1e-4).float(), (y * size).float())
    result = direction((g * size).float(), history, 5, graft=True)
    assert bool(torch.isfinite(result).all())
    # float32 inputs, condition about 100
    torch.testing.assert_close(result.double() / size, expected, rtol=1e-3, atol=1e-3)


def test_record_rejects_negative_curvature_and_equal_points() -> None:
    visible = torch.ones(4, dtype=torch.bool)
    history = new_history(torch.zeros(4, 3), 5)
    x0, g0 = torch.zeros(4, 3), torch.ones(4, 3)
    accepted, candidates = record(history, 5, x0, g0, visible, min_cosine=1e-6)
    assert not candidates.any()
    x1 = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0]])
    y = torch.tensor([[2.0, 0, 0], [-2, 0, 0], [1, 0, 0], [0, 0, 0]])
    accepted, candidates = record(history, 5, x1, g0 + y, visible, min_cosine=1e-6)
    assert candidates.all()
    assert accepted.tolist() == [True, False, False, False]


def test_acceptance_is_relative_not_absolute() -> None:
    """torch's LBFGS asks for s.y > 1e-10; the pairs of a splat have s.y of 1e-13."""
    visible = torch.ones(1, dtype=torch.bool)
    history = new_history(torch.zeros(1, 3), 5)
    record(history, 5, torch.zeros(1, 3), torch.full((1, 3), 1e-6), visible, min_cosine=1e-6)
    accepted, _ = record(
        history, 5, torch.full((1, 3), 1e-7), torch.full((1, 3), 2e-6), visible, min_cosine=1e-6
    )
    assert accepted.all()


def test_invisible_rows_keep_their_history() -> None:
    torch.manual_seed(0)
    s, y, _ = convex_pairs(3, 3, 6, 0)
    history = history_from_pairs(s, y)
    before = history.clone()
    visible = torch.tensor([True, False] * 3)
    record(history, 3, gradients(6, 3, 1), gradients(6, 3, 2), visible, min_cosine=0.0)
    assert torch.equal(history[~visible], before[~visible])
    assert not torch.equal(history[visible], before[visible])


def test_no_pair_turns_the_step_around() -> None:
    """Whatever is written by hand, H is a sum of squares."""
    history = new_history(torch.zeros(50, 3, dtype=torch.float64), 5)
    generator = torch.Generator().manual_seed(0)
    for vectors in stored_pairs(history, 5):
        vectors.copy_(torch.randn(5, 50, 3, generator=generator))
    g = gradients(50, 3, 0)
    found = direction(g, history, 5, graft=False)
    assert bool(((found * g).sum(1) > 0).all())
    assert not bool((found == g).all(1).any())


@pytest.mark.parametrize("poison", [float("nan"), float("inf")])
def test_poisoned_history_falls_back_to_the_gradient(poison: float) -> None:
    s, y, _ = convex_pairs(5, 3, 4, 0)
    history = history_from_pairs(s, y)
    history[1, 2, 0] = poison
    g = gradients(4, 3, 0)
    result = direction(g, history, 5, graft=True)
    assert torch.equal(result[1], g[1])
    assert bool(torch.isfinite(result).all())


@pytest.mark.parametrize("n", [0, 1])
def test_no_points_and_one_point(n: int) -> None:
    g = torch.ones(n, 3)
    history = new_history(g, 5)
    visible = torch.ones(n, dtype=torch.bool)
    record(history, 5, g, g, visible, min_cosine=0.0)
    assert direction(g, history, 5, graft=True).shape == (n, 3)


# -- which pairs are kept, and what is refused -----------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(SIZES, st.integers(0, 2**31))
def test_pairs_that_describe_no_curvature_are_left_out(
    sizes: tuple[int, int, int, int], which: int
) -> None:
    """A point has those of its pairs that are left, as if the others had never been given."""
    k, d, n, seed = sizes
    s, y, _ = convex_pairs(k, d, n, seed)
    generator = torch.Generator().manual_seed(which)
    kind = torch.randint(0, 6, (k, n), generator=generator)
    y[kind == 0] *= -1
    y[kind == 1] = 0.0
    s[..., 0][kind == 2] = torch.nan
    y[..., -1][kind == 3] = torch.inf
    g = gradients(n, d, seed)
    history = history_from_pairs(s, y)
    found = two_loop(g, history, k)
    for row in range(n):
        good = kind[:, row] > 3
        count = int(good.sum())
        assert int((stored_pairs(history, k)[0][:, row] != 0).any(1).sum()) == count
        if count == 0:
            torch.testing.assert_close(found[row], g[row], rtol=1e-15, atol=0)  # one rounding each
        else:
            fewer = history_from_pairs(s[good, row, None], y[good, row, None])
            expected = two_loop(g[row, None], fewer, count)[0]
            # other SIMD lanes: equal to rounding
            torch.testing.assert_close(found[row], expected, rtol=1e-12, atol=1e-14)


def test_a_pair_at_right_angles_is_left_out() -> None:
    s, y = torch.tensor([[[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]])[:, None]
    history = history_from_pairs(s, y)
    assert not bool(history.any())
    assert torch.equal(two_loop(y[0], history, 1), y[0])


def test_a_gradient_that_is_not_finite_is_nan_and_the_others_are_not() -> None:
    s, y, _ = convex_pairs(3, 3, 4, 0)
    g = gradients(4, 3, 0)
    expected = two_loop(g, history_from_pairs(s, y), 3)
    g[1, 2], g[2, 0] = torch.nan, -torch.inf
    found = two_loop(g, history_from_pairs(s, y), 3)
    assert bool(found[1:3].isnan().all())
    assert torch.equal(found[[0, 3]], expected[[0, 3]])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_the_result_has_the_gradients_dtype_and_no_graph(dtype: torch.dtype) -> None:
    s, y, _ = convex_pairs(3, 3, 4, 0)
    g = gradients(4, 3, 0).to(dtype)
    history = history_from_pairs(s.to(dtype).requires_grad_(), y.to(dtype))
    assert (history.dtype, history.requires_grad) == (dtype, False)
    before = history.clone()
    found = two_loop(g.requires_grad_(), history, 3)
    assert (found.dtype, found.requires_grad) == (dtype, False)
    assert torch.equal(history, before)


def refused(call: Any, error: type[Exception], message: str, *given: Any) -> None:
    with pytest.raises(error, match=message) as caught:
        call(*given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("grad", "error", "message"),
    [
        (None, TypeError, r"two_loop: grad is None, but a tensor of float32 or float64 is needed"),
        (torch.ones(4, 3).long(), TypeError, r"grad is \(4, 3\) torch\.int64 on cpu, but a tensor"),
        (torch.ones(4, 3).half(), TypeError, r"torch\.float16 on cpu, but a tensor of float32"),
        (torch.ones(4, 3).bfloat16(), TypeError, r"torch\.bfloat16 on cpu, but a tensor of"),
        (torch.ones(4), ValueError, r"grad is \(4,\) .*, but \[N, D\] with D at least 1"),
        (torch.ones(4, 3, 1), ValueError, r"grad is \(4, 3, 1\) torch\.float32 on cpu, but"),
        (torch.ones(4, 0), ValueError, r"grad is \(4, 0\) torch\.float32 on cpu, but"),
        (torch.ones(5, 3), ValueError, r"history is \(4, 4, 8\) .* but \(5, 4, 8\) .* history_si"),
        (
            torch.ones(4, 3).double(),
            ValueError,
            r"history is .*, but \(4, 4, 8\) torch\.float64",
        ),
        (torch.ones(4, 3, device="meta"), ValueError, "on cpu, but .* on meta is needed"),
    ],
    ids=lambda value: None if isinstance(value, Tensor) else str(value)[:30],
)
def test_a_wrong_gradient_is_named(grad: Any, error: type[Exception], message: str) -> None:
    history = new_history(torch.ones(4, 3), 4)
    refused(two_loop, error, message, grad, history, 4)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda h: None, "two_loop: history is None, but"),
        (
            lambda h: h.half(),
            r"history is \(4, 5, 8\) torch\.float16 on cpu, but \(4, 5, 8\)",
        ),
        (lambda h: h[:, :4], r"history is \(4, 4, 8\) .*, but \(4, 5, 8\) .* for history_size=5"),
        (lambda h: h[0], r"history is \(5, 8\) .*, but \(4, 5, 8\)"),
    ],
)
def test_a_wrong_history_is_named(spoil: Any, message: str) -> None:
    history = new_history(torch.ones(4, 3), 5)
    refused(two_loop, ValueError, message, torch.ones(4, 3), spoil(history), 5)


@pytest.mark.parametrize("size", [0, -1, 5.0, "5", True, None])
def test_a_wrong_number_of_pairs_is_named(size: Any) -> None:
    history = new_history(torch.ones(4, 3), 5)
    message = f"two_loop: history_size={size!r}, but an integer at least 1 is needed"
    refused(two_loop, ValueError, message, torch.ones(4, 3), history, size)


@pytest.mark.parametrize(
    ("s", "y", "error", "message"),
    [
        ([1.0], [1.0], TypeError, r"history_from_pairs: s is \[1\.0\], but a tensor of float32"),
        (
            torch.ones(2, 4, 3),
            None,
            ValueError,
            r"y is None, but \(2, 4, 3\) torch\.float32",
        ),
        (torch.ones(4, 3), torch.ones(4, 3), ValueError, r"s is \(4, 3\) .*, but \[K, N, D\] with"),
        (torch.ones(0, 4, 3), torch.ones(0, 4, 3), ValueError, r"s is \(0, 4, 3\) .*, but \[K,"),
        (torch.ones(2, 4, 0), torch.ones(2, 4, 0), ValueError, r"s is \(2, 4, 0\) .*, but \[K,"),
        (torch.ones(2, 4, 3), torch.ones(2, 3, 3), ValueError, r"y is \(2, 3, 3\) torch\.float32"),
        (torch.ones(2, 4, 3), torch.ones(2, 4, 3).double(), ValueError, r"y is .* torch\.float64"),
        (torch.ones(1, 1, 1), torch.ones(1, 1, 1, device="meta"), ValueError, "y is .* on meta"),
    ],
    ids=lambda value: None if isinstance(value, Tensor) else str(value)[:30],
)
def test_wrong_pairs_are_named(s: Any, y: Any, error: type[Exception], message: str) -> None:
    refused(history_from_pairs, error, message, s, y)


def test_no_points_have_a_history() -> None:
    none = torch.ones(5, 0, 3)
    assert history_from_pairs(none, none).shape == (0, 5, 8)
    assert two_loop(none[0], history_from_pairs(none, none), 5).shape == (0, 3)
