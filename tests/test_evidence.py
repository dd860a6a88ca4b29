"""What curvature pairs foretell: much on quadratics, little where views differ."""

from __future__ import annotations

import pytest
import torch

from opt3dgs_optim import LQNAdam, lqnadam
from opt3dgs_optim._adaptive import MIN_FORESIGHT
from opt3dgs_optim._evidence import foresight
from opt3dgs_optim.curvature import header, history_from_pairs

POINTS, VIEWS, STEPS = 300, 30, 150


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
    optimizer = LQNAdam([points], lr=0.02, eps=1e-15)
    seen, shares = torch.zeros(2, dtype=torch.float64), []
    for _ in range(STEPS):
        view = int(torch.randint(VIEWS, (), generator=draw))
        off = points.detach() - minima[view]
        gradient = (hessians[view] @ off[..., None])[..., 0]
        points.grad = gradient
        history = optimizer.state[points].get(lqnadam.HISTORY)
        if history is not None:
            seen += foresight(history, 5, points.detach(), gradient)
        optimizer.step()
        if optimizer.accepted_share is not None:
            shares.append(optimizer.accepted_share)
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
    pairs = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(2))
    history = history_from_pairs(pairs, pairs)
    history[1] = 0.0
    gradient = torch.ones(6, 3)
    gradient[2] = 0.0
    gradient[3] = torch.nan
    _, points = foresight(history, 2, torch.ones(6, 3), gradient)
    assert float(points) == 3
