"""Arithmetic of curvature pairs in pure torch, coordinates first.

Everything here works on [D, N] tensors whose rows are contiguous: component by component, torch is
several times faster on them than on [N, D]. `curvature` holds the same things for points first.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import threshold


class Pair(NamedTuple):
    """A candidate curvature pair, both vectors divided by |y|."""

    s: Tensor  # [D, N]
    y: Tensor  # [D, N], unit length (zero where the gradients were equal)
    cosine: Tensor  # [N] s.y / (|s| |y|); 0 where s or y is zero, NaN where they are not finite


def dot(a: Tensor, b: Tensor) -> Tensor:
    """a.b of every point, [N]."""
    return (a * b).sum(-2)


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

    Args:
        grad: [D, N].
        s: [K, D, N], newest first, zero where there is no pair.
        y: [K, D, N], unit length where there is a pair.
        gamma_clamp: see `curvature.two_loop`.
    """
    sy = dot(s, y)
    inverse_sy = threshold(sy, 0.0, torch.inf).reciprocal()  # no pair: 1 / inf = 0
    q = grad
    alphas = []
    for s_j, y_j, inverse in zip(s, y, inverse_sy, strict=True):
        alpha = dot(s_j, q) * inverse
        q = torch.addcmul(q, alpha, y_j, value=-1)
        alphas.append(alpha)
    # |y| = 1, hence gamma = s.y / y.y = s.y. No pair: gamma = 1, and r stays the gradient.
    gamma = threshold(sy[0], 0.0, 1.0)
    if gamma_clamp is not None:
        gamma = torch.where(sy[0] > 0, gamma.clamp(*gamma_clamp), gamma)
    r = q * gamma
    for j in reversed(range(s.shape[0])):
        beta = dot(y[j], r) * inverse_sy[j]
        r = torch.addcmul(r, alphas[j] - beta, s[j])
    return r
