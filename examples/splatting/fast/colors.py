"""The colours of `spherical_harmonics.py` and their gradients, compiled, for visible points."""

from __future__ import annotations

import math

import numpy as np

from splatting.fast.kernel import kernel
from splatting.spherical_harmonics import (
    SH_0,
    SH_1,
    SH_2_0,
    SH_2_1,
    SH_2_2,
    SH_3_0,
    SH_3_1,
    SH_3_2,
    SH_3_3,
)


@kernel
def _basis(x, y, z, degree, basis):
    basis[0] = SH_0
    if degree >= 1:
        basis[1] = -SH_1 * y
        basis[2] = SH_1 * z
        basis[3] = -SH_1 * x
    if degree >= 2:
        basis[4] = SH_2_1 * x * y
        basis[5] = -SH_2_1 * y * z
        basis[6] = SH_2_0 * (3 * z * z - 1)
        basis[7] = -SH_2_1 * x * z
        basis[8] = SH_2_2 * (x * x - y * y)
    if degree >= 3:
        basis[9] = -SH_3_3 * y * (3 * x * x - y * y)
        basis[10] = 2 * SH_3_2 * x * y * z
        basis[11] = -SH_3_1 * y * (5 * z * z - 1)
        basis[12] = SH_3_0 * z * (5 * z * z - 3)
        basis[13] = -SH_3_1 * x * (5 * z * z - 1)
        basis[14] = SH_3_2 * z * (x * x - y * y)
        basis[15] = -SH_3_3 * x * (x * x - 3 * y * y)


@kernel
def _direction_gradient(x, y, z, degree, grad):
    """The gradient by (x, y, z) of the sum of the basis functions, each times its grad."""
    grad_x = -SH_1 * grad[3]
    grad_y = -SH_1 * grad[1]
    grad_z = SH_1 * grad[2]
    if degree >= 2:
        grad_x += SH_2_1 * (y * grad[4] - z * grad[7]) + 2 * SH_2_2 * x * grad[8]
        grad_y += SH_2_1 * (x * grad[4] - z * grad[5]) - 2 * SH_2_2 * y * grad[8]
        grad_z += 6 * SH_2_0 * z * grad[6] - SH_2_1 * (y * grad[5] + x * grad[7])
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        grad_x += -6 * SH_3_3 * x * y * grad[9] - 3 * SH_3_3 * (xx - yy) * grad[15]
        grad_x += 2 * SH_3_2 * z * (y * grad[10] + x * grad[14]) - SH_3_1 * (5 * zz - 1) * grad[13]
        grad_y += -3 * SH_3_3 * (xx - yy) * grad[9] + 6 * SH_3_3 * x * y * grad[15]
        grad_y += 2 * SH_3_2 * z * (x * grad[10] - y * grad[14]) - SH_3_1 * (5 * zz - 1) * grad[11]
        grad_z += -10 * SH_3_1 * z * (y * grad[11] + x * grad[13])
        grad_z += SH_3_2 * (2 * x * y * grad[10] + (xx - yy) * grad[14])
        grad_z += SH_3_0 * (15 * zz - 3) * grad[12]
    return grad_x, grad_y, grad_z


@kernel
def _direction(means, point, viewpoint):
    x = means[point, 0] - viewpoint[0]
    y = means[point, 1] - viewpoint[1]
    z = means[point, 2] - viewpoint[2]
    distance = max(math.sqrt(x * x + y * y + z * z), 1e-12)  # as torch's normalize
    return x / distance, y / distance, z / distance, distance


@kernel
def colors_forward(means, viewpoint, sh0, shN, degree):
    """The colours [V, 3] before max(., 0)."""
    count = (degree + 1) ** 2
    basis = np.zeros(16)
    colors = np.zeros((means.shape[0], 3))
    for point in range(means.shape[0]):
        x, y, z, _ = _direction(means, point, viewpoint)
        _basis(x, y, z, degree, basis)
        for channel in range(3):
            value = basis[0] * sh0[point, 0, channel] + 0.5
            for k in range(1, count):
                value += basis[k] * shN[point, k - 1, channel]
            colors[point, channel] = value
    return colors


@kernel
def colors_backward(grad_colors, colors, means, viewpoint, shN, degree, index, count):
    """Gradients by sh0 and shN of all `count` points, float32, and by the visible points' means.

    From the gradient by max(colors, 0); `colors` as returned above. `index` [V] says which points
    are visible: those of the others are zero.
    """
    functions, none = (degree + 1) ** 2, np.float32(0.0)
    basis = np.zeros(16)
    grad_basis = np.zeros(16)
    grad_sh0 = np.zeros((count, 1, 3), np.float32)
    grad_shN = np.zeros((count, shN.shape[1], 3), np.float32)
    grad_means = np.zeros((means.shape[0], 3))
    for point in range(means.shape[0]):
        x, y, z, distance = _direction(means, point, viewpoint)
        _basis(x, y, z, degree, basis)
        red = grad_colors[point, 0] if colors[point, 0] >= 0 else none
        green = grad_colors[point, 1] if colors[point, 1] >= 0 else none
        blue = grad_colors[point, 2] if colors[point, 2] >= 0 else none
        row = index[point]
        grad_sh0[row, 0, 0] = basis[0] * red
        grad_sh0[row, 0, 1] = basis[0] * green
        grad_sh0[row, 0, 2] = basis[0] * blue
        for k in range(1, functions):
            grad_shN[row, k - 1, 0] = basis[k] * red
            grad_shN[row, k - 1, 1] = basis[k] * green
            grad_shN[row, k - 1, 2] = basis[k] * blue
            through = np.float64(shN[point, k - 1, 0] * red)
            through += shN[point, k - 1, 1] * green
            grad_basis[k] = through + shN[point, k - 1, 2] * blue
        if degree >= 1:
            grad_x, grad_y, grad_z = _direction_gradient(x, y, z, degree, grad_basis)
            # Normalising the direction leaves the part of its gradient across the ray.
            along = grad_x * x + grad_y * y + grad_z * z
            grad_means[point, 0] = (grad_x - along * x) / distance
            grad_means[point, 1] = (grad_y - along * y) / distance
            grad_means[point, 2] = (grad_z - along * z) / distance
    return grad_sh0, grad_shN, grad_means
