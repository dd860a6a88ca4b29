"""The history of every point: how curvature pairs lie in memory.

One point is one row, because density control edits optimizer state by rows; all zero means "no
history". Layout, [N, slots, 2 (D + 1)] for points of D coordinates and a history of K pairs:

    slot j, lanes 0 .. D-1        s, the parameter difference   } of the j-th newest pair, both
    slot j, lanes D+1 .. 2D       y, the gradient difference    } divided by sqrt(s.y)
    lanes D and 2D + 1            spare; the header below lives in them

So s.y = 1, and no reader of a pair divides by it. The header holds the point's last visible
position and gradient, and the number of its visible steps. With K > D it fits into the spare lanes
of slots 0 .. D (slots = K: 160 bytes per point in float32 for K = 5, D = 3); otherwise it gets a
slot of its own (slots = K + 1).

A new pair moves the older ones down: readers of a ring would have to gather. Torch computes on a
copy of some rows, [slots, lanes, n], their cells; the CUDA kernel on the history itself.
"""

from typing import Any

import torch
from torch import Tensor

from opt3dgs_optim.checks import check_count
from opt3dgs_optim.lbfgs.pairs import BITS, bits_of, columns, normalised, overwrite

MAX_HISTORY = 16


def history_shape(points: Tensor, history_size: int) -> tuple[int, int, int]:
    """Shape of the history of `points` [N, D] for `history_size` pairs of each."""
    rows, dim = points.shape
    return rows, history_size + (history_size <= dim), 2 * (dim + 1)


def new_history(points: Tensor, history_size: int) -> Tensor:
    """An empty history for `points` [N, D], in their dtype."""
    shape = history_shape(points, history_size)
    return torch.zeros(shape, dtype=points.dtype, device=points.device)


def check_points(call: str, name: str, points: Any, dims: int) -> None:
    """Raise unless `points` is a tensor [.., D] of so many dimensions.

    Raises:
        TypeError: no tensor of float32 or float64.
        ValueError: another number of dimensions, or none of the coordinates or the pairs.
    """
    if not isinstance(points, Tensor) or points.dtype not in BITS:
        raise TypeError(
            f"{call}: {name} is {described(points)}, but a tensor of float32 or float64 is needed"
        )
    if points.dim() != dims or points.shape[-1] == 0 or (dims == 3 and len(points) == 0):
        needed = "[N, D] with D" if dims == 2 else "[K, N, D] with K and D"
        raise ValueError(
            f"{call}: {name} is {described(points)}, but {needed} at least 1 is needed"
        )


def check_alike(
    call: str, name: str, given: Any, like: Tensor, shape: tuple[int, ...], size: int | None = None
) -> None:
    """ValueError unless `given` is a tensor of `shape`, of the dtype and on the device of `like`.

    The kernel reads memory by them. `size` is the history size, if that made the shape.
    """
    needed = shape, like.dtype, like.device
    if not isinstance(given, Tensor) or (given.shape, given.dtype, given.device) != needed:
        why = "" if size is None else f" for history_size={size}"
        raise ValueError(
            f"{call}: {name} is {described(given)}, but {tuple(shape)} {like.dtype} on "
            f"{like.device} is needed{why}"
        )


def check_history(call: str, grad: Any, history: Any, history_size: int) -> int:
    """The history size K; TypeError or ValueError unless all three fit together."""
    history_size = check_count(call, "history_size", history_size, 1)
    check_points(call, "grad", grad, 2)
    check_alike(call, "history", history, grad, history_shape(grad, history_size), history_size)
    return history_size


def described(value: Any) -> str:
    """What an error says of an argument."""
    if not isinstance(value, Tensor):
        return repr(value)
    return f"{tuple(value.shape)} {value.dtype} on {value.device}"


class Cells:
    """The history of some points as torch computes on it, all views [.., N] of its memory.

    Each view is an operator; they are made once a chunk.

    Attributes:
        pairs: [K, 2, D, N], the newest first; of each s and y.
        last: position and gradient of the last visible step, [2, D, N].
        steps: [N], in which a point was visible; as floats they stop at 2^24.
    """

    def __init__(self, cells: Tensor, history_size: int) -> None:
        dim = cells.shape[1] // 2 - 1
        halves = cells.unflatten(1, (2, dim + 1))
        pairs = halves[:, :, :dim]
        if history_size > dim:
            self.pairs = pairs
            self.last = halves[:dim, :, dim].transpose(0, 1)
            self.steps = cells[dim, dim]
        else:
            self.pairs, self.last = pairs[:history_size], pairs[history_size]
            self.steps = cells[history_size, dim]


def cells_of(history: Tensor, rows: slice = slice(None)) -> Tensor:
    """The rows of `history` as [slots, 2 (D + 1), n], a copy."""
    return history.movedim(0, -1)[..., rows].contiguous()


def push(cells: Cells, vectors: Tensor, accepted: Tensor) -> None:
    """Put a pair [2, D, N] in front of the others where `accepted` (bool) says, in place."""
    bits = BITS[vectors.dtype]
    stored, new, chosen = cells.pairs.view(bits), vectors.view(bits), bits_of(accepted)
    overwrite(stored[1:], stored[:-1], chosen)
    overwrite(stored[0], new, chosen)


def take_pairs(
    cells: Cells,
    seen: Tensor,
    visible: Tensor,
    min_cosine: float,
    accepted: Tensor,
    candidates: Tensor,
) -> None:
    """Accept a pair between two consecutive *visible* steps of each point; update the header.

    `seen` [2, D, N] are position and gradient before the step, `visible` is [N] bool. `cells`,
    `accepted` and `candidates` [N] bool are changed in place.
    """
    pair = normalised(seen - cells.last)
    torch.logical_and(visible, cells.steps, out=candidates)
    # False where the pair is zero or not finite.
    torch.gt(pair.cosine, min_cosine, out=accepted).bitwise_and_(candidates)
    push(cells, pair.vectors, accepted)
    bits = BITS[seen.dtype]
    overwrite(cells.last.view(bits), seen.view(bits), bits_of(visible))
    cells.steps.add_(visible)


def history_from_pairs(s: Tensor, y: Tensor) -> Tensor:
    """The history of points whose curvature pairs are known, for `two_loop`.

    A pair says how a point's gradient changes along a displacement of it, y = B s with the Hessian
    B of the point's own function. A pair is kept if s.y > 0. Otherwise, as where the function is
    concave along s, or where a number is not finite, it is left out, and the point holds one pair
    less: with it, H would not be positive definite. Both vectors of a pair are stored divided by
    sqrt(s.y), which changes nothing: H depends on their ratio.

    Args:
        s: [K, N, D] differences of the parameters of N points of D coordinates, in the parameters'
            units. K is the number of pairs, the oldest first.
        y: [K, N, D] differences of the gradients between the same two places, in units of the loss
            per unit of the parameters.

    Returns:
        The history [N, slots, 2 (D + 1)], of K or K + 1 slots, in the dtype of the pairs.
        `two_loop(grad, history, K)` reads it, with K the number of pairs that there is room for.

    Raises:
        TypeError: s is no tensor of float32 or float64.
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
    check_points(call, "s", s, 3)
    check_alike(call, "y", y, s, s.shape)
    s, y, size = s.detach(), y.detach(), s.shape[0]
    memory = cells_of(new_history(s[0], size))
    cells = Cells(memory, size)
    for k in range(size):
        pair = normalised(columns(s[k], y[k]))
        push(cells, pair.vectors, pair.cosine > 0)  # false where it is not finite
    return memory.movedim(-1, 0).contiguous()
