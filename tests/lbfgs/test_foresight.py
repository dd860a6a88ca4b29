"""What curvature pairs foretell: much on quadratics, little where views differ."""

from __future__ import annotations

import pytest
import torch

from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history
from opt3dgs_optim.lbfgs import pairs as columns_of
from opt3dgs_optim.lbfgs.history import header
from opt3dgs_optim.lbfgs.two_loop import foresight

POINTS, VIEWS, STEPS = 300, 30, 150
MIN_FORESIGHT = 0.1  # below it, `adaptive` leaves the curvature out


def trained(disagree: float, own_curvature: float) -> tuple[float, float]:
    """(foresight, accepted share) over a run on quadratics of condition up to 100.

    Args:
        disagree: distance between the minima of two views.
        own_curvature: share of each view's Hessian that is its own, of rank 2.
    """
    draw = torch.Generator().manual_seed(0)
    axes = torch.linalg.qr(torch.randn(POINTS, 3, 3, generator=draw))[0]
    common = axes @ torch.diag_embed(10 ** (2 * torch.rand(POINTS, 3, generator=draw))) @ axes.mT
    slopes = torch.randn(VIEWS, POINTS, 2, 3, generator=draw)
    hessians = (1 - own_curvature) * common + own_curvature * 20 * slopes.mT @ slopes
    minima = disagree * torch.randn(VIEWS, POINTS, 3, generator=draw)
    points = torch.nn.Parameter(torch.randn(POINTS, 3, generator=draw))
    optimizer = torch.optim.Adam([points], lr=0.02, eps=1e-15)
    history = new_history(points.detach(), 5)
    seen, shares = torch.zeros(2, dtype=torch.float64), []
    for _ in range(STEPS):
        view = int(torch.randint(VIEWS, (), generator=draw))
        off = points.detach() - minima[view]
        gradient = (hessians[view] @ off[..., None])[..., 0]
        position = points.detach()
        seen += foresight(history, 5, position, gradient)
        points.grad, accepted, candidates = lqn_direction(
            position, gradient, history, 5, min_cosine=1e-6, graft=True
        )
        optimizer.step()
        shares.append(accepted.sum() / candidates.sum().clamp(min=1))
    return float(seen[0] / seen[1]), float(torch.stack(shares).mean())


def test_pairs_of_a_quadratic_foretell_the_next() -> None:
    known, share = trained(0.0, 0.0)
    assert known > 1.5 * MIN_FORESIGHT
    assert share > 0.9


@pytest.mark.parametrize(
    ("disagree", "own_curvature"), [(0.3, 0.0), (0.3, 0.3), (0.0, 1.0), (0.1, 1.0)]
)
def test_pairs_between_views_do_not(disagree: float, own_curvature: float) -> None:
    known, share = trained(disagree, own_curvature)
    assert known < 0.8 * MIN_FORESIGHT
    assert 0.45 < share < 0.65  # a coin's: the share alone would not tell


def test_exact_pairs_foretell_exactly() -> None:
    """With the newest pair once more, H y = s (the secant equation)."""
    draw = torch.Generator().manual_seed(1)
    half = torch.randn(20, 3, 3, generator=draw, dtype=torch.float64)
    hessian = half @ half.mT + torch.eye(3)
    start = torch.randn(20, 3, generator=draw, dtype=torch.float64)
    moves = torch.randn(4, 20, 3, generator=draw, dtype=torch.float64)
    gradient = lambda x: (hessian @ x[..., None])[..., 0]  # noqa: E731
    history = history_from_pairs(moves[:3], torch.stack([gradient(m) for m in moves[:3]]))
    head = header(history, 3)
    head.position.copy_(start)
    head.gradient.copy_(gradient(start))
    position = start + moves[2]
    total, points = foresight(history, 3, position, gradient(position))
    y, s = gradient(moves[2]), moves[2]
    cosine = torch.nn.functional.cosine_similarity(y, s)
    assert float(points) == 20
    torch.testing.assert_close(total, (1 - cosine).sum(), rtol=1e-9, atol=1e-9)


def test_points_without_a_pair_or_a_gradient_do_not_count() -> None:
    pairs = torch.randn(2, 10, 3, generator=torch.Generator().manual_seed(2))
    history = history_from_pairs(pairs, pairs)
    history[1] = 0.0
    head = header(history, 2)
    head.gradient.copy_(torch.full((10, 3), -1.0))
    position, gradient = torch.ones(2, 10, 3).unbind()
    gradient[2] = 0.0
    gradient[3] = torch.nan
    head.counter[4] = 1.0  # visible once
    head.counter[5] = 2.0  # one pair is enough
    head.position[6] = 1.0  # has not moved
    head.gradient[7] = 1.0  # has the gradient that it had
    head.position[8], position[8] = -3e38, 3e38  # has moved beyond float32
    total, points = foresight(history, 2, position, gradient)
    assert float(points) == 3
    counted = [0, 5, 9]
    alone, _ = foresight(history[counted], 2, position[counted], gradient[counted])
    torch.testing.assert_close(total, alone)


def test_rows_are_taken_a_chunk_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 10^7 points its intermediates would be as large as the pairs."""
    draw = torch.Generator().manual_seed(3)
    pairs = torch.randn(2, 100, 3, generator=draw, dtype=torch.float64)
    history = history_from_pairs(pairs, pairs * torch.tensor([1.0, 3.0, 9.0]))
    position, gradient = torch.randn(2, 100, 3, generator=draw, dtype=torch.float64)
    whole = foresight(history, 2, position, gradient)
    monkeypatch.setattr(columns_of, "CHUNK", 7)
    chunks = columns_of.row_chunks(gradient)
    assert (len(chunks), chunks[-1]) == (15, slice(98, 100))
    # the same 100 numbers, summed in another order
    torch.testing.assert_close(foresight(history, 2, position, gradient), whole, rtol=1e-12, atol=0)
    assert float(whole[1]) == 100
