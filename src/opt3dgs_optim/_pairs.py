"""Arithmetic of curvature pairs in pure torch, coordinates first.

Everything here works on [D, N] tensors whose rows are contiguous: component by component, torch is
several times faster on them than on [N, D]. `curvature` holds the same things for points first.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import threshold


class Pair(NamedTuple):
    """A candidate curvature pair, both vectors divided by |y|."""

    s: Tensor  # [D, N]
    y: Tensor  # [D, N], unit length (zero where the gradients were equal)
    cosine: Tensor  # [N] s.y / (|s| |y|); 0 where s or y is zero, NaN where they are not finite


def dot(a: Iterable[Tensor], b: Iterable[Tensor]) -> Tensor:
    """a.b of every point, [N]; a and b are [D, N], or the D coordinates."""
    (first_a, first_b), *others = zip(a, b, strict=True)
    total = first_a * first_b
    for x, y in others:
        total = torch.addcmul(total, x, y)
    return total


def length(x: Tensor) -> Tensor:
    """Euclidean norm of every point without overflow or underflow, [N]; 1 for a zero vector."""
    largest = x.abs().amax(0)
    scaled = x / threshold(largest, 0.0, 1.0)
    return threshold(largest * dot(scaled, scaled).sqrt(), 0.0, 1.0)


def normalised_pair(s: Tensor, y: Tensor) -> Pair:
    """Divide a pair by |y|, without overflow or underflow on the way."""
    size = length(y)
    s, y = s / size, y / size
    return Pair(s, y, dot(s / length(s), y))


def damped_pair(pair: Pair, gamma: Tensor) -> Pair:
    """Powell's damping with B = 1 / gamma; gamma is [N], 0 where there is no pair yet."""
    sy = dot(pair.s, pair.y)
    known = threshold(gamma, 0.0, 1.0)
    s_bs = dot(pair.s, pair.s) / known
    low = (gamma > 0) & (sy < 0.2 * s_bs)
    theta = torch.where(low, 0.8 * s_bs / (s_bs - sy), 1.0)
    damped = normalised_pair(pair.s, theta * pair.y + (1 - theta) * (pair.s / known))
    return Pair(*(torch.where(low, new, old) for new, old in zip(damped, pair, strict=True)))


def two_loop(grad: Tensor, s: Tensor, y: Tensor, gamma_clamp: tuple[float, float] | None) -> Tensor:
    """The recursion of `curvature.two_loop`, [D, N], for gradients of moderate size.

    Nocedal and Wright (2006), algorithm 7.4; its formulas are in `curvature.two_loop`.

    Args:
        grad: [D, N].
        s: [K, D, N], newest first, zero where there is no pair.
        y: [K, D, N], unit length where there is a pair.
        gamma_clamp: see `curvature.two_loop`.

    Returns:
        The pseudo-gradient H g, in the parameters' units; the gradient where there is no pair.
    """
    # One [N] tensor per coordinate: a compiler makes a single loop of it, and torch alone is no
    # slower than on [D, N].
    pairs = [(s_j.unbind(), y_j.unbind()) for s_j, y_j in zip(s, y, strict=True)]
    q = list(grad.unbind())
    alphas, inverses = [], []
    for s_j, y_j in pairs:  # the first loop, newest to oldest
        # No pair: 1 / inf = 0.
        inverse = threshold(dot(s_j, y_j), 0.0, torch.inf).reciprocal()
        alpha = dot(s_j, q) * inverse
        q = [torch.addcmul(a, alpha, b, value=-1) for a, b in zip(q, y_j, strict=True)]
        alphas.append(alpha)
        inverses.append(inverse)
    gamma = _initial_scaling(*pairs[0], gamma_clamp)
    r = [a * gamma for a in q]
    # The second loop, oldest to newest.
    for (s_j, y_j), alpha, inverse in zip(
        reversed(pairs), reversed(alphas), reversed(inverses), strict=True
    ):
        change = alpha - dot(y_j, r) * inverse
        r = [torch.addcmul(a, change, b) for a, b in zip(r, s_j, strict=True)]
    return torch.stack(r)


def _initial_scaling(
    s: Iterable[Tensor], y: Iterable[Tensor], gamma_clamp: tuple[float, float] | None
) -> Tensor:
    """|y| = 1, hence gamma = s.y / y.y = s.y. No pair: gamma = 1, and r stays the gradient."""
    sy = dot(s, y)
    gamma = threshold(sy, 0.0, 1.0)
    return gamma if gamma_clamp is None else torch.where(sy > 0, gamma.clamp(*gamma_clamp), gamma)
