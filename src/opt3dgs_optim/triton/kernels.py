"""The step of one parameter in one launch: what `opt3dgs_optim.step.take_step` means, line by line.

Every number is read once and written once; nothing lies between. A thread has four numbers of
`step_rows`, or two Gaussians of `step_in_own_frame`. What changes from step to step is an argument
that compiles nothing anew; what is not there is None, and compiles to nothing.
What a load gives outside of its mask is never stored. A compiler moves no load past an atomic or
a store: so `step_rows` loads what every step has above them, and waits for all of it at once.
No argument is a constexpr, so that a compiled kernel takes the same arguments in every version of
Triton. Nothing of Triton's standard library is used, so that Triton's interpreter can run this file
beside a Triton that compiles.
"""
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportOperatorIssue=false
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false
# pyright: reportPossiblyUnboundVariable=false

import triton
import triton.language as tl

INFINITY = tl.constexpr(float("inf"))
MAX_PLACE, MAX_AWAY = tl.constexpr(8388608.0), tl.constexpr(24576.0)  # as in `mean`
LARGEST = tl.constexpr(9.223371761976868e18)  # float32's in `step.LARGEST`: its square is finite
ROWS_BLOCK = tl.constexpr(1024)  # numbers of a program
TAIL_BLOCK = tl.constexpr(256)  # of them at a time in the last program
FRAME_BLOCK = tl.constexpr(128)  # Gaussians of a program
LOOK_BLOCK = tl.constexpr(1024)  # Gaussians of a program that looks at them
# Numbers of Python that a step changes; with an unknown size Triton compiles one kernel for all.
PLAIN_INTS = ["numbers", "width", "key", "round_key", "rows"]


@triton.jit
def count(bad, numbers, nonfinite, inside):
    """Count so many numbers that are not finite in each place that has any."""
    if inside is not None:
        bad = bad & inside
    tl.atomic_add(nonfinite + tl.where(bad, 0, 0), numbers, bad, sem="relaxed")


@triton.jit
def larger(a, b):
    """The larger of two, or the one that is not finite."""
    return tl.maximum(a, b, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def smaller(a, b):
    """The smaller of two, or the one that is not a number."""
    return tl.minimum(a, b, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def mixed(number, key):
    """`step.mixed` of a number and a key, 32 bits."""
    x = number.to(tl.uint32) ^ key.to(tl.uint32)
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


@triton.jit
def chosen_rows(row, key, share):
    """Whether an event fades a row: `step.chosen_rows`."""
    return (mixed(row, key) >> 8).to(tl.float32) * (1.0 / 16777216.0) < share


@triton.jit
def weight_in_mean(first, began, row, inside, number):
    """What weight an iterate has in the mean of its row; one that has not begun begins.

    `first` is the number that `began` has.
    """
    new = first == 0.0
    if inside is not None:
        new = new & inside
    tl.store(began + row, number, new)  # by each number of a row: the same
    return 1.0 / (number + 1.0 - tl.where(first == 0.0, number, first))


@triton.jit
def moments_of(m, v, at, inside):
    """The moments of a number: float32, or of their codes, `moments.decoded`."""
    exp_avg, exp_avg_sq = tl.load(m + at, inside), tl.load(v + at, inside)
    if exp_avg.dtype == tl.int16:
        second = (exp_avg_sq.to(tl.int32) & 0xFFFF) << 15
        first = tl.where(second != 0, exp_avg.to(tl.int32) << 16, 0)
        exp_avg, exp_avg_sq = (
            first.to(tl.float32, bitcast=True),
            second.to(tl.float32, bitcast=True),
        )
    return exp_avg, exp_avg_sq


@triton.jit
def store_moments(m, v, at, inside, exp_avg, exp_avg_sq, key):
    """Write the moments of a number: float32, or their codes, `moments.encode`."""
    if m.dtype.element_ty == tl.int16:
        chance = mixed(at, key)
        second = exp_avg_sq.to(tl.int32, bitcast=True) + (chance & 0x7FFF).to(tl.int32)
        first = exp_avg.to(tl.int32, bitcast=True) + (chance >> 16).to(tl.int32)
        tl.store(m + at, (first >> 16).to(tl.int16), inside)
        tl.store(v + at, (second >> 15).to(tl.int16), inside)
    else:
        tl.store(m + at, exp_avg, inside)
        tl.store(v + at, exp_avg_sq, inside)


@triton.jit
def into_mean(value, old, weight, mean, rest, at, inside, put):
    """`mean.take_into_mean` of one number; what the parameter is afterwards."""
    known = tl.abs(value) < INFINITY
    has = tl.abs(old) < INFINITY
    start = tl.where(has, old, value)
    if rest is None:
        way = value - start
        moved = tl.where(weight < 0.5, start + way * weight, value - way * (1.0 - weight))
    else:  # `mean.take_with_rest`
        left = tl.load(rest + at, inside)
        more = tl.where(has, left, 0.0)
        more = more + ((value - start) - more) * weight
        moved = start + more
        tl.store(rest + at, tl.where(known, more - (moved - start), left), inside)
    moved = tl.where(known, moved, old)
    tl.store(mean + at, moved, inside)
    if put > 0.0:
        value = tl.where(known, moved, value)
    return value


@triton.jit
def into_residue(value, old, weight, mean, at, inside, put, grid, round_key):
    """`mean.take_into_residue` of one number; what the parameter is afterwards."""
    place = value / grid
    known = tl.abs(place) < MAX_PLACE
    place = tl.where(known, place, 0.0)
    lower = place.to(tl.int32)
    rest = place - lower.to(tl.float32)
    away = ((old.to(tl.int32) - lower).to(tl.int16).to(tl.float32) - rest) * (1.0 - weight)
    away = tl.minimum(tl.maximum(away, -MAX_AWAY), MAX_AWAY)
    chance = (mixed(at, round_key) >> 16).to(tl.float32) * (1.0 / 65536.0)
    moved = lower + tl.floor(rest + away + chance).to(tl.int32)
    tl.store(mean + at, tl.where(known, moved.to(tl.int16), old), inside)
    if put > 0.0:
        value = tl.where(known, value + away * grid, value)
    return value


@triton.jit
def rows_of(first, width):
    """The row of each number of a program whose first one is `first`, for widths below 2^20.

    A division of float32 costs a third of one of integers, and with half a number added rounding
    reaches no other row.
    """
    row = first // width
    place = (first - row * width).to(tl.int32) + tl.arange(0, ROWS_BLOCK)
    return row + ((place.to(tl.float32) + 0.5) * (1.0 / width)).to(tl.int32)


@triton.jit
def _step_rows(
    p, g, m, v, mean, rest, began, held, factor, nonfinite, at, row, inside, size, beta2, ones1,
    ones2, eps, sqrt_correction2, shrink, decay, round_key, key, share, fade_m, fade_v, weight,
    number, put, grid,
):  # fmt: skip
    grad, value = tl.load(g + at, inside), tl.load(p + at, inside)
    exp_avg, exp_avg_sq = moments_of(m, v, at, inside)
    if mean is not None:
        old, first = tl.load(mean + at, inside), tl.load(began + row, inside)
    known = tl.abs(grad) < INFINITY
    grad, value = tl.where(known, grad, 0.0), value * shrink
    if decay != 0.0:
        grad = grad + value * decay
    if factor is not None:
        size = size * tl.load(factor)
    if share > 0.0:
        chosen = chosen_rows(row, key, share)
        exp_avg = tl.where(chosen, exp_avg * fade_m, exp_avg)
        exp_avg_sq = tl.where(chosen, exp_avg_sq * fade_v, exp_avg_sq)
    if held is not None:
        least = grad * weight
        least = tl.where(tl.load(held + row, inside) != 0, least * least, 0.0)
        exp_avg_sq = larger(exp_avg_sq, least)
    exp_avg = exp_avg + (grad - exp_avg) * ones1
    exp_avg_sq = exp_avg_sq * beta2 + grad * grad * ones2
    value = value - size * exp_avg / (tl.sqrt_rn(exp_avg_sq) / sqrt_correction2 + eps)
    store_moments(m, v, at, inside, exp_avg, exp_avg_sq, round_key)
    if mean is not None:
        portion = weight_in_mean(first, began, row, inside, number)
        if mean.dtype.element_ty == tl.int16:
            value = into_residue(value, old, portion, mean, at, inside, put, grid, round_key)
        else:
            value = into_mean(value, old, portion, mean, rest, at, inside, put)
    tl.store(p + at, value, inside)
    if nonfinite is not None:
        count(known == 0, 1, nonfinite, inside)


@triton.jit(do_not_specialize=PLAIN_INTS)
def step_rows(
    p, g, m, v, mean, rest, began, held, factor, nonfinite, numbers, width, size, beta2, ones1,
    ones2, eps, sqrt_correction2, shrink, decay, round_key, key, share, fade_m, fade_v, weight,
    number, put, grid,
):  # fmt: skip
    """Step a parameter [rows, width], ROWS_BLOCK of its numbers in a program.

    Args:
        p, g, m, v, mean: numbers float32: parameter, gradient, moments (or codes int16), mean (or
            None). A mean of int16 is what `mean.take_into_residue` keeps, with its `grid`.
        rest: numbers float32, of a mean that is the sum of both; or None.
        began: [rows] float32, the number with which a row's mean began, 0: it begins now; or None.
        held: [rows] uint8, not 0: raise the second moment to (weight * gradient)^2; or None.
        factor: one float32 on the device, on the size; or None.
        nonfinite: one int32 to which numbers that are not finite are added; or None.
        size: the rate, with the correction of the first moment in it.
        ones1, ones2: 1 - beta1, 1 - beta2.
        round_key: for the rounding of moments to codes, see `opt3dgs_optim.moments`.
        shrink, decay: of weight decay, decoupled and the other kind; 1.0 and 0.0: none.
        key, share, fade_m, fade_v: of fading; a share of 0.0: none.
        number, put: of the mean; put > 0: it takes the parameter's place.
        numbers: 64 bits, where there are more than 2^31.
    """
    first = tl.program_id(0).to(numbers.dtype) * ROWS_BLOCK
    # Without a mask four numbers are read at a time.
    if first <= numbers - ROWS_BLOCK:
        at, row = first + tl.arange(0, ROWS_BLOCK), rows_of(first, width)
        _step_rows(
            p, g, m, v, mean, rest, began, held, factor, nonfinite, at, row, None, size,
            beta2, ones1, ones2, eps, sqrt_correction2, shrink, decay, round_key, key, share,
            fade_m, fade_v, weight, number, put, grid,
        )  # fmt: skip
    else:
        # One a thread, since every program has as many registers as the branch that needs most;
        # in 64 bits, since the place of a number that is not there may need them.
        for part in range(0, ROWS_BLOCK, TAIL_BLOCK):
            last = first.to(tl.int64) + part + tl.arange(0, TAIL_BLOCK)
            _step_rows(
                p, g, m, v, mean, rest, began, held, factor, nonfinite, last, last // width,
                last < numbers, size, beta2, ones1, ones2, eps, sqrt_correction2, shrink, decay,
                round_key, key, share, fade_m, fade_v, weight, number, put, grid,
            )  # fmt: skip


@triton.jit
def turned(w, x, y, z, a, b, c):
    """The vector a, b, c turned by the unit quaternion w, x, y, z: v + w t + q x t, t = 2 q x v."""
    t, u, s = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return a + w * t + (y * s - z * u), b + w * u + (z * t - x * s), c + w * s + (x * u - y * t)


@triton.jit
def adam(grad, m, v, at, seen, size, beta2, ones1, ones2, eps, sqrt_correction2, round_key):
    """Adam's step of one number, 0 where it is not seen; elsewhere its moments are written."""
    exp_avg, exp_avg_sq = moments_of(m, v, at, seen)
    exp_avg = exp_avg + (grad - exp_avg) * ones1
    exp_avg_sq = exp_avg_sq * beta2 + grad * grad * ones2
    store_moments(m, v, at, seen, exp_avg, exp_avg_sq, round_key)
    return tl.where(seen, size * exp_avg / (tl.sqrt_rn(exp_avg_sq) / sqrt_correction2 + eps), 0.0)


@triton.jit(do_not_specialize=PLAIN_INTS)
def step_in_own_frame(  # noqa: PLR0915  (all a step has)
    p, g, m, v, quats, scales, longest, mean, rest, began, factor, nonfinite, rows, min_aspect,
    size, beta2, ones1, ones2, eps, sqrt_correction2, shrink, decay, round_key, number, put,
):  # fmt: skip
    """Step positions along each Gaussian's axes, mu <- mu - B Adam(B^T g), FRAME_BLOCK a program.

    Rows whose gradient is zero keep their moments, and do not move.

    Args:
        p, g, m, v, scales, mean: [rows, 3] float32; scales are logarithms.
        quats: [rows, 4] float32, wxyz.
        longest: [] float32, the standard deviation that a longer axis counts as; or None.
        size: standard deviations of a full step, with the correction of the first moment in it.
        min_aspect: share of the longest axis that a shorter one counts as, at least.
        the others: as of `step_rows`.
    """
    row = tl.program_id(0) * FRAME_BLOCK + tl.arange(0, FRAME_BLOCK)
    inside = row < rows
    i, j, k, q = 3 * row, 3 * row + 1, 3 * row + 2, 4 * row
    gx, gy, gz = tl.load(g + i, inside), tl.load(g + j, inside), tl.load(g + k, inside)
    px, py, pz = tl.load(p + i, inside), tl.load(p + j, inside), tl.load(p + k, inside)
    w = tl.load(quats + q, inside)
    x = tl.load(quats + q + 1, inside)
    y = tl.load(quats + q + 2, inside)
    z = tl.load(quats + q + 3, inside)
    sx = tl.load(scales + i, inside)
    sy = tl.load(scales + j, inside)
    sz = tl.load(scales + k, inside)
    if mean is not None:
        # By `row` Triton would read two at a time, and pass all else between threads for it.
        first = tl.load(began + (q >> 2), inside)
    # Moments are read later, of Gaussians in view alone.
    a, b, c = tl.abs(gx) < INFINITY, tl.abs(gy) < INFINITY, tl.abs(gz) < INFINITY
    if nonfinite is not None:
        bad = tl.where(a, 0, 1) + tl.where(b, 0, 1) + tl.where(c, 0, 1)
        count(bad > 0, bad, nonfinite, inside)
    gx, gy, gz = tl.where(a, gx, 0.0), tl.where(b, gy, 0.0), tl.where(c, gz, 0.0)
    seen = ((gx != 0.0) | (gy != 0.0) | (gz != 0.0)) & inside
    px, py, pz = px * shrink, py * shrink, pz * shrink
    if decay != 0.0:
        gx, gy, gz = gx + px * decay, gy + py * decay, gz + pz * decay

    length = larger(tl.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w / length, x / length, y / length, z / length
    sx, sy, sz = tl.exp(sx), tl.exp(sy), tl.exp(sz)
    if longest is not None:
        most = tl.load(longest)
        sx, sy, sz = smaller(sx, most), smaller(sy, most), smaller(sz, most)
    least = larger(larger(sx, sy), sz) * min_aspect
    sx, sy, sz = larger(sx, least), larger(sy, least), larger(sz, least)

    gx, gy, gz = turned(w, -x, -y, -z, gx, gy, gz)
    gx, gy, gz = gx * sx, gy * sy, gz * sz
    gx = tl.where(tl.abs(gx) <= LARGEST, gx, 0.0)
    gy = tl.where(tl.abs(gy) <= LARGEST, gy, 0.0)
    gz = tl.where(tl.abs(gz) <= LARGEST, gz, 0.0)
    if factor is not None:
        size = size * tl.load(factor)
    dx = sx * adam(gx, m, v, i, seen, size, beta2, ones1, ones2, eps, sqrt_correction2, round_key)
    dy = sy * adam(gy, m, v, j, seen, size, beta2, ones1, ones2, eps, sqrt_correction2, round_key)
    dz = sz * adam(gz, m, v, k, seen, size, beta2, ones1, ones2, eps, sqrt_correction2, round_key)
    dx, dy, dz = turned(w, x, y, z, dx, dy, dz)
    px = px - tl.where(tl.abs(dx) < INFINITY, dx, 0.0)
    py = py - tl.where(tl.abs(dy) < INFINITY, dy, 0.0)
    pz = pz - tl.where(tl.abs(dz) < INFINITY, dz, 0.0)
    if mean is not None:
        ox, oy, oz = tl.load(mean + i, inside), tl.load(mean + j, inside), tl.load(mean + k, inside)
        portion = weight_in_mean(first, began, q >> 2, inside, number)
        px = into_mean(px, ox, portion, mean, rest, i, inside, put)
        py = into_mean(py, oy, portion, mean, rest, j, inside, put)
        pz = into_mean(pz, oz, portion, mean, rest, k, inside, put)
    tl.store(p + i, px, inside)
    tl.store(p + j, py, inside)
    tl.store(p + k, pz, inside)


@triton.jit
def added(a, b):
    """The sum of two."""
    return a + b


@triton.jit(do_not_specialize=PLAIN_INTS)
def look_at_positions(g, v, out_of_view, counter, rows):
    """See which positions have no gradient.

    Args:
        g: [rows, 3] float32, the gradient. v: [rows, 3] the second moments (or their codes), not 0
            where a position has had one before; or None.
        out_of_view: [rows] uint8, 1 where there is none; or None.
        counter: [1] int64, to which 2^32 is added for each row in view, and 1 for each that is or
            has been; or None.
    """
    row = tl.program_id(0) * LOOK_BLOCK + tl.arange(0, LOOK_BLOCK)
    inside = row < rows
    i = 3 * row
    x, y, z = tl.load(g + i, inside), tl.load(g + i + 1, inside), tl.load(g + i + 2, inside)
    seen = ((x != 0.0) | (y != 0.0) | (z != 0.0)) & inside
    if out_of_view is not None:
        tl.store(out_of_view + row, tl.where(seen, 0, 1).to(tl.uint8), inside)
    if counter is not None:
        known = seen
        if v is not None:
            x, y, z = tl.load(v + i, inside), tl.load(v + i + 1, inside), tl.load(v + i + 2, inside)
            known = seen | (((x != 0) | (y != 0) | (z != 0)) & inside)
        counts = tl.where(seen, 1 << 32, 0).to(tl.int64) + tl.where(known, 1, 0).to(tl.int64)
        tl.atomic_add(counter, tl.reduce(counts, 0, added), sem="relaxed")
