"""The projection of `projection.py` and its gradient, compiled, for the visible points alone.

Parameters are float32, and computed with in float64: points are few beside pixels.
"""

from __future__ import annotations

import math

import numpy as np

from splatting.fast.kernel import kernel
from splatting.projection import ALPHA_MIN, BLUR, FAR_PLANE, NEAR_PLANE

MAX_EXTENT = math.sqrt(2 * math.log(1 / ALPHA_MIN))  # sigmas, at opacity 1


@kernel
def _unit_quaternion(quats, point):
    w, x = np.float64(quats[point, 0]), np.float64(quats[point, 1])
    y, z = np.float64(quats[point, 2]), np.float64(quats[point, 3])
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)  # as torch's normalize
    return w / norm, x / norm, y / norm, z / norm, norm


@kernel
def _rotation(w, x, y, z, rotation):
    rotation[0, 0] = 1 - 2 * (y * y + z * z)
    rotation[0, 1] = 2 * (x * y - w * z)
    rotation[0, 2] = 2 * (x * z + w * y)
    rotation[1, 0] = 2 * (x * y + w * z)
    rotation[1, 1] = 1 - 2 * (x * x + z * z)
    rotation[1, 2] = 2 * (y * z - w * x)
    rotation[2, 0] = 2 * (x * z - w * y)
    rotation[2, 1] = 2 * (y * z + w * x)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)


@kernel
def _rotation_gradient(w, x, y, z, grad):
    """The gradient by (w, x, y, z) from that by the rotation matrix."""
    antisymmetric_x = grad[2, 1] - grad[1, 2]
    antisymmetric_y = grad[0, 2] - grad[2, 0]
    antisymmetric_z = grad[1, 0] - grad[0, 1]
    symmetric_xy = grad[0, 1] + grad[1, 0]
    symmetric_xz = grad[0, 2] + grad[2, 0]
    symmetric_yz = grad[1, 2] + grad[2, 1]
    return (
        2 * (x * antisymmetric_x + y * antisymmetric_y + z * antisymmetric_z),
        2 * (w * antisymmetric_x + y * symmetric_xy + z * symmetric_xz)
        - 4 * x * (grad[1, 1] + grad[2, 2]),
        2 * (w * antisymmetric_y + x * symmetric_xy + z * symmetric_yz)
        - 4 * y * (grad[0, 0] + grad[2, 2]),
        2 * (w * antisymmetric_z + x * symmetric_xz + y * symmetric_yz)
        - 4 * z * (grad[0, 0] + grad[1, 1]),
    )


@kernel
def _camera_space(means, point, viewmat):
    a, b, c = means[point, 0], means[point, 1], means[point, 2]
    return (
        viewmat[0, 0] * a + viewmat[0, 1] * b + viewmat[0, 2] * c + viewmat[0, 3],
        viewmat[1, 0] * a + viewmat[1, 1] * b + viewmat[1, 2] * c + viewmat[1, 3],
        viewmat[2, 0] * a + viewmat[2, 1] * b + viewmat[2, 2] * c + viewmat[2, 3],
    )


@kernel
def _factors(x, y, z, viewmat, lens, rotation, log_scales, to_image, oriented, factors):
    """J W, J W R and J W R S (each 2 x 3) of one point; the 2D covariance is the last's square."""
    for row in range(2):
        focal = lens[row, 0]
        slope = min(max((x if row == 0 else y) / z, lens[row, 2]), lens[row, 3])
        for column in range(3):
            to_image[row, column] = focal / z * (viewmat[row, column] - slope * viewmat[2, column])
    for row in range(2):
        for column in range(3):
            value = 0.0
            for k in range(3):
                value += to_image[row, k] * rotation[k, column]
            oriented[row, column] = value
            factors[row, column] = value * math.exp(np.float64(log_scales[column]))


@kernel
def _reach(mean, variance, extent, size):
    """Whether the interval around mean, in whole pixels, overlaps (0, size)."""
    radius = np.ceil(extent * math.sqrt(variance))  # math.ceil would overflow its int64
    return radius > 0 and mean + radius > 0 and mean - radius < size


@kernel
def _may_reach(mean, position, z, lens, largest, size):
    """False only if a Gaussian no wider than `largest` cannot reach (0, size), cheaply."""
    slope = min(max(position / z, lens[2]), lens[3])
    focal = lens[0] / z * largest
    radius = 1 + MAX_EXTENT * math.sqrt(focal * focal * (1 + slope * slope) + BLUR)
    return not (mean + radius < 0 or mean - radius > size)


@kernel
def project_points(means, quats, scales, logits, viewmat, lens, width, height):
    """Project the visible points; see `projection.project` and `projection.visible_points`.

    `lens` [2, 4] holds, for x and y, focal length, centre and the limits of the slope.
    Returns visible [N], the V visible points' index, and their geometry [V, 8]: mean x, y,
    covariance xx, xy, yy, its determinant, depth, opacity.
    """
    n = means.shape[0]
    visible, index = np.zeros(n, np.bool_), np.empty(n, np.int64)
    geometry = np.empty((n, 8))
    rotation = np.empty((3, 3))
    to_image, oriented, f = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    used = 0
    for point in range(n):
        x, y, z = _camera_space(means, point, viewmat)
        if not NEAR_PLANE < z < FAR_PLANE:
            continue
        mean_x, mean_y = lens[0, 0] * x / z + lens[0, 1], lens[1, 0] * y / z + lens[1, 1]
        largest = max(scales[point, 0], scales[point, 1], scales[point, 2])
        largest = math.exp(np.float64(largest))
        if not (
            _may_reach(mean_x, x, z, lens[0], largest, width)
            and _may_reach(mean_y, y, z, lens[1], largest, height)
        ):
            continue
        opacity = 1 / (1 + math.exp(-np.float64(logits[point])))
        if not opacity > ALPHA_MIN:
            continue
        qw, qx, qy, qz, _ = _unit_quaternion(quats, point)
        _rotation(qw, qx, qy, qz, rotation)
        _factors(x, y, z, viewmat, lens, rotation, scales[point], to_image, oriented, f)
        xx = f[0, 0] * f[0, 0] + f[0, 1] * f[0, 1] + f[0, 2] * f[0, 2]
        yy = f[1, 0] * f[1, 0] + f[1, 1] * f[1, 1] + f[1, 2] * f[1, 2]
        area_x = f[0, 1] * f[1, 2] - f[0, 2] * f[1, 1]
        area_y = f[0, 2] * f[1, 0] - f[0, 0] * f[1, 2]
        area_z = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
        area = area_x * area_x + area_y * area_y + area_z * area_z
        determinant = area + BLUR * (xx + yy) + BLUR * BLUR
        if not math.isfinite(determinant):
            continue
        extent = math.sqrt(2 * math.log(opacity / ALPHA_MIN))
        if not (
            _reach(mean_x, xx + BLUR, extent, width) and _reach(mean_y, yy + BLUR, extent, height)
        ):
            continue
        geometry[used, 0], geometry[used, 1] = mean_x, mean_y
        geometry[used, 2], geometry[used, 4] = xx + BLUR, yy + BLUR
        geometry[used, 3] = f[0, 0] * f[1, 0] + f[0, 1] * f[1, 1] + f[0, 2] * f[1, 2]
        geometry[used, 5], geometry[used, 6], geometry[used, 7] = determinant, z, opacity
        visible[point], index[used] = True, point
        used += 1
    return visible, index[:used].copy(), geometry[:used].copy()


@kernel
def _slope_gradient(x, z, slope, lens, grad_focal, grad_slope):
    """Gradients by x and z of focal / z and -focal * slope / z (one row of the Jacobian)."""
    grad_z = -lens[0] / (z * z) * (grad_focal - slope * grad_slope)
    if not lens[2] <= x / z <= lens[3]:
        return 0.0, grad_z
    through_slope = -lens[0] / (z * z) * grad_slope
    return through_slope, grad_z - through_slope * x / z


@kernel
def points_backward(grad_means2d, grad_covariances, means, quats, scales, viewmat, lens):
    """Gradients by means, quats and scales.

    `grad_covariances` [V, 3] is the symmetric gradient matrix (xx, xy, yy), so that xy stands
    for both off-diagonal elements.
    """
    n = means.shape[0]
    grad_means, grad_quats, grad_scales = np.zeros((n, 3)), np.empty((n, 4)), np.empty((n, 3))
    rotation, grad_rotation = np.empty((3, 3)), np.empty((3, 3))
    to_image, oriented, factors = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    grad_to_image, grad_camera = np.empty((2, 3)), np.empty(3)
    for point in range(n):
        x, y, z = _camera_space(means, point, viewmat)
        qw, qx, qy, qz, norm = _unit_quaternion(quats, point)
        _rotation(qw, qx, qy, qz, rotation)
        _factors(x, y, z, viewmat, lens, rotation, scales[point], to_image, oriented, factors)
        xx, xy, yy = grad_covariances[point]
        grad_rotation[:] = 0
        grad_to_image[:] = 0
        for k in range(3):
            scale = math.exp(np.float64(scales[point, k]))
            # By J W R, from covariance = F F^T: 2 G F, then times S.
            first = 2 * scale * (xx * factors[0, k] + xy * factors[1, k])
            second = 2 * scale * (xy * factors[0, k] + yy * factors[1, k])
            grad_scales[point, k] = first * oriented[0, k] + second * oriented[1, k]
            for j in range(3):
                grad_rotation[j, k] = to_image[0, j] * first + to_image[1, j] * second
                grad_to_image[0, j] += first * rotation[j, k]
                grad_to_image[1, j] += second * rotation[j, k]
        gw, gx, gy, gz = _rotation_gradient(qw, qx, qy, qz, grad_rotation)
        along = gw * qw + gx * qx + gy * qy + gz * qz
        grad_quats[point, 0] = (gw - along * qw) / norm
        grad_quats[point, 1] = (gx - along * qx) / norm
        grad_quats[point, 2] = (gy - along * qy) / norm
        grad_quats[point, 3] = (gz - along * qz) / norm
        grad_camera[2] = 0
        for row in range(2):
            position = x if row == 0 else y
            slope = min(max(position / z, lens[row, 2]), lens[row, 3])
            by_focal, by_slope = 0.0, 0.0
            for k in range(3):
                by_focal += grad_to_image[row, k] * viewmat[row, k]
                by_slope += grad_to_image[row, k] * viewmat[2, k]
            by_position, by_depth = _slope_gradient(
                position, z, slope, lens[row], by_focal, by_slope
            )
            by_pixel = grad_means2d[point, row] * lens[row, 0] / z
            grad_camera[row] = by_position + by_pixel
            grad_camera[2] += by_depth - by_pixel * position / z
        for k in range(3):
            for row in range(3):
                grad_means[point, k] += viewmat[row, k] * grad_camera[row]
    return grad_means, grad_quats, grad_scales
