"""Whether the curvature pairs of a training know anything, as numbers on the device."""

import torch
from torch import Tensor

from opt3dgs_optim.lbfgs.history import header
from opt3dgs_optim.lbfgs.pairs import columns, dot, length, row_chunks
from opt3dgs_optim.lbfgs.two_loop import two_loop


def foresight(history: Tensor, history_size: int, position: Tensor, gradient: Tensor) -> Tensor:
    """How much better the stored pairs foretell the pair that comes next than gamma I would.

    A pair (s, y) that a curvature matrix describes has H y = s. The pairs know something about a
    point if H y, with H from the pairs before this one, is closer to the direction of s than y
    itself is: cos(H y, s) - cos(y, s). Where y is mostly the difference between two views, or
    where the curvature is the same in all directions, it is 0: then Adam fed with the gradient
    does as well.

    Args:
        history: [N, slots, 2 (D + 1)] before the new pair is stored.
        history_size: K.
        position, gradient: [N, D] of this step; a point counts where its gradient is finite and
            not 0.

    Returns:
        [2] float64 (float32 on MPS): sum of that difference over the points that hold a pair,
        and their number.
    """
    widest = torch.float32 if history.device.type == "mps" else torch.float64
    total = torch.zeros(2, dtype=widest, device=history.device)
    for rows in row_chunks(gradient):
        head = header(history[rows], history_size)
        s = position[rows].to(history.dtype) - head.position
        y = gradient[rows].to(history.dtype) - head.gradient
        foretold = two_loop(y, history[rows], history_size)
        vectors = (s, y, foretold, gradient[rows])
        s, y, foretold, g = (columns(each, history.dtype) for each in vectors)
        gain = _cosine(foretold, s) - _cosine(y, s)
        known = torch.isfinite(g).all(0) & (g != 0).any(0) & (head.counter > 1)
        known &= torch.isfinite(gain) & (s != 0).any(0) & (y != 0).any(0)
        total += torch.stack([torch.where(known, gain, 0.0).sum(), known.sum().to(gain.dtype)])
    return total


def _cosine(a: Tensor, b: Tensor) -> Tensor:
    return dot(a / length(a), b / length(b))
