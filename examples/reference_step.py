"""The steps of this package, written out on tensors: slow, plain, torch only.

`default_step` is one iteration of `PhaseScheduler(total)`, `paper_step` one of
`PhaseScheduler.paper(total)`, around torch's Adam. docs/algorithms/reference-step.md shows this
file, and tests/test_reference_step.py holds the package to it, bit for bit on a CPU.

Arguments of both:

    params: the Gaussians' tensors by gsplat's names, points first, in the order in which they are
        stepped, means first. They are changed in place.
    grads: the gradients of the loss, by the same names. A tensor without one is not stepped.
    state: {} at the start. It holds all that the steps remember.
    rates: the learning rates of this iteration, by the same names.
    iteration: the number of this iteration, from 0.
    total: the number of iterations of the training.

Numbers in a gradient that are not finite count as zero.
"""

import torch
from torch import Tensor

Tensors = dict[str, Tensor]
BETA1, BETA2, EPS = 0.9, 0.999, 1e-15  # as the 3DGS trainers set them
K = 5  # curvature pairs of a point
COLORS = ("sh0", "shN")

# Which tensors each part acts on.
DEFAULTS = {
    "own_frame": ("means",),
    "fading": ("scales", "quats", "opacities", *COLORS),
    "out_of_view": ("scales", "opacities"),
    "averaging": ("means", "scales", "quats", "opacities", *COLORS),
}


def adam_(target: Tensor, grad: Tensor, own: dict, rate: float) -> None:
    """Add a step of torch.optim.Adam to `target`, in place; `own` holds the moments."""
    own["step"] += 1
    own["exp_avg"].lerp_(grad, 1 - BETA1)
    own["exp_avg_sq"].mul_(BETA2).addcmul_(grad, grad, value=1 - BETA2)
    target.addcdiv_(own["exp_avg"], root_of(own), value=-rate / (1 - BETA1 ** own["step"]))


def root_of(own: dict) -> Tensor:
    """What Adam divides by: the root of the second moment, with bias correction."""
    return own["exp_avg_sq"].sqrt() / (1 - BETA2 ** own["step"]) ** 0.5 + EPS


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
    parts: dict = DEFAULTS,
) -> None:
    """OwnFrame, Fading, OutOfView and Averaging around Adam, as far as `parts` has them.

    parts: by part, the tensors that it acts on.
    """
    num_points, progress = len(params["means"]), min(iteration / total, 1.0)
    for name, param in params.items():
        state.setdefault(name, {**new_moments(param), "last": iteration - 1})
    out_of_view, share = views(grads.get("means"), state, iteration)

    for name, param in params.items():
        if name not in grads:
            continue
        grad, own, rate = grads[name].nan_to_num(0.0, 0.0, 0.0), state[name], rates[name]
        in_own_frame = name in parts.get("own_frame", ())

        # Fading: the moments of a random fifth of the points are shrunk, the same in all tensors.
        # Events since the tensor's last step are one.
        done, now = (events_before(each + 1, total) for each in (own["last"], iteration))
        due = range(done, now)
        own["last"] = iteration
        if name in parts.get("fading", ()) and any(happens(event, num_points) for event in due):
            chosen = chosen_points(due[-1], num_points)
            own["exp_avg"][chosen] *= 0.2
            own["exp_avg_sq"][chosen] *= 0.04

        # OutOfView: where views see less than a third of the points, regularisers make no full
        # steps of a point out of view, but about 3 share of one: its second moment is kept large.
        if name in parts.get("out_of_view", ()) and share < 1 / 3 and out_of_view is not None:
            least = (grad * (1 / 3 / share)).square()
            larger = torch.maximum(own["exp_avg_sq"], least)
            own["exp_avg_sq"][out_of_view] = larger[out_of_view]

        # OwnFrame: a position is stepped by B z, with Adam's step z in the Gaussian's own frame, in
        # standard deviations. A full step has 0.1 of them at the start and 0.003 at the end. Where
        # a position has no gradient it stays, and so do its moments.
        if in_own_frame:
            # Thin axes count as a share of the longest, a larger one in short trainings; none as
            # longer than 6 medians of the longest axes, found every 100 iterations, unless two
            # edits in a row have left the points where they are in memory.
            least, now = min(max(3_000 / total, 0.1), 0.25), iteration // 100
            known, steady, found_in, most = state.get("bound", (param, 0, None, None))
            if known is not param:
                steady = steady + 1 if known.data_ptr() == param.data_ptr() else 0
            if steady > 1:
                found_in, most = None, torch.tensor(torch.inf)
            elif found_in != now:
                found_in, most = now, params["scales"].amax(1).nanmedian().exp() * 6
            state["bound"] = param, steady, found_in, most
            frame = own_axes(params["quats"], params["scales"], least, most)
            z, seen = torch.zeros_like(param), (grad != 0).any(1, keepdim=True)
            rate = 0.1 * 0.03**progress if rate else 0.0
            before = {key: own[key].clone() for key in ("exp_avg", "exp_avg_sq")}
            adam_in_frame_(z, into_frame(frame, grad), own, rate)
            param.sub_(torch.where(seen, out_of_frame(frame, z), 0.0))
            own |= {key: torch.where(seen, own[key], old) for key, old in before.items()}
        else:
            adam_(param, grad, own, rate)

        # Averaging: a mean of the last iterates takes the parameter's place at the end.
        if name in parts.get("averaging", ()):
            average(param, own, name == "means", iteration, total)


def views(grad: Tensor | None, state: dict, iteration: int) -> tuple[Tensor | None, float]:
    """Which points are out of view, [N] bool, and the mean share s of the points that views see.

    A point is out of view if its position has no gradient. The mean is over the last 100 views or
    so, of which one in four is looked at. A look counts two iterations later, since the number lies
    on a GPU. Points that have never had a gradient do not count.
    """
    share, (looked, due) = state.get("share", 1.0), state.get("look", (0.0, iteration))
    if iteration >= due:
        share += 1 / 25 * (max(looked, 0.01) - share) if looked > 0 else 0.0
        state.pop("look", None)
    state["share"] = share
    if grad is None or len(grad) == 0:
        return None, share
    in_view = (grad != 0).any(1)
    if "look" not in state and iteration * ((5**0.5 - 1) / 2) % 1 < 1 / 4:
        known = in_view | (state["means"]["exp_avg_sq"] != 0).any(1)
        state["look"] = int(in_view.sum()) / max(int(known.sum()), 1), iteration + 2
    return ~in_view, share


def events_before(iteration: int, total: int) -> int:
    """Fading's events before an iteration: 300 from 3 to 70 % of the run, at least 4 apart."""
    length = 0.7 - 0.03
    share = min(max((iteration / total - 0.03) / length, 0.0), 1.0)
    return int(share * min(300, length * total / 4))


def happens(event: int, num_points: int) -> bool:
    """Whether an event happens: of more than 10,000 points, fewer of them do."""
    share = max(min(1.0, 10_000 / max(num_points, 1)) ** (2 / 3), 1 / 3)
    return int((event + 1) * share) > int(event * share)


def chosen_points(event: int, num_points: int) -> Tensor:
    """Which points an event fades, [num_points] bool: the same on every device."""
    row = torch.arange(num_points)
    return (hashed(row ^ hashed(torch.tensor(event))) >> 8).float() / 2**24 < 0.2


def hashed(number: Tensor) -> Tensor:
    """32 bits that look random, of 32 bits: Wellons' `lowbias32`."""
    number = ((number ^ (number >> 16)) * 0x7FEB352D) % 2**32
    number = ((number ^ (number >> 15)) * 0x846CA68B) % 2**32
    return number ^ (number >> 16)


def own_axes(quats: Tensor, scales: Tensor, least: float, most: Tensor) -> tuple[Tensor, Tensor]:
    """B = R diag(s) of every Gaussian: the unit quaternion [4, N] of R, and s [3, N].

    An axis counts as no longer than `most`, and no thinner than `least` of the longest.
    """
    w, x, y, z = q = quats.T
    square = torch.addcmul(torch.addcmul(torch.addcmul(w * w, x, x), y, y), z, z)
    deviations = torch.minimum(scales.T.exp(), most)
    thinnest = deviations.amax(0) * least
    return q * square.sqrt().clamp(min=1e-12).reciprocal(), torch.maximum(deviations, thinnest)


def rotated(q: Tensor, v: Tensor, direction: int) -> Tensor:
    """R v of vectors [3, N], or R^T v where the direction is -1: v + w t + u x t, t = 2 u x v."""
    w, u = q[0], q[1:]
    t = cross(u, v) * (2 * direction)
    return torch.addcmul(v, w, t).add(cross(u, t), alpha=direction)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """The cross products of vectors [3, N]."""
    i, j = [1, 2, 0], [2, 0, 1]
    return torch.addcmul(a[i] * b[j], a[j], b[i], value=-1)


def into_frame(frame: tuple[Tensor, Tensor], v: Tensor) -> Tensor:
    """B^T v of vectors [N, 3]; 0 where its square is not finite."""
    turned = (rotated(frame[0], v.T, -1) * frame[1]).T.contiguous()
    return torch.where(turned.abs() <= torch.finfo(v.dtype).max ** 0.5 / 2, turned, 0.0)


def out_of_frame(frame: tuple[Tensor, Tensor], v: Tensor) -> Tensor:
    """B v of vectors [N, 3]; 0 where it is not finite."""
    turned = rotated(frame[0], v.T * frame[1], 1).T.contiguous()
    return torch.where(turned.isfinite(), turned, 0.0)


def adam_in_frame_(z: Tensor, grad: Tensor, own: dict, rate: float) -> None:
    """Adam's step z, in standard deviations, of a gradient in the own frame."""
    adam_(z, grad, own, 0.0)  # the moments
    z.copy_(own["exp_avg"] / root_of(own) * (rate / (1 - BETA1 ** own["step"])))


def average(param: Tensor, own: dict, far: bool, iteration: int, total: int) -> None:
    """Take iterates of the last thirtieth into their mean, and put it in the last tenth of that.

    Until it is put it takes every second iterate if there are 500 or more, every third if 750, ...
    far: from the origin, for the digits of float32.
    """
    window = int(1 / 30 * total)
    put, every = iteration >= total - int(max(2, window / 10)), max(1, window // 250)
    if total - window <= iteration < total and (put or own["step"] % every == 0):
        take_into_mean(param, own, own["step"] / every, far)
        if put:
            put_mean(param, own)


def take_into_mean(param: Tensor, own: dict, number: float, far: bool) -> None:
    """Take the iterate of that number, above 0, into the mean.

    Rows that the trainer has reset are zero in `began`: their mean begins with this iterate. What
    is not finite is left out. Far from the origin the mean is the sum of two numbers.
    """
    mean = own.setdefault("mean", torch.zeros_like(param))
    began = own.setdefault("began", torch.zeros(len(param), dtype=param.dtype))
    began[began == 0] = number
    weight = (1 / (number + 1 - began)).reshape(-1, *[1] * (param.dim() - 1))
    start, known = torch.where(mean.isfinite(), mean, param), param.isfinite()
    if not far:
        mean.copy_(torch.where(known, start.lerp(param, weight), mean))
        return
    rest = own.setdefault("rest", torch.zeros_like(param))
    more = torch.where(mean.isfinite(), rest, 0.0)
    more = more + ((param - start) - more) * weight
    rest.copy_(torch.where(known, more - (start + more - start), rest))
    mean.copy_(torch.where(known, start + more, mean))


def put_mean(param: Tensor, own: dict) -> None:
    """The mean takes the parameter's place."""
    param.copy_(torch.where(param.isfinite(), own["mean"], param))


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

    energy: the loss of this iteration, 0-d; one that is not finite is left out.
    """
    switch = round(total * 29_000 / 30_000)
    warmup = round(total * 2_500 / 30_000)
    if energy.isfinite():
        state["nu"] = flat_histogram(state, energy, warmup)
    multiplier = state.get("nu", 1.0) if iteration < switch else 1.0
    for name, param in params.items():
        own = state.setdefault(name, {**new_moments(param), "last": iteration - 1})
        if name not in grads:
            continue
        grad = grads[name]
        if iteration >= switch:
            if own["last"] < switch:  # loss and direction have changed their scale
                own |= new_moments(param)
            if name == "means":
                grad = pseudo_gradient(param, grad, own)  # the D of eq. 17
        own["last"] = iteration
        grad = grad.nan_to_num(0.0, 0.0, 0.0)
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
    visible = (largest(grad) > 0) & (largest(grad) < torch.inf)  # false where one is no number
    before = own.get("visible_before", zeros.any(1))

    # The pair between this visible step of a point and its last one, divided by sqrt(s.y).
    new_s, new_y = position - x, grad - g
    of_s, of_y = length(new_s), length(new_y)
    new_s, new_y = new_s / of_s, new_y / of_y
    cosine = dot(new_s, new_y)
    new_s = new_s * torch.sqrt(of_s / of_y / cosine[:, None])
    new_y = new_y * torch.sqrt(of_y / of_s / cosine[:, None])
    accepted = (visible & before & (cosine > 1e-6))[:, None]
    s = [torch.where(accepted, new, old) for new, old in zip([new_s, *s], s, strict=False)]
    y = [torch.where(accepted, new, old) for new, old in zip([new_y, *y], y, strict=False)]
    x, g = (torch.where(visible[:, None], *each) for each in ((position, x), (grad, g)))
    own["pairs"], own["visible_before"] = (x, g, s, y), visible | before

    # Divided by the power of two in its largest component, the gradient keeps its digits, and all
    # products stay in float32.
    mantissa, exponent = torch.frexp(largest(grad))
    scale = torch.ldexp(torch.ones_like(mantissa), exponent - 1)[:, None]
    unit = grad / scale
    result = two_loop(unit, s, y)
    result = result * (length(unit) / length(result))  # graft; times 1 without a pair
    result = result * scale
    descent = dot(unit, result)  # no number where the gradient is zero, or none
    usable = (descent > 0) & (descent < torch.inf)
    return torch.where(usable[:, None], result, grad)


def two_loop(grad: Tensor, s: list[Tensor], y: list[Tensor]) -> Tensor:
    """H g by Nocedal and Wright (2006), algorithm 7.4.

    s, y: the pairs of every point, K of [N, 3], newest first; s.y = 1, and 0 where there is none.
    """
    q, alpha = grad, []
    for s_j, y_j in zip(s, y, strict=True):  # newest to oldest
        alpha.append(dot(s_j, q))
        q = torch.addcmul(q, alpha[-1][:, None], y_j, value=-1)
    yy = dot(y[0], y[0])  # 1 / gamma, of the newest pair
    r = q / torch.where(yy > 0, yy, 1.0)[:, None]
    for s_j, y_j, alpha_j in reversed(list(zip(s, y, alpha, strict=True))):
        beta = dot(y_j, r)
        r = torch.addcmul(r, (alpha_j - beta)[:, None], s_j)
    return r


def dot(a: Tensor, b: Tensor) -> Tensor:
    """The scalar product of every point's two vectors [N, 3], [N]."""
    x, y, z = (a * b).unbind(1)
    return x + y + z


def largest(a: Tensor) -> Tensor:
    """The largest component of every point's vector [N, 3], [N]."""
    return a.abs().amax(1)


def length(a: Tensor) -> Tensor:
    """The length of every point's vector [N, 3], [N, 1]."""
    x, y, z = a.T.contiguous()
    return torch.hypot(torch.hypot(x, y), z)[:, None]
