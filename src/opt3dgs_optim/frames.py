"""Each Gaussian's own frame: its axes, in units of its standard deviations along them.

A Gaussian's covariance is Sigma = B B^T with B = R diag(s), R the rotation of its quaternion and s
its standard deviations. B takes a vector of the own frame into the world, B^T a gradient of the
world into the own frame. An axis may count as no thinner than a share of the longest one.
Coordinates are handled as columns [N], which is what a CPU is fast at.
"""

from __future__ import annotations

import torch
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.lbfgs.pairs import columns, put, row_chunks
from opt3dgs_optim.state import is_finite_sum

MIN_QUATERNION = 1e-12  # as torch.nn.functional.normalize: a zero quaternion is no rotation


def rotate(w: Tensor, axis: list[Tensor], v: list[Tensor]) -> list[Tensor]:
    """Rotate v by the unit quaternion (w, axis): v + w t + axis x t with t = 2 axis x v."""
    t = [2 * component for component in _cross(axis, v)]
    return [a + w * b + c for a, b, c in zip(v, t, _cross(axis, t), strict=True)]


def unit_quaternion(quats: Tensor, dtype: torch.dtype) -> tuple[Tensor, list[Tensor]]:
    """Real part [N] and axis, three of [N], of quaternions [N, 4], wxyz, not normalised."""
    q = columns(quats, dtype)
    w, *axis = (q / (q * q).sum(0).sqrt().clamp(min=MIN_QUATERNION)).unbind()
    return w, axis


class Frames:
    """The own frames of N Gaussians, as they are now: between gradient and step they may move.

    Args:
        quats: [N, 4] rotations, wxyz, need not be normalised.
        scales: [N, 3] log of the standard deviations, world units.
        dtype: of the positions; frames of half precision are float32, where a standard deviation
            of 1e-8 is not zero.
        min_aspect: share of the longest deviation that a shorter one counts as, at least; 0: none.
    """

    def __init__(
        self, quats: Tensor, scales: Tensor, dtype: torch.dtype, min_aspect: float
    ) -> None:
        self._wide = torch.float64 if dtype == torch.float64 else torch.float32
        self._axes: Tensor | None = None  # B as columns, [3, 3, N]; None: a kernel makes it
        if not cuda.has_own_frames(quats):
            self._axes = axes_of(quats, scales, self._wide, min_aspect)
        else:
            self._given = quats.clone(), scales.clone(), min_aspect

    def gradient(self, grad: Tensor) -> Tensor:
        """B^T g [N, 3]: of gradients per world unit [N, 3], those per standard deviation."""
        if self._axes is None:
            return cuda.own_frame_gradient(grad, *self._given)
        return self._product(grad, self._axes)

    def displacement(self, step: Tensor) -> Tensor:
        """B z [N, 3]: of steps z [N, 3] in standard deviations, those in world units."""
        if self._axes is None:
            return cuda.own_frame_displacement(step, *self._given)
        return self._product(step, self._axes.transpose(0, 1))

    def _product(self, vectors: Tensor, matrix: Tensor) -> Tensor:
        """sum over i of v_i matrix[i], for vectors [N, 3] and a matrix of columns [3, 3, N]."""
        result = torch.empty_like(vectors)
        for rows in row_chunks(vectors):
            x, y, z = columns(vectors[rows], self._wide).unbind()
            found = matrix[0][:, rows] * x
            found.addcmul_(matrix[1][:, rows], y).addcmul_(matrix[2][:, rows], z)
            put(result[rows], found.unbind())
        return result


def axes_of(quats: Tensor, scales: Tensor, dtype: torch.dtype, min_aspect: float) -> Tensor:
    """B = R diag(s) as columns, [3, 3, N]; arguments as in `Frames`."""
    result = torch.empty(3, 3, len(quats), dtype=dtype, device=quats.device)
    for rows in row_chunks(quats):
        q = columns(quats[rows], dtype)
        deviations = columns(scales[rows], dtype).exp_()
        _hold_broken(q, deviations)
        size = (q * q).sum(0).sqrt_().clamp_(min=MIN_QUATERNION)
        w, x, y, z = (q * (2**0.5 / size)).unbind()  # so that products are already doubled
        xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
        wx, wy, wz = w * x, w * y, w * z
        rotation = [
            *((yy + zz).neg_().add_(1.0), xy - wz, xz + wy),
            *(xy + wz, (xx + zz).neg_().add_(1.0), yz - wx),
            *(xz - wy, yz + wx, (xx + yy).neg_().add_(1.0)),
        ]
        b = result[:, :, rows]
        if min_aspect:
            deviations = torch.maximum(deviations, deviations.amax(0) * min_aspect)
        for place, entry, deviation in zip(
            [place for row in b.unbind() for place in row.unbind()],
            rotation,
            deviations.unbind() * 3,
            strict=True,
        ):
            torch.mul(entry, deviation, out=place)
    return result


def _hold_broken(quats: Tensor, deviations: Tensor) -> None:
    """Take Gaussians whose frame is not finite for points: nothing is fed, and nothing moves.

    Else a gradient of zero would become a NaN, which stays in Adam's moments for ever. In place, of
    columns [4, N] and [3, N].
    """
    if quats.is_cpu and is_finite_sum(quats) and is_finite_sum(deviations):
        return
    broken = ~(quats.isfinite().all(0) & deviations.isfinite().all(0))
    quats.masked_fill_(broken, 0.0)
    deviations.masked_fill_(broken, 0.0)


def _cross(a: list[Tensor], b: list[Tensor]) -> list[Tensor]:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]
