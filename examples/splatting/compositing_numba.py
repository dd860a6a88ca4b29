"""The compositing of `compositing.py` and its gradient, compiled, in float64.

A Gaussian meets an image row in one run of pixels, whose ends follow from alpha >= 1/255. All
runs are listed once, front to back, and both passes walk that list: forward along it, backward
against it. On one core this needs neither tiles (nor a point sorted into each tile it touches)
nor, since neighbouring pixels differ by a known factor, more than two exponentials per run.
"""

from __future__ import annotations

import math

import numpy as np

from splatting.compositing import ALPHA_MAX, TRANSMITTANCE_MIN
from splatting.numba_kernel import kernel
from splatting.projection import ALPHA_MIN

SLACK = 1e-6  # pixels; rounding may not lose a pixel at the end of a run, the passes test alpha


@kernel
def _pixel_range(centre, half_width, size):
    """The pixels [first, end) whose centres lie within half_width of centre."""
    # Limited to the image before the conversion to an integer, which could overflow.
    first = min(max(centre - half_width - 0.5 - SLACK, 0.0), size)
    last = max(min(centre + half_width - 0.5 + SLACK, size - 1.0), -1.0)
    return math.ceil(first), math.floor(last) + 1


@kernel
def _rows(means, covariances, reach, point, height):
    return _pixel_range(means[point, 1], math.sqrt(reach * covariances[point, 2]), height)


@kernel
def list_runs(order, means, covariances, determinants, opacities, width, height):
    """The runs of all points in `order` (the visible ones, front to back).

    Returns index [R, 4] (point, row, first pixel, end), value [R, 2] (opacity times Gaussian at
    the first pixel, and the factor to the second) and decay [N] (the factor between successive
    factors).
    """
    decay = np.zeros(means.shape[0])
    capacity = 0
    for point in order:
        reach = 2 * math.log(opacities[point] / ALPHA_MIN)  # squared, in sigmas
        first, end = _rows(means, covariances, reach, point, height)
        capacity += max(end - first, 0)
    index = np.empty((capacity, 4), np.int32)
    value = np.empty((capacity, 2))
    used = 0
    for point in order:
        xy, yy = covariances[point, 1], covariances[point, 2]
        # Along a row the Gaussian is one-dimensional: with d the offset from the mean,
        # d^T Sigma^-1 d = precision (dx - xy / yy dy)^2 + dy^2 / yy, a sum of squares.
        precision = yy / determinants[point]
        decay[point] = math.exp(-precision)
        reach = 2 * math.log(opacities[point] / ALPHA_MIN)
        first_row, end_row = _rows(means, covariances, reach, point, height)
        for row in range(first_row, end_row):
            dy = row + 0.5 - means[point, 1]
            centre = means[point, 0] + xy / yy * dy
            half_width = math.sqrt(max(reach - dy * dy / yy, 0.0) / precision)
            first, end = _pixel_range(centre, half_width, width)
            if first >= end:
                continue
            dx = first + 0.5 - centre
            exponent = 0.5 * (precision * dx * dx + dy * dy / yy)
            index[used, 0], index[used, 1] = point, row
            index[used, 2], index[used, 3] = first, end
            value[used, 0] = opacities[point] * math.exp(-exponent)
            value[used, 1] = math.exp(-precision * (dx + 0.5))
            used += 1
    return index[:used], value[:used], decay


@kernel
def composite_forward(index, value, decay, colors, width, height):
    """Blend the runs; colours below 0 count as 0.

    Returns pixels [H * W, 4] (colour without background, transmittance) and finished [H * W],
    the run at which each pixel was full (the number of runs if none).
    """
    runs = index.shape[0]
    pixels = np.zeros((width * height, 4))
    pixels[:, 3] = 1
    finished = np.full(width * height, runs, np.int32)
    for run in range(runs):
        point, row, first, end = index[run]
        gaussian, factor = value[run]
        red = max(colors[point, 0], 0.0)
        green = max(colors[point, 1], 0.0)
        blue = max(colors[point, 2], 0.0)
        for pixel in range(row * width + first, row * width + end):
            alpha = min(gaussian, ALPHA_MAX)
            gaussian *= factor
            factor *= decay[point]
            if alpha < ALPHA_MIN or finished[pixel] < runs:
                continue
            transmittance = pixels[pixel, 3] * (1 - alpha)
            if transmittance <= TRANSMITTANCE_MIN:
                finished[pixel] = run
                continue
            weight = alpha * pixels[pixel, 3]
            pixels[pixel, 0] += weight * red
            pixels[pixel, 1] += weight * green
            pixels[pixel, 2] += weight * blue
            pixels[pixel, 3] = transmittance
    return pixels, finished


@kernel
def composite_backward(
    grad_image, transmittance, behind, finished, index, value, decay, means, colors, width
):
    """Gradients of the runs, summed per point.

    `grad_image` [H * W, 3]; `transmittance` [H * W] behind all points, overwritten; `behind`
    [H * W] the loss's derivative by the transmittance, times the transmittance, overwritten.
    Returns grad_colors [N, 3] and moments [N, 6]: with g the gradient by the exponent and (x, y)
    the offset from the mean, the sums over pixels of g, g x, g y, g x^2, g x y, g y^2.
    """
    grad_colors = np.zeros((means.shape[0], 3))
    moments = np.zeros((means.shape[0], 6))
    for run in range(index.shape[0] - 1, -1, -1):
        point, row, first, end = index[run]
        gaussian, factor = value[run]
        red = max(colors[point, 0], 0.0)
        green = max(colors[point, 1], 0.0)
        blue = max(colors[point, 2], 0.0)
        grad_red, grad_green, grad_blue = 0.0, 0.0, 0.0
        sum_0, sum_x, sum_xx = 0.0, 0.0, 0.0
        dx = first - 0.5 - means[point, 0]
        for pixel in range(row * width + first, row * width + end):
            unclamped = gaussian
            gaussian *= factor
            factor *= decay[point]
            dx += 1
            if unclamped < ALPHA_MIN or run >= finished[pixel]:
                continue
            alpha = min(unclamped, ALPHA_MAX)
            inverse = 1 / (1 - alpha)
            in_front = transmittance[pixel] * inverse
            transmittance[pixel] = in_front
            weight = alpha * in_front
            grad_red += weight * grad_image[pixel, 0]
            grad_green += weight * grad_image[pixel, 1]
            grad_blue += weight * grad_image[pixel, 2]
            by_weight = (
                red * grad_image[pixel, 0]
                + green * grad_image[pixel, 1]
                + blue * grad_image[pixel, 2]
            )
            by_alpha = in_front * by_weight - behind[pixel] * inverse
            behind[pixel] += weight * by_weight
            if unclamped <= ALPHA_MAX:
                by_exponent = -alpha * by_alpha
                sum_0 += by_exponent
                sum_x += by_exponent * dx
                sum_xx += by_exponent * dx * dx
        dy = row + 0.5 - means[point, 1]
        grad_colors[point, 0] += grad_red
        grad_colors[point, 1] += grad_green
        grad_colors[point, 2] += grad_blue
        moments[point, 0] += sum_0
        moments[point, 1] += sum_x
        moments[point, 2] += sum_0 * dy
        moments[point, 3] += sum_xx
        moments[point, 4] += sum_x * dy
        moments[point, 5] += sum_0 * dy * dy
    return grad_colors, moments


@kernel
def moments_backward(moments, covariances, determinants, visible):
    """Gradients by the 2D means [N, 2] and covariances [N, 3] from the moments.

    The covariances' gradient is the symmetric matrix (xx, xy, yy), as `project_backward` takes it.
    """
    grad_means = np.zeros((moments.shape[0], 2))
    grad_covariances = np.zeros((moments.shape[0], 3))
    for point in range(moments.shape[0]):
        if not visible[point]:
            continue
        _, x, y, xx, xy, yy = moments[point]
        # The inverse covariance [[a, b], [b, c]].
        a = covariances[point, 2] / determinants[point]
        b = -covariances[point, 1] / determinants[point]
        c = covariances[point, 0] / determinants[point]
        grad_means[point, 0] = -(a * x + b * y)
        grad_means[point, 1] = -(b * x + c * y)
        # d(inverse) = -inverse d(Sigma) inverse, and the gradient by the inverse is moments / 2.
        grad_covariances[point, 0] = -0.5 * (a * a * xx + 2 * a * b * xy + b * b * yy)
        grad_covariances[point, 1] = -0.5 * (a * b * xx + (a * c + b * b) * xy + b * c * yy)
        grad_covariances[point, 2] = -0.5 * (b * b * xx + 2 * b * c * xy + c * c * yy)
    return grad_means, grad_covariances
