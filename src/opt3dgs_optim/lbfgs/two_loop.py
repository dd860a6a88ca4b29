"""The two-loop recursion on the pairs of every point, one step of it for Adam, and its worth."""

import torch
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.backend import BACKENDS, Backend, obstacle
from opt3dgs_optim.checks import check_choice, check_count
from opt3dgs_optim.lbfgs.history import Header, check_history, header, stored_pairs, take_pairs
from opt3dgs_optim.lbfgs.pairs import (
    columns,
    dot,
    in_range_of,
    largest,
    length,
    put,
    row_chunks,
)


@torch.no_grad()
def two_loop(
    grad: Tensor, history: Tensor, history_size: int, *, backend: Backend = "auto"
) -> Tensor:
    """The pseudo-gradient H g of every point, by the L-BFGS two-loop recursion.

    H approximates the inverse of the Hessian of a point's own function, and is known only by the
    point's last K curvature pairs (s_j, y_j) of parameter and gradient differences. The recursion
    multiplies by it without ever forming it, on N points at once:

        q = g;  for j = newest .. oldest:  alpha_j = (s_j . q) / (s_j . y_j);  q -= alpha_j y_j
        r = gamma q;  for j = oldest .. newest:  beta = (y_j . r) / (s_j . y_j);
                                                 r += (alpha_j - beta) s_j

    with gamma = s.y / y.y of the newest pair. r is H g.

    Source: Nocedal and Wright, Numerical Optimization (2006), algorithm 7.4, with its equation 7.20
    for gamma. In Opt3DGS its result is the D of equation 17, -lr * Adam(D): the paper calls D the
    quasi-Newton direction, but with the minus sign it has to be the pseudo-gradient H g.
    `Curvature` and `LQNAdam` collect pairs while they train, and use it so.

    On an NVIDIA GPU, points of three coordinates with at most five pairs are one CUDA kernel, where
    `backend_info` says that kernels run and gradient and history have one dtype. All else, and what
    `torch.compile` traces, is pure torch. Both have the same numbers up to rounding. Nothing waits
    for the GPU. The result has no autograd graph.

    Args:
        grad: [N, D] gradients of N points of D coordinates, of any finite size, in units of the
            loss per unit of the parameters.
        history: [N, slots, 2 (D + 1)], float32 or float64, as `history_from_pairs` makes it. It is
            not changed. The arithmetic is in its dtype.
        history_size: K, the number of pairs that the history has room for, at least 1. Of D
            coordinates, the history of D pairs has the shape of one of D + 1: the shape does not
            tell them apart.
        backend: `"auto"` takes the CUDA kernel where it can run; `"cuda"` and `"torch"` insist.

    Returns:
        [N, D] of the gradient's dtype and device, in the parameters' units; the search direction is
        its negative. A point without pairs gets its gradient back, to rounding. A point whose
        gradient is not finite gets NaN.

    Raises:
        TypeError: gradient or history is no tensor of real floating-point numbers.
        ValueError: shapes, dtype or devices do not fit, or an option is not allowed.
        RuntimeError: `backend="cuda"`, and the kernel cannot run.

    Examples:
        The newest pair is always reproduced, H y = s:

        >>> import torch
        >>> from opt3dgs_optim import history_from_pairs, two_loop
        >>> s = torch.tensor([[[0.5, 0.0, 1.0]], [[1.0, 2.0, 0.0]]])  # [K=2, N=1, D=3]
        >>> y = s * torch.tensor([1.0, 4.0, 2.0])
        >>> history = history_from_pairs(s, y)
        >>> torch.allclose(two_loop(y[-1], history, history_size=2), s[-1])
        True
    """
    check_choice("two_loop", "backend", backend, BACKENDS)
    history_size = check_count("two_loop", "history_size", history_size, 1)
    check_history("two_loop", grad, history, history_size)
    # torch.compile cannot trace the kernel's launch, and makes kernels of its own.
    given = grad.is_cuda and history.dtype == grad.dtype and not torch.compiler.is_compiling()
    if given or backend == "cuda":
        like = grad.device, grad.dtype, grad.shape[1], history_size
        if obstacle(backend, *like) is None:
            return cuda.two_loop(grad, history, history_size)
    result = torch.empty_like(grad)
    for rows in row_chunks(grad):
        # In the wider of the two dtypes, since a gradient may be too large or small for the other.
        g = columns(grad[rows], torch.promote_types(grad.dtype, history.dtype))
        scale = torch.threshold(largest(g), 0.0, 1.0)  # keeps s.q finite
        unit = (g / scale).to(history.dtype)
        found = recursion(unit, *stored_pairs(history[rows], history_size))
        put(result[rows], found.to(g.dtype).mul_(scale))
    return result


def recursion(grad: Tensor, s: Tensor, y: Tensor) -> Tensor:
    """`two_loop` for gradients [D, N] of moderate size; pairs [K, D, N], newest first.

    |y| = 1 where there is a pair, and s = y = 0 where there is none.
    """
    sy = dot(s.unbind(1), y.unbind(1))  # [K, N]
    # |y| = 1, hence gamma = s.y / y.y = s.y. No pair: gamma = 1, and r stays the gradient.
    gamma = torch.threshold(sy[0], 0.0, 1.0)
    inverses = torch.threshold_(sy, 0.0, torch.inf).reciprocal_().unbind()  # no pair: 0
    r, alphas = grad.clone(), []
    rows, pairs = r.unbind(), list(zip(s.unbind(), y.unbind(), inverses, strict=True))
    for s_j, y_j, inverse in pairs:  # newest to oldest
        alpha = dot(s_j.unbind(), rows).mul_(inverse)
        r.addcmul_(alpha, y_j, value=-1)
        alphas.append(alpha)
    r.mul_(gamma)
    for (s_j, y_j, inverse), alpha in zip(reversed(pairs), reversed(alphas), strict=True):
        beta = dot(y_j.unbind(), rows).mul_(inverse)
        r.addcmul_(alpha.sub_(beta), s_j)
    return r


def lqn_direction(
    position: Tensor,
    grad: Tensor,
    history: Tensor,
    history_size: int,
    *,
    min_cosine: float,
    graft: bool,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:
    """The pseudo-gradient that Adam is fed (the D of eq. 17, with its sign reversed).

    First the pair between a point's last visible step and this one is put into its history, then
    `two_loop` gives the direction. A point without pairs, or whose two-loop result is not a
    descent direction or not finite, keeps its gradient bit for bit (never zero: its parameter
    difference would stay zero).

    Args:
        position: [N, D] before the step.
        grad: [N, D] there; a row that is 0 or not finite is given back, and its history stays.
        history: [N, slots, 2 (D + 1)], changed in place.
        history_size: K, 1 to 16.
        min_cosine, graft, backend: as in `Curvature`. torch LBFGS's bound is absolute, 1e-10, and
            would reject practically every pair of a splat. Without grafting the result has the
            parameters' units: its first values would own Adam's second moment for long.

    Returns:
        (fed [N, D], accepted [N] bool, candidates [N] bool): pairs taken, and that could be.
    """
    check_history("lqn_direction", grad, history, history_size)
    if position.shape != grad.shape or position.device != grad.device:
        raise ValueError(
            f"lqn_direction: position is {tuple(position.shape)} on {position.device}, but "
            f"{tuple(grad.shape)} on {grad.device} is needed, as the gradient is"
        )
    like = grad.device, grad.dtype, grad.shape[1], history_size
    if (grad.is_cuda or backend == "cuda") and obstacle(backend, *like) is None:
        return cuda.lqn_direction(position, grad, history, history_size, min_cosine, graft)
    fed = torch.empty_like(grad, memory_format=torch.contiguous_format)
    accepted = torch.empty(grad.shape[0], dtype=torch.bool, device=grad.device)
    candidates = torch.empty_like(accepted)
    for rows in row_chunks(grad):  # while a chunk is in the cache
        part, x = history[rows], columns(position[rows], history.dtype)
        g = columns(grad[rows], history.dtype)
        size = largest(g)  # NaN where the gradient has one, which is not < inf
        visible = (size > 0) & (size < torch.inf)
        head = header(part, history_size)
        taken = take_pairs(part, head, history_size, x, g, visible, min_cosine)
        accepted[rows], candidates[rows] = taken
        found = direction(g, size, part, head, history_size, graft)
        # Half precision ends where a grafted coordinate may lie.
        put(fed[rows], in_range_of(fed.dtype, found))
    return fed, accepted, candidates


def direction(
    grad: Tensor, scale: Tensor, history: Tensor, head: Header, history_size: int, graft: bool
) -> Tensor:
    """What Adam is fed, [D, N] of gradients [D, N] and their largest component [N]."""
    scale = torch.threshold(scale, 0.0, 1.0)
    unit = grad / scale  # keeps s.q finite
    result = recursion(unit, *stored_pairs(history, history_size))
    size = length(result)
    # Zero where the gradient is, NaN where the result is not finite.
    descent = dot(unit, result / size)
    usable = (head.counter > 1) & (descent > 0)
    if graft:
        result.mul_(dot(unit, unit).sqrt_().div_(size))
    result.mul_(scale)
    usable &= largest(result) < torch.inf
    return torch.where(usable, result, grad)


def foresight(history: Tensor, history_size: int, position: Tensor, gradient: Tensor) -> Tensor:
    """How much better the stored pairs foretell the pair that comes next than gamma I would.

    A pair (s, y) that a curvature matrix describes has H y = s: cos(H y, s) - cos(y, s) with H
    from the pairs before this one. It is 0 where y is mostly the difference between two views, or
    the curvature is the same in all directions: then Adam fed with the gradient does as well.

    Args:
        history: [N, slots, 2 (D + 1)] before the new pair is stored.
        history_size: K.
        position, gradient: [N, D] of this step; one that is not finite, or 0, does not count.

    Returns:
        [2] float64 (float32 on MPS): sum over the points that hold a pair, and their number.
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
