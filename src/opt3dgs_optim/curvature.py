"""Curvature pairs of every point: storage, acceptance, and the L-BFGS two-loop recursion.

One point is one row. Its history is a row of a single float tensor, because density control
edits optimizer state by rows (gathers, zeroes, appends zero rows): all zero means "no history".

Layout, [N, slots, 2 (D + 1)] for points of D coordinates and a history of K pairs:

    slot j, lanes 0 .. D-1        s, the parameter difference   } of the j-th ring slot, both
    slot j, lanes D+1 .. 2D       y, the gradient difference    } divided by |y|
    lanes D and 2D + 1            spare; the header below lives in them

The header holds the point's last visible position and gradient and a counter. With K > D it fits
into the spare lanes of slots 0 .. D (slots = K: no further memory, 160 bytes per point in float32
for K = 5, D = 3); otherwise it gets a slot of its own (slots = K + 1).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

MAX_HISTORY = 16


def num_slots(history_size: int, dim: int) -> int:
    """Slots of a history tensor for `history_size` pairs of points with `dim` coordinates."""
    return history_size if history_size > dim else history_size + 1


def new_history(points: Tensor, history_size: int) -> Tensor:
    """An empty history for `points` [N, D]; float32, or float64 for float64 points."""
    dim = points.shape[1]
    dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
    shape = (points.shape[0], num_slots(history_size, dim), 2 * (dim + 1))
    return torch.zeros(shape, dtype=dtype, device=points.device)


class Header(NamedTuple):
    """Views into a history tensor: what the next pair is taken against."""

    position: Tensor  # [N, D] at the last visible step
    gradient: Tensor  # [N, D] at the last visible step
    counter: Tensor  # [N] 0: never visible; c: c - 1 pairs accepted since the row was last zeroed


def header(history: Tensor, history_size: int) -> Header:
    """The header's views into `history` [N, slots, 2 (D + 1)]."""
    dim = history.shape[2] // 2 - 1
    if history_size > dim:
        position, gradient = history[:, :dim, dim], history[:, :dim, 2 * dim + 1]
        return Header(position, gradient, history[:, dim, dim])
    slot = history[:, history_size]
    return Header(slot[:, :dim], slot[:, dim + 1 : 2 * dim + 1], slot[:, dim])


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
        history_size: K, the number of ring slots.
        gamma_clamp: (low, high) bounds of gamma, in units of parameter per gradient.

    Returns:
        [N, D], in the parameters' units; the search direction is its negative. A point without
        pairs gets its gradient back.
    """
    dim = grad.shape[1]
    needed = (grad.shape[0], num_slots(history_size, dim), 2 * (dim + 1))
    if tuple(history.shape) != needed:
        raise ValueError(
            f"two_loop: history has shape {tuple(history.shape)}, but {needed} is needed for a "
            f"gradient of shape {tuple(grad.shape)} and history_size={history_size}"
        )
    s, y, inverse_sy = _ordered_pairs(history, history_size, dim)
    # Scaling g first keeps s.q finite for gradients near the end of the floating-point range.
    scale = grad.abs().amax(dim=1).to(history.dtype)
    scale = torch.where(scale > 0, scale, 1.0)
    q = (grad.to(history.dtype) / scale.unsqueeze(1)).T
    alphas = []
    for j in range(history_size):
        alpha = (s[j] * q).sum(0) * inverse_sy[j]
        q = torch.addcmul(q, alpha, y[j], value=-1)
        alphas.append(alpha)
    # |y| = 1, hence gamma = s.y / y.y = s.y. No pair: gamma = 1, and r stays the gradient.
    newest = inverse_sy[0]
    gamma = torch.where(newest > 0, newest.reciprocal(), 1.0)
    if gamma_clamp is not None:
        gamma = torch.where(newest > 0, gamma.clamp(*gamma_clamp), gamma)
    r = q * gamma
    for j in reversed(range(history_size)):
        beta = (y[j] * r).sum(0) * inverse_sy[j]
        r = torch.addcmul(r, alphas[j] - beta, s[j])
    return (r * scale).T.to(grad.dtype)


def _ordered_pairs(history: Tensor, history_size: int, dim: int) -> tuple[Tensor, Tensor, Tensor]:
    """s, y [K, D, N] and 1 / s.y [K, N], newest first; empty slots are zero.

    Component-wise on [.., N] is several times faster than the same on [N, K, D].
    """
    n, slots, lanes = history.shape
    # Each row has its own ring: the newest pair is in slot (count - 2) mod K.
    newest = header(history, history_size).counter.long() - 2
    age = torch.arange(history_size, device=history.device).unsqueeze(1)
    slot = torch.remainder(newest - age, history_size)
    row = torch.arange(n, device=history.device) * slots
    pairs = history.reshape(n * slots, lanes)[row + slot].permute(0, 2, 1).contiguous()
    s, y = pairs[:, :dim], pairs[:, dim + 1 : 2 * dim + 1]
    sy = (s * y).sum(1)
    return s, y, torch.where(sy > 0, sy.reciprocal(), 0.0)


def history_from_pairs(s: Tensor, y: Tensor) -> Tensor:
    """A history tensor of K given pairs per point, oldest first.

    Args:
        s: [K, N, D] parameter differences.
        y: [K, N, D] gradient differences, with s.y > 0.

    Returns:
        A history for `two_loop(grad, history, history_size=K)`.
    """
    size = s.shape[0]
    history = new_history(s[0], size)
    header(history, size).counter.fill_(1)
    everywhere = torch.ones(s.shape[1], dtype=torch.bool, device=s.device)
    for k in range(size):
        pair = normalised_pair(s[k].to(history.dtype), y[k].to(history.dtype))
        _push(history, size, pair, everywhere)
    return history


class Pair(NamedTuple):
    """A candidate curvature pair, both vectors divided by |y|."""

    s: Tensor  # [N, D]
    y: Tensor  # [N, D], unit length (zero where the gradients were equal)
    cosine: Tensor  # [N] s.y / (|s| |y|); 0 where s or y is zero


def normalised_pair(s: Tensor, y: Tensor) -> Pair:
    """Divide a pair by |y|, without overflow or underflow on the way."""
    length = safe_norm(y).unsqueeze(1)
    s, y = s / length, y / length
    unit = s / safe_norm(s).unsqueeze(1)
    return Pair(s, y, (unit * y).sum(1))


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
    head = header(history, history_size)
    position, gradient = position.to(history.dtype), gradient.to(history.dtype)
    pair = normalised_pair(position - head.position, gradient - head.gradient)
    candidate = visible & (head.counter > 0)
    if powell:
        pair = damped_pair(pair, newest_gamma(history, history_size))
    accepted = candidate & (pair.cosine > min_cosine) & torch.isfinite(pair.s).all(dim=1)
    _push(history, history_size, pair, accepted)
    row = visible.unsqueeze(1)
    head.position.copy_(torch.where(row, position, head.position))
    head.gradient.copy_(torch.where(row, gradient, head.gradient))
    head.counter.copy_(torch.where(visible & (head.counter == 0), 1.0, head.counter))
    return accepted, candidate


def newest_gamma(history: Tensor, history_size: int) -> Tensor:
    """Gamma of the newest pair, [N]; 0 where there is none."""
    n, slots, lanes = history.shape
    dim = lanes // 2 - 1
    newest = torch.remainder(header(history, history_size).counter.long() - 2, history_size)
    row = torch.arange(n, device=history.device) * slots + newest
    pair = history.reshape(n * slots, lanes)[row]
    return (pair[:, :dim] * pair[:, dim + 1 : 2 * dim + 1]).sum(1)


def damped_pair(pair: Pair, gamma: Tensor) -> Pair:
    sy = (pair.s * pair.y).sum(1)
    s_bs = (pair.s * pair.s).sum(1) / torch.where(gamma > 0, gamma, 1.0)
    low = (gamma > 0) & (sy < 0.2 * s_bs)
    theta = torch.where(low, 0.8 * s_bs / (s_bs - sy), 1.0).unsqueeze(1)
    bs = pair.s / torch.where(gamma > 0, gamma, 1.0).unsqueeze(1)
    damped = normalised_pair(pair.s, theta * pair.y + (1 - theta) * bs)
    keep = ~low.unsqueeze(1)
    return Pair(
        torch.where(keep, pair.s, damped.s),
        torch.where(keep, pair.y, damped.y),
        torch.where(low, damped.cosine, pair.cosine),
    )


def _push(history: Tensor, history_size: int, pair: Pair, accept: Tensor) -> None:
    """Write a pair over the oldest one of the rows in `accept` [N] (bool), in place."""
    n, slots, lanes = history.shape
    dim = pair.s.shape[1]
    count = header(history, history_size).counter
    slot = torch.remainder(count.long() - 1, history_size)
    row = torch.arange(n, device=history.device) * slots + slot
    flat = history.view(n * slots, lanes)
    slots_now = flat[row]
    write = accept.unsqueeze(1)
    for first, new in ((0, pair.s), (dim + 1, pair.y)):
        old = slots_now[:, first : first + dim]
        old.copy_(torch.where(write, new, old))
    flat[row] = slots_now
    # The counter is a float: one turn of the ring further back means the same and keeps it small.
    count.add_(accept.to(count.dtype))
    count.sub_((count > 2 * history_size).to(count.dtype) * history_size)


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
    result = two_loop(grad, history, history_size, gamma_clamp=gamma_clamp)
    grad_length, length = safe_norm(grad), safe_norm(result)
    cosine = ((grad / grad_length.unsqueeze(1)) * (result / length.unsqueeze(1))).sum(1)
    usable = (header(history, history_size).counter > 1) & (cosine > 0)
    usable = usable & torch.isfinite(result).all(dim=1)
    if graft:
        result = result / length.unsqueeze(1) * grad_length.unsqueeze(1)
    return torch.where(usable.unsqueeze(1), result, grad)


def safe_norm(x: Tensor) -> Tensor:
    """Euclidean norm over the last dimension without overflow or underflow; 1 for a zero row."""
    largest = x.abs().amax(dim=-1)
    divisor = torch.where(largest > 0, largest, 1.0)
    length = divisor * torch.linalg.vector_norm(x / divisor.unsqueeze(-1), dim=-1)
    return torch.where(largest > 0, length, 1.0)


def accumulate(epoch: Tensor, position: Tensor, gradient: Tensor, visible: Tensor) -> None:
    """Add a step to the running means over an epoch, in place.

    Args:
        epoch: [N, 2 (D + 1)]: mean position (D), steps, mean gradient (D), visible steps.
        position: [N, D].
        gradient: [N, D].
        visible: [N] bool.
    """
    dim = position.shape[1]
    epoch[:, dim] += 1
    epoch[:, 2 * dim + 1] += visible
    # Running means, not sums: rounding stays that of one position, however long the epoch.
    weight = (visible / epoch[:, 2 * dim + 1].clamp(min=1)).unsqueeze(1)
    change = torch.where(visible.unsqueeze(1), position - epoch[:, :dim], 0.0)
    epoch[:, :dim] += weight * change
    change = torch.where(visible.unsqueeze(1), gradient - epoch[:, dim + 1 : -1], 0.0)
    epoch[:, dim + 1 : -1] += weight * change


def epoch_mean(epoch: Tensor, epoch_steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mean position [N, D], mean gradient [N, D], and [N] bool: a whole epoch, seen at least once.

    A row that was zeroed in the middle of the epoch has seen part of the views only: its means are
    those of other views than the next epoch's, and do not make a pair.
    """
    dim = epoch.shape[1] // 2 - 1
    whole = (epoch[:, dim] == epoch_steps) & (epoch[:, 2 * dim + 1] > 0)
    return epoch[:, :dim].clone(), epoch[:, dim + 1 : -1].clone(), whole
