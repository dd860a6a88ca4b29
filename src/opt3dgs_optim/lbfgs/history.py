"""The history of every point: how curvature pairs lie in memory.

One point is one row, because density control edits optimizer state by rows; all zero means "no
history". Layout, [N, slots, 2 (D + 1)] for points of D coordinates and a history of K pairs:

    slot j, lanes 0 .. D-1        s, the parameter difference   } of the j-th newest pair, both
    slot j, lanes D+1 .. 2D       y, the gradient difference    } divided by |y|
    lanes D and 2D + 1            spare; the header below lives in them

The header holds the point's last visible position and gradient and a counter. With K > D it fits
into the spare lanes of slots 0 .. D (slots = K: 160 bytes per point in float32 for K = 5, D = 3);
otherwise it gets a slot of its own (slots = K + 1).

A new pair moves the older ones down: readers of a ring would have to gather. A history that torch
computes on has the strides of [slots, lanes, N], one of the CUDA kernel is contiguous; every
function here takes both.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from opt3dgs_optim.backend import obstacle
from opt3dgs_optim.lbfgs.pairs import BITS, Pair, columns, normalised_pair, overwrite

MAX_HISTORY = 16


def history_shape(points: Tensor, history_size: int) -> tuple[int, int, int]:
    """Shape of the history of `points` [N, D] for `history_size` pairs of each."""
    rows, dim = points.shape
    return rows, history_size + (history_size <= dim), 2 * (dim + 1)


def new_history(points: Tensor, history_size: int, *, contiguous: bool = False) -> Tensor:
    """An empty history for `points` [N, D], of their float64 or of float32; see `laid_out`."""
    dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
    rows, *cells = history_shape(points, history_size)
    shape = (rows, *cells) if contiguous else (*cells, rows)
    zeros = torch.zeros(shape, dtype=dtype, device=points.device)
    return zeros if contiguous else zeros.movedim(-1, 0)


def laid_out(history: Tensor, *, contiguous: bool) -> Tensor:
    """`history` itself, or a copy if it is not laid out for the kernel (contiguous), or torch."""
    if contiguous:
        return history.contiguous()
    cells = history.movedim(0, -1)
    return history if cells.is_contiguous() else cells.contiguous().movedim(-1, 0)


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
    lanes = history[:, history_size]
    return Header(lanes[:, :dim], lanes[:, dim + 1 : 2 * dim + 1], lanes[:, dim])


def check_history(call: str, grad: Tensor, history: Tensor, history_size: int) -> None:
    """Whether `history` is one of `history_size` pairs of each of the points of `grad`.

    Raises:
        TypeError: one of the two is no tensor of real floating-point numbers.
        ValueError: `grad` is not [N, D], or `history` has another shape, dtype or device than is
            needed for it.
    """
    check_real(call, "grad", grad)
    check_real(call, "history", history)
    if grad.dim() != 2 or grad.shape[1] == 0:
        raise ValueError(
            f"{call}: grad has shape {tuple(grad.shape)}, but [N, D] with D at least 1 is needed"
        )
    needed = history_shape(grad, history_size)
    if history.shape != needed:
        raise ValueError(
            f"{call}: history has shape {tuple(history.shape)}, but {list(needed)} is needed for a "
            f"gradient of shape {tuple(grad.shape)} and history_size={history_size}"
        )
    if history.dtype not in BITS:
        raise ValueError(f"{call}: history is {history.dtype}, but one of {list(BITS)} is needed")
    if history.device != grad.device:
        raise ValueError(
            f"{call}: history is on {history.device}, but {grad.device} is needed, as the gradient"
        )


def check_real(call: str, name: str, value: Any) -> None:
    """TypeError unless `value` is a tensor of real floating-point numbers."""
    if not isinstance(value, Tensor) or not value.is_floating_point():
        kind = f"a tensor of {value.dtype}" if isinstance(value, Tensor) else repr(value)
        raise TypeError(f"{call}: {name} is {kind}, but a tensor of real numbers is needed")


def stored_pairs(history: Tensor, history_size: int) -> tuple[Tensor, Tensor]:
    """s and y of the stored pairs, [K, D, N] each, newest first."""
    dim = history.shape[2] // 2 - 1
    cells = history[:, :history_size].permute(1, 2, 0)
    if cells.stride(2) != 1:
        cells = cells.contiguous()
    return cells[:, :dim], cells[:, dim + 1 : 2 * dim + 1]


def push(history: Tensor, history_size: int, pair: Pair, accept: Tensor) -> None:
    """Put a pair in front of the others, in the rows of `accept` [N] (bool), in place."""
    dim = pair.s.shape[0]
    halves = history[:, :history_size].permute(1, 2, 0).unflatten(1, (2, dim + 1))
    pairs = halves[:, :, :dim]  # [K, 2, D, N]
    first = pairs[0].unbind()
    overwrite(accept, (pairs[1:], pairs[:-1]), (first[0], pair.s), (first[1], pair.y))


def take_pairs(
    history: Tensor,
    head: Header,
    history_size: int,
    position: Tensor,
    gradient: Tensor,
    visible: Tensor,
    min_cosine: float,
) -> tuple[Tensor, Tensor]:
    """Accept a pair between two consecutive *visible* steps of each point; update the header.

    History and `head`, the views of its header, are changed in place; position and gradient are
    [D, N] before the step. Returns (accepted, candidates), [N] bool each.
    """
    last_position, last_gradient, counter = head.position.T, head.gradient.T, head.counter
    pair = normalised_pair(position - last_position, gradient - last_gradient)
    candidates = visible & (counter > 0)
    accepted = candidates & (pair.cosine > min_cosine)  # false where the pair is not finite
    push(history, history_size, pair, accepted)
    overwrite(visible, (last_position, position), (last_gradient, gradient))
    count = counter.maximum(visible.to(history.dtype)) + accepted
    counter.copy_(count.clamp(max=history_size + 1))
    return accepted, candidates


def history_from_pairs(s: Tensor, y: Tensor) -> Tensor:
    """The history of points whose curvature pairs are known, for `two_loop`.

    A pair says how the gradient of a point changes along a displacement of it, y = B s with the
    Hessian B of the point's own function. A pair with s.y > 0 is kept; for a point without one, as
    where the function is concave along s, or where a number is not finite, that pair is left out,
    and the point holds one pair less. H would not be positive definite with it. Both vectors of a
    pair are stored divided by |y|, which changes nothing: H depends on their ratio.

    Args:
        s: [K, N, D] differences of the parameters of N points of D coordinates, in the parameters'
            units. K is the number of pairs, the oldest first.
        y: [K, N, D] differences of the gradients between the same two places, in units of the loss
            per unit of the parameters.

    Returns:
        The history [N, slots, 2 (D + 1)], of K or K + 1 slots; float64 where the pairs are, else
        float32. `two_loop(grad, history, K)` reads it, with K the number of pairs that there is
        room for. It is laid out for the CUDA kernel where that can run, and for torch elsewhere;
        `two_loop` takes both.

    Raises:
        TypeError: s or y is no tensor of real floating-point numbers.
        ValueError: s is not [K, N, D] with K and D at least 1, or y has another shape, dtype or
            device.

    Examples:
        Pairs of a quadratic along all axes of its Hessian know that Hessian: H g is then the
        distance from the minimum.

        >>> import torch
        >>> from opt3dgs_optim import history_from_pairs, two_loop
        >>> hessian = torch.tensor([1.0, 10.0, 100.0])  # of x' diag(hessian) x / 2
        >>> s = torch.eye(3).unsqueeze(1)  # K = 3 pairs of N = 1 point, along the axes
        >>> history = history_from_pairs(s, hessian * s)
        >>> x = torch.tensor([[3.0, -2.0, 1.0]])
        >>> two_loop(hessian * x, history, history_size=3).round(decimals=3)
        tensor([[ 3., -2.,  1.]])
    """
    call = "history_from_pairs"
    check_real(call, "s", s)
    check_real(call, "y", y)
    if s.dim() != 3 or 0 in (s.shape[0], s.shape[2]):
        raise ValueError(
            f"{call}: s has shape {tuple(s.shape)}, but [K, N, D] with K and D at least 1 is needed"
        )
    if (y.shape, y.dtype, y.device) != (s.shape, s.dtype, s.device):
        raise ValueError(
            f"{call}: y is {tuple(y.shape)} {y.dtype} on {y.device}, but {tuple(s.shape)} "
            f"{s.dtype} on {s.device} is needed, as s is"
        )
    s, y, size = s.detach(), y.detach(), s.shape[0]
    kernel = s.is_cuda and obstacle("auto", s.device, s.dtype, s.shape[2], size) is None
    history = new_history(s[0], size, contiguous=kernel)
    counter = header(history, size).counter.fill_(1)
    for k in range(size):
        pair = normalised_pair(columns(s[k], history.dtype), columns(y[k], history.dtype))
        accepted = pair.cosine > 0  # false where it is not finite
        push(history, size, pair, accepted)
        counter.add_(accepted)
    return history
