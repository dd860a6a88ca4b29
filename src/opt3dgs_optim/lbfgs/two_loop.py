"""The L-BFGS two-loop recursion on the curvature pairs of every point."""

from __future__ import annotations

import torch
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.backend import uses_kernel
from opt3dgs_optim.lbfgs.columns import columns, row_chunks
from opt3dgs_optim.lbfgs.history import check_history, stored_pairs
from opt3dgs_optim.lbfgs.pairs import dot


def two_loop(grad: Tensor, history: Tensor, history_size: int) -> Tensor:
    """The pseudo-gradient H g of every point, by the L-BFGS two-loop recursion.

    Nocedal and Wright, Numerical Optimization (2006), algorithm 7.4, on N points at once:

        q = g;  for j = newest .. oldest:  alpha_j = (s_j . q) / (s_j . y_j);  q -= alpha_j y_j
        r = gamma q;  for j = oldest .. newest:  beta = (y_j . r) / (s_j . y_j);
                                                 r += (alpha_j - beta) s_j

    with gamma = s.y / y.y of the newest pair. H does not change when s and y of a pair are scaled
    together, so pairs are stored with |y| = 1 and no product leaves the floating-point range.

    Points of three coordinates on a GPU are a CUDA kernel's, where it can run (`backend_info`).

    Args:
        grad: [N, D] gradients, any finite size.
        history: [N, slots, 2 (D + 1)], as `history_from_pairs` makes one.
        history_size: K, the number of pairs there is room for.

    Returns:
        [N, D], in the parameters' units; the search direction is its negative. A point without
        pairs gets its gradient back.

    Raises:
        ValueError: the shapes do not fit.
    """
    check_history("two_loop", grad, history, history_size)
    same = history.dtype == grad.dtype and history.device == grad.device and grad.shape[1] == 3
    if same and not torch.compiler.is_compiling() and uses_kernel("auto", grad.device, grad.dtype):
        return cuda.two_loop(grad, history, history_size)
    result = torch.empty_like(grad)
    for rows in row_chunks(grad):
        unit, scale = scaled(columns(grad[rows], history.dtype))
        result[rows] = (recursion(unit, *stored_pairs(history[rows], history_size)) * scale).T
    return result


def scaled(grad: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients [D, N] over their largest component, and that [N]: keeps s.q finite."""
    scale = torch.threshold(grad.abs().amax(0), 0.0, 1.0)
    return grad / scale, scale


def recursion(grad: Tensor, s: Tensor, y: Tensor) -> Tensor:
    """`two_loop` for gradients of moderate size, coordinates first.

    Args:
        grad: [D, N].
        s: [K, D, N], newest first, zero where there is no pair.
        y: [K, D, N], unit length where there is a pair.

    Returns:
        The pseudo-gradient H g [D, N], in the parameters' units; the gradient where there is no
        pair.
    """
    sy = dot(s, y)
    inverses = torch.threshold(sy, 0.0, torch.inf).reciprocal()  # no pair: 1 / inf = 0
    pairs = list(zip(s.unbind(), y.unbind(), inverses.unbind(), strict=True))
    q, alphas = grad.clone(), []
    for s_j, y_j, inverse in pairs:  # the first loop, newest to oldest
        alpha = dot(s_j, q) * inverse
        q.addcmul_(alpha, y_j, value=-1)
        alphas.append(alpha)
    # |y| = 1, hence gamma = s.y / y.y = s.y. No pair: gamma = 1, and r stays the gradient.
    r = q.mul_(torch.threshold(sy[0], 0.0, 1.0))
    # The second loop, oldest to newest.
    for (s_j, y_j, inverse), alpha in zip(reversed(pairs), reversed(alphas), strict=True):
        beta = dot(y_j, r).mul_(inverse)
        r.addcmul_(alpha.sub_(beta), s_j)
    return r
