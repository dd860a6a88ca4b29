"""The two steps of this package, written out on tensors: slow, plain, torch only.

`default_step` is one iteration of `PhaseScheduler(total)`, `paper_step` one of
`PhaseScheduler.paper(total)`, around torch's Adam. docs/algorithms/reference-step.md reads them
with the paper, and tests/test_reference_step.py holds the package to them, bit for bit on a CPU.

Arguments of both:

    params: the Gaussians' tensors by gsplat's names, points first, in the order in which they are
        stepped, means first. They are changed in place.
    grads: the gradients of the loss, of the same names and shapes.
    state: {} at the start. It holds all that the steps remember.
    rates: the learning rates of this iteration, by the same names.
    iteration: the number of this iteration, from 0.
    total: the number of iterations of the training.

A step is made only after a loss that is finite. Numbers in a gradient that are not count as zero.
"""

import torch
from torch import Tensor

Tensors = dict[str, Tensor]
BETA1, BETA2, EPS = 0.9, 0.999, 1e-15  # as the 3DGS trainers set them
K = 5  # curvature pairs of a point


def adam_(target: Tensor, grad: Tensor, own: dict, rate: float) -> None:
    """Add a step of torch.optim.Adam to `target`, in place; `own` holds the moments."""
    own["step"] += 1
    own["exp_avg"].lerp_(grad, 1 - BETA1)
    own["exp_avg_sq"].mul_(BETA2).addcmul_(grad, grad, value=1 - BETA2)
    root = own["exp_avg_sq"].sqrt() / (1 - BETA2 ** own["step"]) ** 0.5
    target.addcdiv_(own["exp_avg"], root + EPS, value=-rate / (1 - BETA1 ** own["step"]))


def new_moments(param: Tensor) -> dict:
    """Adam's state of a parameter that has not been stepped."""
    zeros = torch.zeros_like(param)
    return {"step": 0, "exp_avg": zeros, "exp_avg_sq": zeros.clone()}


# -- the default step ------------------------------------------------------------------------------


def default_step(
    params: Tensors,
    grads: Tensors,
    state: dict,
    rates: dict,
    iteration: int,
    total: int,
    *,
    own_frame: bool = False,
) -> None:
    """Fading, OutOfView and Averaging around Adam; with `own_frame`, OwnFrame too."""
    num_points = len(params["means"])
    grads = {name: grad.nan_to_num(0.0, 0.0, 0.0) for name, grad in grads.items()}
    # Those of dropped iterations come with the next one.
    events = range(state.get("events", 0), events_before(iteration + 1, total))
    state["events"] = events.stop
    # A point is out of view if its position has no gradient. The share of those in view is a mean
    # over the last 100 views or so, of which one in four is looked at, and at most 2,048 points.
    in_view = grads["means"].any(1)
    seen = in_view[:: 1 + num_points // 2_048]
    kept = state.setdefault("share", torch.tensor(1.0))
    share, now = kept.item(), int(seen.sum()) / len(seen)
    if now > 0 and (iteration + 1) * (5**0.5 - 1) / 2 % 1 < 1 / 4:
        share += 1 / 25 * (max(now, 0.01) - share)
        kept.fill_(share)

    for name, param in params.items():
        grad, own = grads[name], state.setdefault(name, new_moments(param))

        # Fading: the moments of a random fifth of the points are shrunk, the same in all tensors.
        # Of more than 10,000 points, fewer of the events happen. Own frames are left alone.
        thinning = min(1.0, 10_000 / num_points) ** (2 / 3)
        in_own_frame = own_frame and name == "means"
        for event in () if in_own_frame else events:
            if int((event + 1) * thinning) > int(event * thinning):
                generator = torch.Generator().manual_seed(event)
                chosen = torch.rand(num_points, generator=generator) < 0.2
                own["exp_avg"][chosen] *= 0.2
                own["exp_avg_sq"][chosen] *= 0.04

        # OutOfView: where views see less than a third of the points, regularisers make no full
        # steps of a point out of view, but about 3 share of one: its second moment is kept large.
        if name in ("scales", "opacities") and share < 1 / 3:
            least = (grad * (1 / 3 / share)).square()
            larger = torch.maximum(own["exp_avg_sq"], least)
            own["exp_avg_sq"][~in_view] = larger[~in_view]

        # OwnFrame: a position is stepped by B z, with Adam's step z in the Gaussian's own frame, in
        # standard deviations. A full step has 0.1 of them at the start and 0.001 at the end. An
        # axis counts as no thinner than a tenth of the longest.
        if in_own_frame:
            q, deviations = own_axes(params["quats"], params["scales"])
            z = torch.zeros_like(param)
            rate = rates[name] * (0.1 * 0.01 ** (iteration / total) / rates[name])
            adam_(z, (rotated(q, grad.T, -1) * deviations).T.contiguous(), own, rate)  # B^T g
            param.add_(rotated(q, z.T * deviations, 1).T)  # B z
        else:
            adam_(param, grad, own, rates[name])

        # Averaging: the mean of the iterates of the last thirtieth of the training, which takes the
        # parameter's place in the last tenth of that.
        left, window = total - iteration, int(total * (1 / 30))
        if left <= window:
            count = own["count"] = own.get("count", 0) + 1
            mean = own.setdefault("mean", torch.zeros_like(param))
            mean.lerp_(param, 1 / torch.tensor(float(count)))
            if left <= max(2, window / 10):
                param.copy_(mean)


def events_before(iteration: int, total: int) -> int:
    """Fading's events before an iteration: 300 in 3 to 50 % of the run, at least 4 apart."""
    length = 0.5 - 0.03
    share = min(max((iteration / total - 0.03) / length, 0.0), 1.0)
    return int(share * min(300, length * total / 4))


def own_axes(quats: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
    """Of B = R diag(s) of every Gaussian: the quaternion [4, N] of its rotation R, and s [3, N].

    The quaternion is of length sqrt(2), so that products of two components are doubled.
    """
    q, deviations = quats.T, scales.T.exp()
    size = q[0] * q[0]
    for component in q[1:]:
        size = torch.addcmul(size, component, component)
    q = q * (size.sqrt().clamp(min=1e-12).reciprocal() * 2**0.5)
    return q, torch.maximum(deviations, deviations.amax(0) * 0.1)


def rotated(q: Tensor, v: Tensor, direction: int) -> Tensor:
    """R v of vectors [3, N], or R^T v where the direction is -1: v + w t + a x t with t = a x v."""
    w, a = q[0], q[1:]
    t = add_cross(torch.zeros_like(v), a, v)
    return add_cross(torch.addcmul(v, w, t, value=direction), a, t)


def add_cross(total: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """The total [3, N] and the cross product a x b."""
    following, before = [1, 2, 0], [2, 0, 1]
    total = torch.addcmul(total, a[following], b[before])
    return torch.addcmul(total, a[before], b[following], value=-1)


# -- the paper's step ------------------------------------------------------------------------------


def paper_step(
    params: Tensors,
    grads: Tensors,
    state: dict,
    rates: dict,
    iteration: int,
    total: int,
    energy: Tensor,
) -> None:
    """AW-SGLD's drift, then LQNAdam: Opt3DGS with the settings of `PhaseScheduler.paper`.

    energy: the loss of this iteration, 0-d.
    """
    switch = round(total * 29_000 / 30_000)
    warmup = round(total * 2_500 / 30_000)
    multiplier = flat_histogram(state, energy, warmup) if iteration < switch else 1.0
    for name, param in params.items():
        own = state.setdefault(name, new_moments(param))
        grad = grads[name].nan_to_num(0.0, 0.0, 0.0)
        if iteration >= switch:
            if not own.setdefault("fresh", False):  # loss and direction have changed their scale
                own |= {**new_moments(param), "fresh": True}
            if name == "means":
                grad = pseudo_gradient(param, grad, own)  # the D of eq. 17
        adam_(param, grad, own, rates[name] * multiplier)  # eq. 15 and 17; the trainer adds noise


def paper_pixel_loss(error: Tensor, iteration: int, total: int) -> Tensor:
    """The photometric term: L1, and L2 after the switch."""
    exploiting = iteration >= round(total * 29_000 / 30_000)
    return error.square().mean() if exploiting else error.abs().mean()


def flat_histogram(state: dict, energy: Tensor, warmup: int) -> float:
    """The multiplier nu of an energy, then the update of the weights Theta."""
    num_partitions, low, high, zeta, tau = 200, 0.0, 0.2, 0.75, 2e-3
    width = (high - low) / num_partitions  # eq. 7: uniform partitions
    even = torch.full((num_partitions,), 1 / num_partitions, dtype=torch.float64)
    theta = state.get("theta", even)  # eq. 9, uniform at the start
    # eq. 13, counted from 0: the partition of the energy; the first and the last are open.
    j = int(torch.ceil((energy.double() - low) / width) - 1)
    j = min(max(j, 0), num_partitions - 1)
    # eq. 14; not in the paper: 1 in the open partitions, bounds of -5 and 5.
    nu = 1.0
    if 0 < j < num_partitions - 1:
        log_theta = theta.log()
        nu = 1 + zeta * tau * float(log_theta[j] - log_theta[j - 1]) / width
        nu = min(max(nu, -5.0), 5.0)
    # eq. 16, with the schedule of lambda and the floor that the paper does not give.
    count = torch.tensor(float(state.get("count", 0)), dtype=torch.float64)
    lambda_ = (10 / (count**0.8 + 100)).clamp(max=1e-2)
    rate = lambda_ * theta[j] ** zeta
    theta = theta - rate * theta
    theta[j] += rate
    theta = theta.clamp(min=1e-8)
    state["theta"], state["count"] = theta / theta.sum(), int(count) + 1
    return nu if state["count"] > warmup else 1.0


def pseudo_gradient(position: Tensor, grad: Tensor, own: dict) -> Tensor:
    """H g of every point, with its gradient's length, after the point's new pair has been taken."""
    zeros = torch.zeros_like(grad)
    x, g, s, y = own.get("pairs", (zeros, zeros, [zeros] * K, [zeros] * K))
    visible, before = grad.any(1), own.get("visible_before", zeros.any(1))

    # The pair between this visible step of a point and its last one, divided by |y|.
    new_s, new_y = position - x, grad - g
    size = length(new_y)
    new_s, new_y = new_s / size, new_y / size
    cosine = dot(new_s / length(new_s), new_y)
    accepted = (visible & before & (cosine > 1e-6))[:, None]
    s = [torch.where(accepted, new, old) for new, old in zip([new_s, *s], s, strict=False)]
    y = [torch.where(accepted, new, old) for new, old in zip([new_y, *y], y, strict=False)]
    x, g = (torch.where(visible[:, None], *each) for each in ((position, x), (grad, g)))
    own["pairs"], own["visible_before"] = (x, g, s, y), visible | before

    # Divided by its largest component, the gradient keeps all products in float32.
    scale = largest(grad)
    scale = torch.where(scale > 0, scale, 1.0)[:, None]
    unit = grad / scale
    result = two_loop(unit, s, y)
    size = length(result)
    descends = dot(unit, result / size) > 0
    result = result * (dot(unit, unit).sqrt()[:, None] / size) * scale  # graft
    usable = descends & (dot(s[0], y[0]) > 0) & (largest(result) < torch.inf)
    return torch.where(usable[:, None], result, grad)


def two_loop(grad: Tensor, s: list[Tensor], y: list[Tensor]) -> Tensor:
    """H g by Nocedal and Wright (2006), algorithm 7.4.

    s, y: the pairs of every point, K of [N, 3], newest first; |y| = 1, and 0 where there is none.
    """
    sy = [dot(*pair) for pair in zip(s, y, strict=True)]
    rho = [torch.where(each > 0, 1 / each, 0.0) for each in sy]
    q, alpha = grad, []
    for s_j, y_j, rho_j in zip(s, y, rho, strict=True):  # newest to oldest
        alpha.append(dot(s_j, q) * rho_j)
        q = torch.addcmul(q, alpha[-1][:, None], y_j, value=-1)
    gamma = torch.where(sy[0] > 0, sy[0], 1.0)  # s.y / y.y of the newest pair
    r = gamma[:, None] * q
    for s_j, y_j, rho_j, alpha_j in reversed(list(zip(s, y, rho, alpha, strict=True))):
        beta = dot(y_j, r) * rho_j
        r = torch.addcmul(r, (alpha_j - beta)[:, None], s_j)
    return r


def dot(a: Tensor, b: Tensor) -> Tensor:
    """The scalar product of every point's two vectors [N, 3], [N]."""
    xy = torch.addcmul(a[:, 0] * b[:, 0], a[:, 1], b[:, 1])
    return torch.addcmul(xy, a[:, 2], b[:, 2])


def largest(a: Tensor) -> Tensor:
    """The largest component of every point's vector [N, 3], [N]."""
    return a.abs().amax(1)


def length(a: Tensor) -> Tensor:
    """The length of every point's vector [N, 3], [N, 1]; 1 for a zero vector, to divide by."""
    size = largest(a)[:, None]
    scaled = a / torch.where(size > 0, size, 1.0)
    result = dot(scaled, scaled).sqrt()[:, None] * size
    return torch.where(result > 0, result, 1.0)
