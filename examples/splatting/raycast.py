"""A small ray caster: solids, patterns on them, one sun. Arrays are `[3, n]` float32."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

Array = np.ndarray
Pattern = Callable[[Array, Array], Array]  # local points, local normals [3, n] -> colours [3, n]

_FAR = np.float32(1e9)  # stands for "no hit": infinities would make NaN further on
_NEAR = np.float32(1e-3)  # world units; nearer hits are the surface that the ray starts from
_AMBIENT, _DIFFUSE = 0.45, 0.65  # light in the shadow, and what the sun adds at normal incidence


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@dataclass(frozen=True)
class Sphere:
    """A ball, or seen from its inside a sky (which then neither casts nor receives shadow)."""

    center: tuple[float, float, float]
    radius: float
    pattern: Pattern
    is_sky: bool = False

    @property
    def casts_shadow(self) -> bool:
        return not self.is_sky

    def distance(self, origin: Array, direction: Array) -> Array:
        """Distance to the first hit along each ray, [n], `1e9` for none."""
        offset = origin - np.array(self.center, np.float32)[:, None]
        half_b = _dot(offset, direction)
        discriminant = half_b * half_b - _dot(offset, offset) + np.float32(self.radius**2)
        root = np.sqrt(np.maximum(discriminant, 0))
        hit = root - half_b if self.is_sky else -half_b - root
        return np.where((discriminant > 0) & (hit > _NEAR), hit, _FAR)

    def surface(self, points: Array) -> tuple[Array, Array]:
        """Outward normals [3, n] in the world and colours [3, n] at points on the surface."""
        normals = (points - np.array(self.center, np.float32)[:, None]) / np.float32(self.radius)
        return normals, self.pattern(normals, normals)


@dataclass(frozen=True)
class Box:
    """A box turned about the vertical axis; its pattern sees coordinates in its own axes."""

    center: tuple[float, float, float]
    half: tuple[float, float, float]
    yaw: float  # radians
    pattern: Pattern
    casts_shadow: ClassVar = True
    is_sky: ClassVar = False

    def _to_local(self, vectors: Array) -> Array:
        cos, sin = np.float32(np.cos(self.yaw)), np.float32(np.sin(self.yaw))
        x, y, z = vectors
        return np.stack((cos * x + sin * y, cos * y - sin * x, z))

    def distance(self, origin: Array, direction: Array) -> Array:
        start = self._to_local(origin - np.array(self.center, np.float32)[:, None])
        slope = self._to_local(direction)
        inverse = 1 / np.where(np.abs(slope) < 1e-9, np.float32(1e-9), slope)
        # slab method: inside all three pairs of planes at once
        reach = np.array(self.half, np.float32)[:, None] * np.abs(inverse)
        middle = -start * inverse
        enter, leave = (middle - reach).max(axis=0), (middle + reach).min(axis=0)
        return np.where((enter < leave) & (enter > _NEAR), enter, _FAR)

    def surface(self, points: Array) -> tuple[Array, Array]:
        local = self._to_local(points - np.array(self.center, np.float32)[:, None])
        relative = local / np.array(self.half, np.float32)[:, None]
        axis = np.abs(relative).argmax(axis=0)
        normals = np.zeros_like(local)
        columns = np.arange(local.shape[1])
        normals[axis, columns] = np.sign(relative[axis, columns])
        world = Box((0, 0, 0), self.half, -self.yaw, self.pattern)._to_local(normals)
        return world, self.pattern(local, normals)


@dataclass(frozen=True)
class Ground:
    """The plane z = 0, seen from above."""

    pattern: Pattern
    casts_shadow: ClassVar = False
    is_sky: ClassVar = False

    def distance(self, origin: Array, direction: Array) -> Array:
        falling = direction[2] < -1e-6
        return np.where(falling, -origin[2] / np.where(falling, direction[2], -1), _FAR)

    def surface(self, points: Array) -> tuple[Array, Array]:
        normals = np.zeros_like(points)
        normals[2] = 1
        return normals, self.pattern(points, normals)


Solid = Sphere | Box | Ground


def trace(
    solids: Sequence[Solid], sun: Array, origin: Array, direction: Array
) -> tuple[Array, Array]:
    """Colours and hit points of rays.

    Args:
        solids: the scene; every ray must hit one (a sky around it all sees to that).
        sun: unit vector towards the sun, [3].
        origin: [3, n] or, where all rays start at one point, [3, 1].
        direction: [3, n], unit length.

    Returns:
        colours [3, n] in 0..1 and points [3, n] in world units.
    """
    distances = np.stack([solid.distance(origin, direction) for solid in solids])
    nearest = distances.argmin(axis=0)
    points = origin + distances.min(axis=0) * direction
    colors = np.empty_like(points)
    for index, solid in enumerate(solids):
        rays = np.flatnonzero(nearest == index)
        if len(rays):
            colors[:, rays] = _shade(solids, sun, solid, points[:, rays])
    return np.clip(colors, 0, 1), points


def _shade(solids: Sequence[Solid], sun: Array, solid: Solid, points: Array) -> Array:
    normals, albedo = solid.surface(points)
    if solid.is_sky:
        return albedo
    to_sun = sun.astype(np.float32)[:, None]
    light = np.maximum(_dot(normals, to_sun), 0)  # Lambert
    start = points + normals * _NEAR  # off the surface, which must not shade itself
    for other in solids:
        if other.casts_shadow:
            light[other.distance(start, to_sun) < _FAR] = 0
    return albedo * (_AMBIENT + _DIFFUSE * light)
