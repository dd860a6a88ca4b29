"""Each Gaussian's own frame: its axes, in units of its standard deviations along them.

A Gaussian's covariance is Sigma = B B^T with B = R diag(s), R the rotation of its quaternion and s
its standard deviations. B takes a vector of the own frame into the world, B^T a gradient of the
world into the own frame. An axis may count as no thinner than a share of the longest one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.lbfgs.pairs import columns, put, row_chunks
from opt3dgs_optim.state import is_finite_sum

FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
CHUNK = 65_536  # rows that a CPU works on at a time: smaller ones spend too much on each operation
# What Adam squares stays finite up to half of the root of the largest number, a power of two.
_EXPONENTS = {dtype: math.frexp(torch.finfo(dtype).max)[1] for dtype in FLOATS}
LARGEST = {dtype: 2.0 ** (exponent // 2 - 1) for dtype, exponent in _EXPONENTS.items()}
MIN_QUATERNION = 1e-12  # as torch.nn.functional.normalize: a zero quaternion is no rotation


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
        self._axes: list[tuple[slice, Axes]] = []  # by rows; none: a kernel makes them
        self._room: Tensor | None = None  # [2, 5, n] to compute in, for the first n rows
        if not cuda.has_own_frames(quats):
            self._axes = [
                (rows, axes_of(quats[rows], scales[rows], self._wide, min_aspect))
                for rows in row_chunks(quats, CHUNK)
            ]
        else:
            quats, scales = (each.to(self._wide, copy=True) for each in (quats, scales))
            self._given = quats, scales, min_aspect

    def gradient(self, grad: Tensor) -> Tensor:
        """B^T g [N, 3]: of gradients per world unit [N, 3], those per standard deviation.

        No number is so large that Adam's second moment would be infinite, which it would stay.
        """
        largest = LARGEST[grad.dtype]
        if self._axes:
            result = torch.empty_like(grad)
            for rows, axes in self._axes:
                put(result[rows], axes.into(*self._columns(grad[rows])).clamp_(-largest, largest))
            return result
        found = cuda.own_frame_gradient(grad.to(self._wide), *self._given)
        # The kernel bounds it as what it computes in needs it.
        return (
            found if found.dtype == grad.dtype else found.clamp_(-largest, largest).to(grad.dtype)
        )

    def displacement(self, step: Tensor) -> Tensor:
        """B z [N, 3]: of steps z [N, 3] in standard deviations, those in world units.

        On a CPU it takes the place of the step.
        """
        if not self._axes:
            return cuda.own_frame_displacement(step, *self._given)
        for rows, axes in self._axes:
            put(step[rows], axes.out_of(*self._columns(step[rows])))
        return step

    def _columns(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Vectors [n, 3] as `repeated_columns`, and room for as many numbers.

        Both lie in the same memory for all rows: new memory costs more than what is computed in it.
        """
        if self._room is None:
            self._room = torch.empty(2, 5, len(vectors), dtype=self._wide, device=vectors.device)
        room, spare = self._room[:, :, : len(vectors)]
        return repeated_columns(vectors, self._wide, out=room), spare


class Axes(NamedTuple):
    """The axes of n Gaussians, with coordinates as rows [n], which is what a CPU is fast at.

    Three coordinates are followed by the first two once more: so the rows that a cross product
    multiplies lie beside each other, for all three coordinates at once. The quaternion is of length
    sqrt 2, so that products of two of its entries are doubled already.
    """

    real: Tensor  # [n], of the quaternion
    axis: Tensor  # [5, n], its imaginary part
    deviations: Tensor  # [3, n]

    def into(self, vectors: Tensor, spare: Tensor) -> Tensor:
        """B^T v [3, n] of vectors as `repeated_columns` [5, n]; both arguments are overwritten."""
        return self._rotated(vectors, spare, -1.0).mul_(self.deviations)

    def out_of(self, vectors: Tensor, spare: Tensor) -> Tensor:
        """B v [3, n], as `into`."""
        vectors[:3].mul_(self.deviations)
        return self._rotated(vectors, spare, 1.0)

    def _rotated(self, v: Tensor, t: Tensor, direction: float) -> Tensor:
        """R v, or R^T v where the direction is -1: v + w t + a x t with t = a x v."""
        a = self.axis
        v[3:].copy_(v[:2])
        torch.mul(a[1:4], v[2:5], out=t[:3])
        t[:3].addcmul_(a[2:5], v[1:4], value=-1.0)
        t[3:].copy_(t[:2])
        rotated = v[:3].addcmul_(self.real, t[:3], value=direction)
        return rotated.addcmul_(a[1:4], t[2:5]).addcmul_(a[2:5], t[1:4], value=-1.0)


def repeated_columns(vectors: Tensor, dtype: torch.dtype, out: Tensor | None = None) -> Tensor:
    """Vectors [n, 3] as rows [n] of their coordinates, [5, n], with room for two of them again."""
    found = torch.empty(5, len(vectors), dtype=dtype, device=vectors.device) if out is None else out
    columns(vectors, dtype, out=found[:3])
    return found


def axes_of(quats: Tensor, scales: Tensor, dtype: torch.dtype, min_aspect: float) -> Axes:
    """The axes as they are used; arguments as in `Frames`, for as many points as fit a cache."""
    q = torch.empty(6, len(quats), dtype=dtype, device=quats.device)
    columns(quats, dtype, out=q[:4])
    deviations = columns(scales, dtype).exp_()
    _hold_broken(q[:4], deviations)
    size = q[0] * q[0]
    for component in q[1:4]:
        size.addcmul_(component, component)
    q[:4].mul_(size.sqrt_().clamp_(min=MIN_QUATERNION).reciprocal_().mul_(2**0.5))
    q[4:].copy_(q[1:3])
    if min_aspect:
        least = torch.maximum(deviations[0], deviations[1])
        least = torch.maximum(least, deviations[2], out=least).mul_(min_aspect)
        torch.maximum(deviations, least, out=deviations)
    return Axes(q[0], q[1:], deviations)


def is_below(numbers: Tensor, bound: float) -> bool:
    """Whether all of a CPU's numbers are below a bound, and none is NaN."""
    return not numbers.numel() or numbers.amax().item() < bound


def _hold_broken(quats: Tensor, deviations: Tensor) -> None:
    """Take Gaussians without a frame of finite size for points: nothing is fed, and nothing moves.

    Else a gradient of zero would become a NaN, which stays in Adam's moments for ever. So would
    noise by deviations whose square is infinite. In place, of columns [4, N] and [3, N].
    """
    largest = LARGEST[deviations.dtype]
    # The largest of numbers with a NaN is NaN.
    if quats.is_cpu and is_finite_sum(quats) and is_below(deviations, largest):
        return
    broken = ~(quats.isfinite().all(0) & (deviations < largest).all(0))
    quats.masked_fill_(broken, 0.0)
    deviations.masked_fill_(broken, 0.0)
