"""Curvature pairs of every point: acceptance, and the L-BFGS two-loop recursion.

See `_history` for how the pairs are stored, `_pairs` for the arithmetic of one pair.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import threshold

from opt3dgs_optim import _pairs
from opt3dgs_optim._columns import columns, row_chunks
from opt3dgs_optim._epoch import accumulate, epoch_mean
from opt3dgs_optim._history import (
    MAX_HISTORY,
    PAIR_DTYPES,
    Header,
    PairDtype,
    as_stored,
    check_history,
    header,
    history_shape,
    laid_out,
    new_history,
    newest_gamma,
    num_slots,
    push,
    stored_pairs,
)
from opt3dgs_optim._pairs import Pair, damped_pair, normalised_pair

__all__ = [
    "MAX_HISTORY",
    "PAIR_DTYPES",
    "Header",
    "Pair",
    "PairDtype",
    "accumulate",
    "check_history",
    "damped_pair",
    "direction",
    "epoch_mean",
    "header",
    "history_from_pairs",
    "history_shape",
    "laid_out",
    "new_history",
    "newest_gamma",
    "normalised_pair",
    "num_slots",
    "record",
    "step",
    "two_loop",
]


def two_loop(
    grad: Tensor,
    history: Tensor,
    history_size: int,
    *,
    gamma_clamp: tuple[float, float] | None = None,
) -> Tensor:
    """The pseudo-gradient H g of every point, by the L-BFGS two-loop recursion.

    Nocedal and Wright, Numerical Optimization (2006), algorithm 7.4, on N points at once:

        q = g;  for j = newest .. oldest:  alpha_j = (s_j . q) / (s_j . y_j);  q -= alpha_j y_j
        r = gamma q;  for j = oldest .. newest:  beta = (y_j . r) / (s_j . y_j);
                                                 r += (alpha_j - beta) s_j

    with gamma = s.y / y.y of the newest pair. H does not change when s and y of a pair are scaled
    together, so pairs are stored with |y| = 1 and no product leaves the floating-point range.

    Args:
        grad: [N, D] gradients, any finite size.
        history: [N, slots, 2 (D + 1)], see the module's docstring; `history_from_pairs` makes one.
        history_size: K, the number of pairs there is room for.
        gamma_clamp: (low, high) bounds of gamma, in units of parameter per gradient.

    Returns:
        [N, D], in the parameters' units; the search direction is its negative. A point without
        pairs gets its gradient back.
    """
    check_history("two_loop", grad, history, history_size)
    result = torch.empty_like(grad)
    for rows in row_chunks(grad):
        unit, scale = _scaled(columns(grad[rows], history.dtype))
        s, y = stored_pairs(history[rows], history_size)
        result[rows] = (_pairs.two_loop(unit, s, y, gamma_clamp) * scale).T
    return result


def _scaled(grad: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients [D, N] over their largest component, and that [N]: keeps s.q finite."""
    scale = threshold(grad.abs().amax(0), 0.0, 1.0)
    return grad / scale, scale


def history_from_pairs(s: Tensor, y: Tensor, *, pair_dtype: PairDtype = "float32") -> Tensor:
    """A history tensor of K given pairs per point, oldest first.

    Args:
        s: [K, N, D] parameter differences.
        y: [K, N, D] gradient differences, with s.y > 0.
        pair_dtype: "float32" or "bfloat16"; see `LQNAdam`.

    Returns:
        A history for `two_loop(grad, history, history_size=K)`.
    """
    size = s.shape[0]
    history = new_history(s[0], size, pair_dtype=pair_dtype)
    everywhere = torch.ones(s.shape[1], dtype=torch.bool, device=s.device)
    for k in range(size):
        pair = normalised_pair(columns(s[k], history.dtype), columns(y[k], history.dtype))
        push(history, size, as_stored(history, pair), everywhere)
    header(history, size).counter.fill_(size + 1)
    return history


def record(
    history: Tensor,
    history_size: int,
    position: Tensor,
    gradient: Tensor,
    visible: Tensor,
    *,
    min_cosine: float,
    powell: bool = False,
) -> tuple[Tensor, Tensor]:
    """Take this step's positions and gradients: accept a pair per point, update the header.

    A pair is taken between two consecutive *visible* steps of a point; what happens to a point
    while it is not visible leaves its history as it is.

    Args:
        history: [N, slots, 2 (D + 1)], changed in place.
        history_size: K.
        position: [N, D] before the step.
        gradient: [N, D] there.
        visible: [N] bool; a point with a zero or a non-finite gradient is not visible.
        min_cosine: a pair is accepted if s.y > min_cosine |s| |y|. Relative: an absolute bound
            such as torch LBFGS's 1e-10 would reject practically every pair of a splat.
        powell: damp a pair of too little curvature (Powell 1978; Nocedal and Wright, procedure
            18.2, with B = 1 / gamma of the newest pair) instead of rejecting it.

    Returns:
        (accepted, candidates), [N] bool each.
    """
    accepted = torch.empty(position.shape[0], dtype=torch.bool, device=position.device)
    candidates = torch.empty_like(accepted)
    for rows in row_chunks(position):
        part = history[rows]
        moved = columns(position[rows], history.dtype), columns(gradient[rows], history.dtype)
        accepted[rows], candidates[rows] = _record(
            part, history_size, *moved, visible[rows], min_cosine, powell
        )
    return accepted, candidates


def _record(
    history: Tensor,
    history_size: int,
    position: Tensor,  # [D, N], as is the gradient
    gradient: Tensor,
    visible: Tensor,
    min_cosine: float,
    powell: bool,
) -> tuple[Tensor, Tensor]:
    head = header(history, history_size)
    last_position, last_gradient = head.position.T, head.gradient.T
    pair = normalised_pair(position - last_position, gradient - last_gradient)
    candidate = visible & (head.counter > 0)
    if powell:
        pair = damped_pair(pair, newest_gamma(history, history_size))
    pair = as_stored(history, pair)
    accepted = candidate & (pair.cosine > min_cosine)  # false where the pair is not finite
    push(history, history_size, pair, accepted)
    last_position.copy_(torch.where(visible, position, last_position))
    last_gradient.copy_(torch.where(visible, gradient, last_gradient))
    count = head.counter.maximum(visible.to(history.dtype)) + accepted
    head.counter.copy_(count.clamp(max=history_size + 1))
    return accepted, candidate


def direction(
    grad: Tensor,
    history: Tensor,
    history_size: int,
    *,
    graft: bool,
    gamma_clamp: tuple[float, float] | None = None,
) -> Tensor:
    """The pseudo-gradient that Adam is fed, [N, D] (the D of eq. 17, with its sign reversed).

    A point without pairs, or whose two-loop result is not a descent direction or not finite,
    keeps its gradient bit for bit (never zero: its parameter difference would stay zero).

    Args:
        grad: [N, D] gradients.
        history: [N, slots, 2 (D + 1)].
        history_size: K.
        graft: give each point's result the length of its gradient. The two-loop result has the
            parameters' units; in Adam, its first values would otherwise own the second moment
            for a thousand iterations.
        gamma_clamp: see `two_loop`.
    """
    check_history("direction", grad, history, history_size)
    result = torch.empty_like(grad)
    for rows in row_chunks(grad):
        gradient = columns(grad[rows], history.dtype)
        result[rows] = _direction(gradient, history[rows], history_size, graft, gamma_clamp).T
    return result


def _direction(
    grad: Tensor,  # [D, N]
    history: Tensor,
    history_size: int,
    graft: bool,
    gamma_clamp: tuple[float, float] | None,
) -> Tensor:
    unit, scale = _scaled(grad)
    result = _pairs.two_loop(unit, *stored_pairs(history, history_size), gamma_clamp)
    size = _pairs.length(result)
    # Zero where the gradient is, NaN where the result is not finite.
    descent = _pairs.dot(unit, result / size)
    usable = (header(history, history_size).counter > 1) & (descent > 0)
    if graft:
        result = result * (_pairs.dot(unit, unit).sqrt() / size)
    result = result * scale
    usable = usable & torch.isfinite(_pairs.dot(result, torch.zeros_like(result)))
    return torch.where(usable, result, grad)


def step(
    position: Tensor,
    grad: Tensor,
    history: Tensor,
    history_size: int,
    *,
    min_cosine: float,
    powell: bool,
    graft: bool,
    gamma_clamp: tuple[float, float] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """`record`, then `direction`, while a chunk of rows is in the cache; see there.

    Returns:
        (direction [N, D], accepted [N], candidates [N]).
    """
    check_history("lqn_direction", grad, history, history_size)
    result = torch.empty_like(grad)
    accepted = torch.empty(grad.shape[0], dtype=torch.bool, device=grad.device)
    candidates = torch.empty_like(accepted)
    for rows in row_chunks(grad):
        part, gradient = history[rows], columns(grad[rows], history.dtype)
        visible = torch.isfinite(gradient).all(0) & (gradient != 0).any(0)
        accepted[rows], candidates[rows] = _record(
            part,
            history_size,
            columns(position[rows], history.dtype),
            gradient,
            visible,
            min_cosine,
            powell,
        )
        result[rows] = _direction(gradient, part, history_size, graft, gamma_clamp).T
    return result, accepted, candidates
