"""Curvature pairs of every point: storage, acceptance, and the L-BFGS two-loop recursion.

One point is one row. Its history is a row of a single float tensor, because density control
edits optimizer state by rows (gathers, zeroes, appends zero rows): all zero means "no history".

Layout, [N, slots, 2 (D + 1)] for points of D coordinates and a history of K pairs:

    slot j, lanes 0 .. D-1        s, the parameter difference   } of the j-th newest pair, both
    slot j, lanes D+1 .. 2D       y, the gradient difference    } divided by |y|
    lanes D and 2D + 1            spare; the header below lives in them

The header holds the point's last visible position and gradient and a counter. With K > D it fits
into the spare lanes of slots 0 .. D (slots = K: no further memory, 160 bytes per point in float32
for K = 5, D = 3); otherwise it gets a slot of its own (slots = K + 1).

A new pair moves the older ones down a slot. A ring would write less, but every reader would have
to gather by row, which costs torch more than all the arithmetic; and the header dirties the same
memory sectors anyway. In memory, a history that torch computes on is transposed (strides of a
[slots, lanes, N] tensor), one that the CUDA kernel computes on is contiguous; every function here
takes both.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import threshold

from opt3dgs_optim import _pairs
from opt3dgs_optim._pairs import Pair, damped_pair, normalised_pair

__all__ = [
    "MAX_HISTORY",
    "Header",
    "Pair",
    "accumulate",
    "damped_pair",
    "direction",
    "epoch_mean",
    "header",
    "history_from_pairs",
    "new_history",
    "newest_gamma",
    "normalised_pair",
    "num_slots",
    "record",
    "step",
    "two_loop",
]

MAX_HISTORY = 16
CHUNK = 16384  # rows that a CPU works on at a time, so that intermediates stay in its cache


def num_slots(history_size: int, dim: int) -> int:
    """Slots of a history tensor for `history_size` pairs of points with `dim` coordinates."""
    return history_size if history_size > dim else history_size + 1


def new_history(points: Tensor, history_size: int, *, contiguous: bool = False) -> Tensor:
    """An empty history for `points` [N, D]; float32, or float64 for float64 points.

    `contiguous` is for the CUDA kernel; otherwise the memory is laid out for torch.
    """
    dim = points.shape[1]
    dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
    shape = (num_slots(history_size, dim), 2 * (dim + 1))
    if contiguous:
        return torch.zeros((points.shape[0], *shape), dtype=dtype, device=points.device)
    cells = torch.zeros((*shape, points.shape[0]), dtype=dtype, device=points.device)
    return cells.permute(2, 0, 1)


class Header(NamedTuple):
    """Views into a history tensor: what the next pair is taken against."""

    position: Tensor  # [N, D] at the last visible step
    gradient: Tensor  # [N, D] at the last visible step
    counter: Tensor  # [N] 0: never visible; c: holds c - 1 pairs


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
        history_size: K, the number of pairs there is room for.
        gamma_clamp: (low, high) bounds of gamma, in units of parameter per gradient.

    Returns:
        [N, D], in the parameters' units; the search direction is its negative. A point without
        pairs gets its gradient back.
    """
    _check_shape("two_loop", grad, history, history_size)
    result = torch.empty_like(grad)
    for rows in _chunks(grad):
        unit, scale = _scaled(_coordinates(grad[rows], history))
        s, y = _stored(history[rows], history_size)
        result[rows] = (_pairs.two_loop(unit, s, y, gamma_clamp) * scale).T
    return result


def _check_shape(call: str, grad: Tensor, history: Tensor, history_size: int) -> None:
    rows, dim = grad.shape
    needed = (rows, num_slots(history_size, dim), 2 * (dim + 1))
    if tuple(history.shape) != needed:
        raise ValueError(
            f"{call}: history has shape {tuple(history.shape)}, but {list(needed)} is needed for a "
            f"gradient of shape {tuple(grad.shape)} and history_size={history_size}"
        )


def _chunks(points: Tensor) -> Iterator[slice]:
    """Rows to work on at a time: all of them, except on a CPU without a compiler's loop fusion."""
    rows = points.shape[0]
    if points.device.type != "cpu" or torch.compiler.is_compiling() or rows == 0:
        yield slice(0, rows)
        return
    for start in range(0, rows, CHUNK):
        yield slice(start, min(start + CHUNK, rows))


def _coordinates(points: Tensor, history: Tensor) -> Tensor:
    """Points [N, D] as [D, N] in the history's dtype, rows contiguous."""
    return points.T.to(history.dtype).contiguous()


def _scaled(grad: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients [D, N] over their largest component, and that [N]: keeps s.q finite."""
    scale = threshold(grad.abs().amax(0), 0.0, 1.0)
    return grad / scale, scale


def _stored(history: Tensor, history_size: int) -> tuple[Tensor, Tensor]:
    """s and y of the stored pairs, [K, D, N] each, newest first."""
    dim = history.shape[2] // 2 - 1
    cells = history[:, :history_size].permute(1, 2, 0)
    if cells.stride(2) != 1:
        cells = cells.contiguous()
    return cells[:, :dim], cells[:, dim + 1 : 2 * dim + 1]


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
    everywhere = torch.ones(s.shape[1], dtype=torch.bool, device=s.device)
    for k in range(size):
        pair = normalised_pair(_coordinates(s[k], history), _coordinates(y[k], history))
        _push(history, size, pair, everywhere)
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
    flags = torch.empty((2, position.shape[0]), dtype=torch.bool, device=position.device)
    for rows in _chunks(position):
        part = history[rows]
        moved = _coordinates(position[rows], history), _coordinates(gradient[rows], history)
        flags[0, rows], flags[1, rows] = _record(
            part, history_size, *moved, visible[rows], min_cosine, powell
        )
    return flags[0], flags[1]


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
    accepted = candidate & (pair.cosine > min_cosine)  # false where the pair is not finite
    _push(history, history_size, pair, accepted)
    last_position.copy_(torch.where(visible, position, last_position))
    last_gradient.copy_(torch.where(visible, gradient, last_gradient))
    count = head.counter.maximum(visible.to(history.dtype)) + accepted
    head.counter.copy_(count.clamp(max=history_size + 1))
    return accepted, candidate


def newest_gamma(history: Tensor, history_size: int) -> Tensor:
    """Gamma of the newest pair, [N]; 0 where there is none."""
    s, y = _stored(history[:, :1], 1)
    return _pairs.dot(s[0], y[0])


def _push(history: Tensor, history_size: int, pair: Pair, accept: Tensor) -> None:
    """Put a pair in front of the others, in the rows of `accept` [N] (bool), in place."""
    dim = pair.s.shape[0]
    cells = history.permute(1, 2, 0)
    for first, new in ((0, pair.s), (dim + 1, pair.y)):
        lanes = cells[:, first : first + dim]
        for slot in range(history_size - 1, 0, -1):
            lanes[slot].copy_(torch.where(accept, lanes[slot - 1], lanes[slot]))
        lanes[0].copy_(torch.where(accept, new, lanes[0]))


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
    _check_shape("direction", grad, history, history_size)
    result = torch.empty_like(grad)
    for rows in _chunks(grad):
        gradient = _coordinates(grad[rows], history)
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
    result = _pairs.two_loop(unit, *_stored(history, history_size), gamma_clamp)
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
    _check_shape("lqn_direction", grad, history, history_size)
    result = torch.empty_like(grad)
    flags = torch.empty((2, grad.shape[0]), dtype=torch.bool, device=grad.device)
    for rows in _chunks(grad):
        part, gradient = history[rows], _coordinates(grad[rows], history)
        visible = torch.isfinite(gradient).all(0) & (gradient != 0).any(0)
        flags[0, rows], flags[1, rows] = _record(
            part,
            history_size,
            _coordinates(position[rows], history),
            gradient,
            visible,
            min_cosine,
            powell,
        )
        result[rows] = _direction(gradient, part, history_size, graft, gamma_clamp).T
    return result, flags[0], flags[1]


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
