"""The two-loop recursion on the pairs of every point, and one step of it for Adam."""

import torch
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.checks import check_choice
from opt3dgs_optim.lbfgs.backend import BACKENDS, Backend, obstacle
from opt3dgs_optim.lbfgs.history import Cells, cells_of, check_alike, check_history, take_pairs
from opt3dgs_optim.lbfgs.pairs import (
    columns,
    dot,
    largest,
    length,
    power_of_two,
    put,
    row_chunks,
)


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

    On an NVIDIA GPU where `backend_info` says that kernels run, points of three coordinates with at
    most five pairs take one CUDA kernel. All else, and what `torch.compile` traces, is pure torch.
    Both give the same numbers up to rounding. Nothing waits for the GPU. The result has no autograd
    graph.

    Args:
        grad: [N, D] gradients of N points of D coordinates, float32 or float64, of any finite size,
            in units of the loss per unit of the parameters.
        history: [N, slots, 2 (D + 1)] of the gradient's dtype, as `history_from_pairs` makes it. It
            is not changed.
        history_size: K, the number of pairs that the history has room for, at least 1. For D
            coordinates, histories of D and of D + 1 pairs have the same shape, which does not tell
            them apart.
        backend: `"auto"` takes the CUDA kernel where it can run; `"cuda"` and `"torch"` insist.

    Returns:
        [N, D] of the gradient's dtype and device, in the parameters' units; the search direction is
        its negative. A point without pairs gets its gradient back. A point whose gradient is not
        finite gets NaN.

    Raises:
        TypeError: the gradient is no tensor of float32 or float64.
        ValueError: the history does not fit the gradient, or an option is not allowed.
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
    history_size = check_history("two_loop", grad, history, history_size)
    # torch.compile cannot trace the kernel's launch, and makes kernels of its own.
    auto = grad.is_cuda and not torch.compiler.is_compiling()
    if by_kernel("two_loop", grad, history_size, backend, auto):
        return cuda.two_loop(grad, history, history_size)
    result = torch.empty_like(grad)
    with torch.no_grad():
        for rows in row_chunks(grad):
            (g,) = columns(grad[rows])
            # keeps s.q finite
            scale = torch.threshold_(power_of_two(largest(g)), 0.0, 1.0)
            cells = Cells(cells_of(history, rows), history_size)
            put(result[rows], recursion(g / scale, cells).mul_(scale))
    return result


def by_kernel(call: str, grad: Tensor, history_size: int, backend: str, auto: bool) -> bool:
    """Whether the CUDA kernel runs; `auto`: whether `backend="auto"` may take it here.

    Raises:
        ValueError: `backend` is none of `BACKENDS`.
        RuntimeError: the kernel was insisted on, and cannot run.
    """
    if backend not in BACKENDS:
        check_choice(call, "backend", backend, BACKENDS)
    if not auto and backend != "cuda":
        return False
    return obstacle(backend, grad.device, grad.shape[1], history_size) is None


def recursion(grad: Tensor, cells: Cells) -> Tensor:
    """`two_loop` for gradients [D, N] of moderate size, in place.

    s.y = 1 where there is a pair, and s = y = 0 where there is none.
    """
    vectors = cells.pairs.flatten(0, 1).unbind()
    pairs = list(zip(vectors[::2], vectors[1::2], strict=True))
    newest = pairs[0][1]
    # s.y = 1, hence gamma = 1 / y.y. No pair: gamma = 1, and r stays the gradient.
    inverse_gamma = torch.threshold(dot(newest, newest), 0.0, 1.0)
    r, alphas = grad, []
    for s, y in pairs:  # newest to oldest
        alphas.append(dot(s, r))
        r.addcmul_(alphas[-1], y, value=-1)
    r.div_(inverse_gamma)
    for s, y in reversed(pairs):
        r.addcmul_(alphas.pop().sub_(dot(y, r)), s)
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
    call = "lqn_direction"
    history_size = check_history(call, grad, history, history_size)
    check_alike(call, "position", position, grad, grad.shape)
    if by_kernel(call, grad, history_size, backend, grad.is_cuda):
        return cuda.lqn_direction(position, grad, history, history_size, min_cosine, graft)
    fed = torch.empty_like(grad, memory_format=torch.contiguous_format)
    flags = torch.empty(2, grad.shape[0], dtype=torch.bool, device=grad.device)
    accepted, candidates = flags.unbind()
    with torch.no_grad():
        for rows in row_chunks(grad):  # while a chunk is in the cache
            seen = columns(position[rows], grad[rows])
            g = seen[1]
            size = largest(g).nan_to_num_(0.0, 0.0)
            visible = size > 0
            chunk = cells_of(history, rows)
            cells = Cells(chunk, history_size)
            take_pairs(cells, seen, visible, min_cosine, accepted[rows], candidates[rows])
            put(fed[rows], direction(g, size, cells, graft))
            history[rows] = chunk.movedim(-1, 0)
    return fed, accepted, candidates


def direction(grad: Tensor, size: Tensor, cells: Cells, graft: bool) -> Tensor:
    """What Adam is fed, [D, N] of gradients [D, N] and their largest component [N].

    `size` is 0 where the gradient is not finite. It is overwritten.
    """
    scale = power_of_two(size)
    both = grad.expand(2, *grad.shape) / scale  # keeps s.q finite
    unit, found = both.unbind()
    recursion(found, cells)
    if graft:
        lengths = length(both)
        found.mul_(lengths[0].div_(lengths[1]))  # 1 without pairs
    found.mul_(scale)
    # NaN where the gradient is zero, or either is not finite.
    descent = dot(unit, found).nan_to_num_(0.0, 0.0)
    return torch.where(descent > 0, found, grad)
