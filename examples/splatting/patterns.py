"""Procedural surface patterns of the embedded scene; see `raycast.Pattern` for their shape."""

from __future__ import annotations

import numpy as np

from splatting.raycast import Array

_NOISE_SIZE = 512


def _rgb(code: str) -> Array:
    """Return the colour of a hexadecimal code such as "e8c170", [3, 1]."""
    channels = [int(code[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    return np.array(channels, np.float32)[:, None]


def _mix(low: Array, high: Array, weight: Array) -> Array:
    return low + (high - low) * np.clip(weight, 0, 1)


def _palette(codes: list[str], index: Array) -> Array:
    table = np.concatenate([_rgb(code) for code in codes], axis=1)
    return table[:, index.astype(np.int64) % len(codes)]


def _face(points: Array, normals: Array) -> tuple[Array, Array]:
    """Coordinates on a box's face, the second one upwards on the four sides."""
    on_top, on_x = np.abs(normals[2]) > 0.5, np.abs(normals[0]) > 0.5
    return np.where(on_x, points[1], points[0]), np.where(on_top, points[1], points[2])


class Noise:
    """Periodic noise with a 1/f spectrum, mean 0.5 and deviation 0.22, looked up in a table."""

    def __init__(self, rng: np.random.Generator, falloff: float) -> None:
        spectrum = np.fft.rfft2(rng.standard_normal((_NOISE_SIZE, _NOISE_SIZE)))
        rows = np.fft.fftfreq(_NOISE_SIZE)[:, None]
        frequency = np.hypot(rows, np.fft.rfftfreq(_NOISE_SIZE)[None])
        frequency[0, 0] = np.inf  # no constant part
        table = np.fft.irfft2(spectrum / frequency**falloff)
        self.table = (0.5 + 0.22 * table / table.std()).astype(np.float32)

    def __call__(self, u: Array, v: Array) -> Array:
        """Look up at (u, v), which have period 1."""
        rows = (u * _NOISE_SIZE).astype(np.int64) % _NOISE_SIZE
        columns = (v * _NOISE_SIZE).astype(np.int64) % _NOISE_SIZE
        return self.table[rows, columns]


def _angles(normals: Array) -> tuple[Array, Array]:
    """Longitude and latitude in turns, -0.5..0.5 and -0.25..0.25."""
    longitude = np.arctan2(normals[1], normals[0]) / np.float32(2 * np.pi)
    return longitude, np.arcsin(np.clip(normals[2], -1, 1)) / np.float32(2 * np.pi)


def beach_ball(points: Array, normals: Array) -> Array:
    """Six coloured sectors and white caps."""
    longitude, latitude = _angles(normals)
    stripes = _palette(["e4572e", "fff4e0", "2e86ab", "fff4e0", "f6c445", "fff4e0"], longitude * 12)
    return np.where(np.abs(latitude) > 0.22, _rgb("fdfdfd"), stripes)


def checker_ball(points: Array, normals: Array) -> Array:
    """A fine checker in longitude and latitude."""
    longitude, latitude = _angles(normals)
    odd = np.floor(longitude * 16) + np.floor(latitude * 20)
    return _palette(["2b2d42", "f2e9e4"], odd)


def planet(noise: Noise, points: Array, normals: Array) -> Array:
    """Seas, coasts, woods and snow."""
    longitude, latitude = _angles(normals)
    height = noise(longitude, latitude * 0.8) + 0.35 * np.abs(latitude)
    sea = _mix(_rgb("12355b"), _rgb("3fa7d6"), height * 2)
    land = _mix(_rgb("e2c48d"), _rgb("3a7d44"), (height - 0.55) * 9)
    land = np.where(height > 0.82, _rgb("f5f7fa"), land)
    return np.where(height < 0.53, sea, land)


def marble(noise: Noise, points: Array, normals: Array) -> Array:
    """Veined stone."""
    longitude, latitude = _angles(normals)
    wave = np.sin(40 * latitude + 14 * noise(longitude, latitude))
    return _mix(_rgb("3c1642"), _rgb("f7d6e0"), 0.5 + 0.5 * wave)


def gift(half: float, points: Array, normals: Array) -> Array:
    """Wrapping paper with dots, and a ribbon crossed over every face."""
    u, v = _face(points, normals)
    du, dv = (np.mod(w / (half * 0.4), 1) - 0.5 for w in (u, v))
    paper = np.where(du**2 + dv**2 < 0.07, _rgb("ffe9ec"), _rgb("c1121f"))
    edge = np.minimum(np.abs(u), np.abs(v)) / half
    return np.where(edge < 0.16, np.where(edge < 0.1, _rgb("f9c74f"), _rgb("b8871f")), paper)


def bricks(noise: Noise, points: Array, normals: Array) -> Array:
    """Bricks in running bond with light mortar; each brick has its own tint."""
    u, v = _face(points, normals)
    row = np.floor(v / 0.11)
    shifted = u / 0.24 + 0.5 * np.mod(row, 2)
    column = np.floor(shifted)
    in_brick = (np.mod(shifted, 1) > 0.07) & (np.mod(v / 0.11, 1) > 0.14)
    tint = noise(row * 0.137, column * 0.271) + 0.3 * (noise(u, v) - 0.5)
    return np.where(in_brick, _mix(_rgb("7a3b2e"), _rgb("d98e5f"), tint), _rgb("d9d2c5"))


def planks(noise: Noise, points: Array, normals: Array) -> Array:
    """Wooden boards with grain along them."""
    u, v = _face(points, normals)
    board = np.floor(v / 0.15)
    grain = noise(u * 0.25 + board * 0.31, v * 2.5)
    wood = _mix(_rgb("6b4423"), _rgb("d7a86e"), grain * 0.8 + 0.3 * np.mod(board, 2))
    return np.where(np.mod(v / 0.15, 1) < 0.08, _rgb("3d2514"), wood)


def garden(rough: Noise, fine: Noise, points: Array, normals: Array) -> Array:
    """A round mosaic on a ring of flagstones, in a meadow."""
    x, y = points[0], points[1]
    radius, turn = np.hypot(x, y), np.arctan2(y, x) / np.float32(2 * np.pi)
    ring = np.floor(radius * 4)
    petals = np.floor(turn * 24 + 0.5 * np.mod(ring, 2) + 0.25 * np.sin(radius * 12))
    tiles = ["f4f1de", "e07a5f", "3d405b", "81b29a", "f2cc8f"]
    mosaic = _palette(tiles, ring * 2 + np.mod(petals, 3))
    stone = _mix(_rgb("8d8d92"), _rgb("cfccc4"), fine(x * 0.21, y * 0.21) * 1.1)
    joint = (np.mod(turn * 36 + 0.5 * np.floor(radius * 2.5), 1) < 0.08) | (
        np.mod(radius * 2.5, 1) < 0.08
    )
    path = np.where(joint, _rgb("4a4e3f"), stone)
    grass = _mix(_rgb("2f5d2a"), _rgb("b5c95a"), 1.3 * fine(x * 0.08, y * 0.08) - 0.1)
    flowers = (rough(x * 0.11, y * 0.11) > 0.62) & (fine(x * 0.31, y * 0.31) > 0.82)
    grass = np.where(flowers, _palette(["ffd6e8", "fff3b0"], np.floor(x * 3)), grass)
    return np.where(radius < 2.0, mosaic, np.where(radius < 2.8, path, grass))


def sky(rough: Noise, points: Array, normals: Array) -> Array:
    """A gradient with clouds, above two rows of hills."""
    longitude, latitude = _angles(normals)
    height = latitude * 4  # 0 at the horizon, 1 at the zenith
    blue = _mix(_rgb("fbe3c0"), _rgb("4a90d9"), height * 2.2)
    cloud = (rough(longitude, height * 0.5) - 0.5) * 3 * np.clip(height * 8 - 0.6, 0, 1)
    color = _mix(blue, _rgb("ffffff"), cloud)
    far = 0.10 + 0.10 * rough(longitude, np.zeros_like(longitude))
    near = 0.03 + 0.12 * rough(longitude, np.full_like(longitude, 0.37))
    color = np.where(height < far, _rgb("8fa8c8"), color)
    return np.where(height < near, _rgb("5d7f5b"), color)
