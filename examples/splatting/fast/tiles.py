"""Compositing in tiles: the compiled, float32 twin of `compositing.py` and its gradient.

A tile is eight pixels wide, one vector (`lanes.py`), and a few rows high, so that its pixels stay
in the first-level cache while its points pass. Each tile has a list of the points that reach it,
front to back; a tile whose pixels are all finished reads no further, and the backward pass starts
where the forward pass stopped.

Along a row a Gaussian is one-dimensional: with k = xy / yy of its covariance and d the offset
from its mean, d^T Sigma^-1 d = precision (dx - k dy)^2 + dy^2 / yy, a sum of squares that never
cancels. Its logarithm of base 2 with the opacity is lo - C dy^2 - v^2, where v is linear along the
row. What depends on the row is computed in float64, what depends on the pixel in float32.
"""

# numba passes intrinsics their typing context itself
# pyright: reportCallIssue=false
from __future__ import annotations

import math

import numpy as np

from splatting.compositing import ALPHA_MAX, TRANSMITTANCE_MIN
from splatting.fast.kernel import kernel
from splatting.fast.lanes import (
    WIDTH,
    absolute,
    both,
    choose,
    count_up,
    from_bits,
    load,
    minimum,
    multiply_add,
    prefetch,
    raised,
    repeat,
    store,
    total,
    totals,
    truths,
)
from splatting.projection import ALPHA_MIN

HEIGHT = 8  # rows of a tile
AREA = HEIGHT * WIDTH
SUMS = 16  # columns of the backward pass's sums, of which 9 are used: a cache line a point
SLACK = 1e-3  # pixels; a list may hold a point that reaches no pixel, the passes test each
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
MARGIN = 1e-5  # of log2 alpha: this near to the threshold, float64 decides
HALF_LOG2_E = 0.5 / math.log(2)
SHIFT = 1.5 * 2.0**23  # a float32 below 2^22 plus this is its nearest whole number in the last bits
AHEAD = 6  # entries whose points are fetched into the cache before they are used
CENTRE = (WIDTH - 1) / 2  # lanes are counted from the middle, where rounding is least

# Columns of `splats` [V, 12], float64, one row a visible point.
MEAN_X, MEAN_Y, SLOPE, SHEAR, FALL, LOG_OPACITY, RED, GREEN, BLUE = range(9)
FIRST_ROW, END_ROW, REACH = range(9, 12)


@kernel
def prepare_splats(geometry, colors, height):
    """What the passes need of each point, from `points.project_points`'s geometry and colours."""
    splats = np.empty((geometry.shape[0], 12))
    for point in range(geometry.shape[0]):
        x, y, _, _, yy, determinant, _, opacity = geometry[point]
        xy = geometry[point, 3]
        # v = SLOPE dx - SHEAR dy
        slope = math.sqrt(HALF_LOG2_E * yy / determinant)
        reach = 2 * math.log(opacity / ALPHA_MIN)  # squared, in sigmas
        half = math.sqrt(reach * yy)
        splats[point, MEAN_X], splats[point, MEAN_Y] = x, y
        splats[point, SLOPE], splats[point, SHEAR] = slope, slope * xy / yy
        splats[point, FALL] = HALF_LOG2_E / yy
        splats[point, LOG_OPACITY] = math.log2(opacity)
        for channel in range(3):
            splats[point, RED + channel] = max(colors[point, channel], 0.0)
        # Rows whose centres the ellipse alpha >= 1/255 may reach.
        first = min(max(y - half - 0.5 - SLACK, 0.0), float(height))
        last = max(min(y + half - 0.5 + SLACK, height - 1.0), -1.0)
        splats[point, FIRST_ROW] = math.ceil(first)
        splats[point, END_ROW] = math.floor(last) + 1
        splats[point, REACH] = reach
    return splats


@kernel
def depth_order(depths):
    """The stable order of positive depths: a radix sort of their bits, which are ordered alike."""
    n = depths.shape[0]
    order, spare = np.arange(n).astype(np.int32), np.empty(n, np.int32)
    if n < 2:
        return order
    bits = depths.view(np.int64)
    lowest = bits.min()
    span = bits.max() - lowest
    counts = np.empty(2049, np.int64)
    shift = 0
    while span >> shift:
        counts[:] = 0
        for i in range(n):
            counts[((bits[i] - lowest) >> shift & 2047) + 1] += 1
        for digit in range(2048):
            counts[digit + 1] += counts[digit]
        for i in range(n):
            digit = (bits[order[i]] - lowest) >> shift & 2047
            spare[counts[digit]] = order[i]
            counts[digit] += 1
        order, spare = spare, order
        shift += 11
    return order


@kernel
def _columns(splats, geometry, point, tile_row, width):
    """The tiles [first, end) of a row of tiles that a point's ellipse may reach."""
    xx, xy, yy = geometry[point, 2], geometry[point, 3], geometry[point, 4]
    determinant, reach = geometry[point, 5], splats[point, REACH]
    y = splats[point, MEAN_Y]
    low = max(tile_row * HEIGHT + 0.0, splats[point, FIRST_ROW]) + 0.5 - y
    high = min(tile_row * HEIGHT + HEIGHT + 0.0, splats[point, END_ROW]) - 0.5 - y
    # The ellipse's left end is at dy = -xy sqrt(reach / xx), its right end opposite.
    extreme = xy * math.sqrt(reach / xx)
    dy = min(max(-extreme, low), high)
    half = math.sqrt(max(reach - dy * dy / yy, 0.0) * determinant / yy)
    left = splats[point, MEAN_X] + xy / yy * dy - half - 0.5 - SLACK
    dy = min(max(extreme, low), high)
    half = math.sqrt(max(reach - dy * dy / yy, 0.0) * determinant / yy)
    right = splats[point, MEAN_X] + xy / yy * dy + half - 0.5 + SLACK
    first = math.ceil(min(max(left, 0.0), float(width)))
    last = math.floor(max(min(right, width - 1.0), -1.0))
    if first > last:
        return 0, 0
    return int(first) // WIDTH, int(last) // WIDTH + 1


@kernel
def list_points(order, splats, geometry, width, height):
    """The points of each tile, front to back: tile t has entries [starts[t], starts[t + 1])."""
    across, down = -(-width // WIDTH), -(-height // HEIGHT)
    bands = 0
    for point in range(splats.shape[0]):
        first, end = int(splats[point, FIRST_ROW]), int(splats[point, END_ROW])
        bands += max((end - 1) // HEIGHT + 1 - first // HEIGHT, 0)
    ranges = np.empty((bands, 3), np.int32)  # first tile, end, point
    starts = np.zeros(across * down + 1, np.int64)
    used = 0
    for place in range(order.shape[0]):
        point, coming = order[place], order[min(place + AHEAD, order.shape[0] - 1)]
        prefetch(splats, coming)
        prefetch(geometry, coming)
        first, end = int(splats[point, FIRST_ROW]), int(splats[point, END_ROW])
        if first >= end:
            continue
        for tile_row in range(first // HEIGHT, (end - 1) // HEIGHT + 1):
            left, right = _columns(splats, geometry, point, tile_row, width)
            ranges[used, 0], ranges[used, 1] = tile_row * across + left, tile_row * across + right
            ranges[used, 2] = point
            used += 1
            for tile in range(tile_row * across + left, tile_row * across + right):
                starts[tile + 1] += 1
    for tile in range(across * down):
        starts[tile + 1] += starts[tile]
    filled = starts.copy()
    entries = np.empty(starts[-1], np.int32)
    for band in range(used):
        for tile in range(ranges[band, 0], ranges[band, 1]):
            entries[filled[tile]] = ranges[band, 2]
            filled[tile] += 1
    return starts, entries


# The numbers that the passes compute with, each repeated over a register: an instruction reads such
# an operand from memory for nothing, while a constant in the code is spread over a register first.
# ln(2)^n / n! are the coefficients of 2 to the f.
NUMBERS = (
    *(1.0, 6.931471805599453e-1, 2.402265069591007e-1, 5.550410866482158e-2),
    *(9.618129107628477e-3, 1.3333558146428443e-3, 1.5403530393381608e-4),
    *(SHIFT, ALPHA_MAX, TRANSMITTANCE_MIN, LOG2_ALPHA_MIN, MARGIN),
)
ONE, F1, F2, F3, F4, F5, F6, SHIFTED, MOST, FULL, LEAST, NEAR = range(0, 12 * WIDTH, WIDTH)


@kernel
def _repeated_numbers():
    numbers = np.empty(len(NUMBERS) * WIDTH, np.float32)
    for i in range(numbers.shape[0]):
        numbers[i] = NUMBERS[i // WIDTH]
    return numbers


@kernel
def _power(x, numbers):
    """2 to the x, for -126 < x < 127, within 3e-7 of itself: Taylor's series around 1/2 steps.

    Of a number outside it is anything, NaN too.
    """
    shifted = x + load(numbers, SHIFTED)
    f = x - (shifted - load(numbers, SHIFTED))
    square = f * f
    low = multiply_add(f, load(numbers, F1), load(numbers, ONE))
    middle = multiply_add(f, load(numbers, F3), load(numbers, F2))
    high = multiply_add(f, load(numbers, F5), load(numbers, F4))
    high = multiply_add(square, load(numbers, F6), high)
    series = multiply_add(square, multiply_add(square, high, middle), low)
    return raised(series, shifted)


@kernel
def _row(splats, point, x, dy):
    """v in the middle of a row, and the level there."""
    along = splats[point, SLOPE] * (x - splats[point, MEAN_X])
    level = splats[point, LOG_OPACITY] - splats[point, FALL] * dy * dy
    return along - splats[point, SHEAR] * dy, level


@kernel
def _prepare_rows(splats, point, x, top, offsets, centres, levels):
    """What the rows of a tile need of a point: dy, and what `_row` says.

    All at once, since a row that had to wait for its own would take longer.
    """
    y = splats[point, MEAN_Y]
    for row in range(HEIGHT):
        dy = top + row + 0.5 - y
        offsets[row] = dy
        centres[row], levels[row] = _row(splats, point, x, dy)


@kernel
def _exact_mask(splats, point, x, y):
    """Which lanes of the row at y reach the threshold, in float64."""
    slope = splats[point, SLOPE]
    at_centre, level = _row(splats, point, x, y - splats[point, MEAN_Y])
    bits = 0
    for lane in range(WIDTH):
        v = slope * (lane - CENTRE) + at_centre
        if level - v * v >= LOG2_ALPHA_MIN:
            bits |= 1 << lane
    return bits


@kernel
def composite_forward(starts, entries, splats, background, width, height):  # noqa: PLR0915
    """Blend the points of each tile.

    Returns image [H, W, 3], alpha [H, W], and for the backward pass the transmittance
    [T * AREA], tile after tile, the pixels that each entry was blended into (bit 8 row + column,
    [entries]; only of those before the stop) and stops [T], the entry where a tile was left.
    """
    across = -(-width // WIDTH)
    tiles = starts.shape[0] - 1
    image = np.empty((height, width, 3), np.float32)
    alpha_image = np.empty((height, width), np.float32)
    transmittance = np.empty(tiles * AREA, np.float32)
    blended = np.empty(entries.shape[0], np.int64)
    stops = starts[1:].copy()
    colour = np.empty(3 * AREA, np.float32)
    offsets, centres, levels = np.empty((3, HEIGHT), np.float32)
    numbers = _repeated_numbers()
    places = count_up() - CENTRE
    for tile in range(tiles):
        left, top = tile % across * WIDTH, tile // across * HEIGHT
        planes = tile * AREA
        columns, rows = min(WIDTH, width - left), min(HEIGHT, height - top)
        for i in range(AREA):
            inside = i % WIDTH < columns and i // WIDTH < rows
            # A pixel that takes no more points has its transmittance negated.
            transmittance[planes + i] = 1.0 if inside else -1.0
        colour[:] = 0
        open_pixels = rows * columns
        x = left + 0.5 + CENTRE
        for entry in range(starts[tile], starts[tile + 1]):
            prefetch(splats, entries[min(entry + AHEAD, starts[tile + 1] - 1)])
            point = entries[entry]
            _prepare_rows(splats, point, x, top, offsets, centres, levels)
            slopes = repeat(splats[point, SLOPE])
            red, green = repeat(splats[point, RED]), repeat(splats[point, GREEN])
            blue = repeat(splats[point, BLUE])
            first = max(int(splats[point, FIRST_ROW]) - top, 0)
            pixels = 0
            for row in range(first, min(int(splats[point, END_ROW]) - top, HEIGHT)):
                v = multiply_add(slopes, places, centres[row])
                power = levels[row] - v * v
                judged = power
                if truths(absolute(power - load(numbers, LEAST)) < load(numbers, NEAR)):
                    exact = from_bits(_exact_mask(splats, point, x, top + row + 0.5))
                    judged = choose(exact, 0.0, 2 * LOG2_ALPHA_MIN)
                at = planes + row * WIDTH
                before = load(transmittance, at)
                reached = both(judged >= load(numbers, LEAST), before > 0.0)
                bits = truths(reached)
                if bits == 0:
                    continue
                alpha = minimum(_power(power, numbers), load(numbers, MOST))
                alpha = choose(reached, alpha, 0.0)
                after = before * (load(numbers, ONE) - alpha)
                weight = alpha * before
                # Those that were full before are negative, and not as small.
                full = absolute(after) <= load(numbers, FULL)
                filled = truths(full)
                if filled:
                    weight = choose(full, 0.0, weight)
                    after = choose(full, 0.0 - before, after)
                    bits &= ~filled
                    while filled:
                        filled &= filled - 1
                        open_pixels -= 1
                store(transmittance, at, after)
                pixels |= bits << (row * WIDTH)
                at = row * WIDTH
                store(colour, at, multiply_add(weight, red, load(colour, at)))
                at += AREA
                store(colour, at, multiply_add(weight, green, load(colour, at)))
                at += AREA
                store(colour, at, multiply_add(weight, blue, load(colour, at)))
            blended[entry] = pixels
            if open_pixels == 0:
                stops[tile] = entry + 1
                break
        for row in range(rows):
            for column in range(columns):
                i = row * WIDTH + column
                left_over = abs(transmittance[planes + i])
                alpha_image[top + row, left + column] = 1 - left_over
                for channel in range(3):
                    image[top + row, left + column, channel] = (
                        colour[channel * AREA + i] + left_over * background[channel]
                    )
    return image, alpha_image, transmittance, blended, stops


@kernel
def composite_backward(  # noqa: PLR0915
    grad_image, grad_alpha, background, transmittance, blended, starts, stops, entries, splats
):
    """Gradients of the entries, summed per point.

    With g the gradient by the exponent, v as above and dy the offset from the mean, the columns
    of the returned sums [V, 16] are those of g, g v, g dy, g v^2, g v dy, g dy^2, and of the
    gradients by the colour; the rest is unused. Returns the background's gradient [3] too.
    """
    height, width = grad_alpha.shape
    across = -(-width // WIDTH)
    sums = np.zeros((splats.shape[0], SUMS), np.float32)
    flat_sums = sums.reshape(-1)
    grad_background = np.zeros(3)
    grads = np.empty(3 * AREA, np.float32)
    in_front, behind = np.empty(AREA, np.float32), np.empty(AREA, np.float32)
    offsets, centres, levels = np.empty((3, HEIGHT), np.float32)
    numbers = _repeated_numbers()
    places = count_up() - CENTRE
    for tile in range(starts.shape[0] - 1):
        left, top = tile % across * WIDTH, tile // across * HEIGHT
        planes = tile * AREA
        columns, rows = min(WIDTH, width - left), min(HEIGHT, height - top)
        grads[:] = 0
        behind[:] = 0
        for i in range(AREA):
            in_front[i] = abs(transmittance[planes + i])
        for row in range(rows):
            for column in range(columns):
                i = row * WIDTH + column
                # The loss's derivative by the final transmittance, times it.
                by_left_over = -np.float64(grad_alpha[top + row, left + column])
                for channel in range(3):
                    grad = grad_image[top + row, left + column, channel]
                    grads[channel * AREA + i] = grad
                    grad_background[channel] += in_front[i] * np.float64(grad)
                    by_left_over += grad * background[channel]
                behind[i] = in_front[i] * by_left_over
        x = left + 0.5 + CENTRE
        for entry in range(stops[tile] - 1, starts[tile] - 1, -1):
            coming = entries[max(entry - AHEAD, starts[tile])]
            prefetch(splats, coming)
            prefetch(sums, coming)
            pixels = blended[entry]
            if pixels == 0:
                continue
            point = entries[entry]
            _prepare_rows(splats, point, x, top, offsets, centres, levels)
            slopes = repeat(splats[point, SLOPE])
            red, green = repeat(splats[point, RED]), repeat(splats[point, GREEN])
            blue = repeat(splats[point, BLUE])
            sum_0, sum_v, sum_vv = repeat(0.0), repeat(0.0), repeat(0.0)
            sum_y, sum_vy, sum_yy = repeat(0.0), repeat(0.0), repeat(0.0)
            sum_red, sum_green, sum_blue = repeat(0.0), repeat(0.0), repeat(0.0)
            first = max(int(splats[point, FIRST_ROW]) - top, 0)
            for row in range(first, min(int(splats[point, END_ROW]) - top, HEIGHT)):
                at = row * WIDTH
                bits = pixels >> at & 255
                if bits == 0:
                    continue
                v = multiply_add(slopes, places, centres[row])
                unclamped = _power(levels[row] - v * v, numbers)
                # 0 beside the pixels: nothing below changes, and nothing is added there.
                alpha = minimum(unclamped, load(numbers, MOST))
                alpha = choose(from_bits(bits), alpha, 0.0)
                inverse = load(numbers, ONE) / (load(numbers, ONE) - alpha)
                before = load(in_front, at)
                before = before * inverse
                store(in_front, at, before)
                weight = alpha * before
                grad_red, grad_green = load(grads, at), load(grads, AREA + at)
                grad_blue = load(grads, 2 * AREA + at)
                sum_red = multiply_add(weight, grad_red, sum_red)
                sum_green = multiply_add(weight, grad_green, sum_green)
                sum_blue = multiply_add(weight, grad_blue, sum_blue)
                by_weight = multiply_add(grad_green, green, grad_red * red)
                by_weight = multiply_add(grad_blue, blue, by_weight)
                rest = load(behind, at)
                # -alpha d(loss)/d(alpha), where alpha is not clamped
                by_exponent = alpha * (rest * inverse - before * by_weight)
                store(behind, at, multiply_add(weight, by_weight, rest))
                g = choose(unclamped <= load(numbers, MOST), by_exponent, 0.0)
                dy = offsets[row]
                gv, gy = g * v, g * dy
                sum_0 = sum_0 + g
                sum_v = sum_v + gv
                sum_vv = multiply_add(gv, v, sum_vv)
                sum_y = sum_y + gy
                sum_vy = multiply_add(gv, dy, sum_vy)
                sum_yy = multiply_add(gy, dy, sum_yy)
            at = point * SUMS
            more = totals(sum_0, sum_v, sum_y, sum_vv, sum_vy, sum_yy, sum_red, sum_green)
            store(flat_sums, at, load(flat_sums, at) + more)
            sums[point, 8] += total(sum_blue)
    return sums, grad_background


@kernel
def splats_backward(sums, splats, geometry):
    """Gradients by 2D mean [V, 2], covariance [V, 3] and logit [V] from the sums.

    The covariances' gradient is the symmetric matrix (xx, xy, yy), as `points_backward` takes it.
    """
    n = sums.shape[0]
    grad_means, grad_covariances, grad_logits = np.empty((n, 2)), np.empty((n, 3)), np.empty(n)
    for point in range(n):
        xy, yy = geometry[point, 3], geometry[point, 4]
        k = xy / yy
        by_e, by_v, by_y = sums[point, 0], sums[point, 1], sums[point, 2]
        by_vv, by_vy, by_yy = sums[point, 3], sums[point, 4], sums[point, 5]
        # q = Sigma^-1 d: its x is a = precision (dx - k dy) = scale v, its y is dy / yy - k a.
        scale = splats[point, SLOPE] / HALF_LOG2_E
        a, b = scale * by_v, by_y / yy
        aa = scale * scale * by_vv
        ab = scale / yy * by_vy
        bb = by_yy / yy / yy
        grad_means[point, 0] = -a
        grad_means[point, 1] = k * a - b
        # d(exponent) = -q^T d(Sigma) q / 2
        grad_covariances[point, 0] = -0.5 * aa
        grad_covariances[point, 1] = -0.5 * (ab - k * aa)
        grad_covariances[point, 2] = -0.5 * (k * k * aa - 2 * k * ab + bb)
        # alpha = opacity exp(-e): opacity d/d(opacity) = -d/de; the sigmoid adds 1 - opacity.
        grad_logits[point] = -by_e * (1 - geometry[point, 7])
    return grad_means, grad_covariances, grad_logits
