"""Slow, obvious references in float64. They import nothing of the package that they check."""

from __future__ import annotations

import math

import numpy as np


def dense_bfgs(s: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Inverse-Hessian matrix after the pairs s, y [K, D], oldest first, one BFGS update each.

    Nocedal and Wright (2006), eq. 7.16, from H0 = gamma I with gamma = s.y / y.y of the newest.
    """
    dim = s.shape[1]
    gamma = float(s[-1] @ y[-1] / (y[-1] @ y[-1]))
    h = gamma * np.eye(dim)
    for s_k, y_k in zip(s, y, strict=True):
        rho = 1.0 / float(s_k @ y_k)
        v = np.eye(dim) - rho * np.outer(y_k, s_k)
        h = v.T @ h @ v + rho * np.outer(s_k, s_k)
    return h


class LoopHistogram:
    """Eq. 7, 13, 14 and 16 with Python loops; ends and clamp as the class documents them."""

    def __init__(
        self,
        num_partitions: int,
        energy_range: tuple[float, float],
        zeta: float,
        temperature: float,
        warmup: int,
        clamp: tuple[float, float] | None,
        floor: float = 1e-8,
    ) -> None:
        self.m = num_partitions
        self.low, self.high = energy_range
        self.zeta, self.tau, self.warmup, self.clamp = zeta, temperature, warmup, clamp
        self.floor = floor
        self.theta = [1.0 / num_partitions] * num_partitions
        self.k = 0

    def index(self, energy: float) -> int:
        """J, from 1 to m: u_{J-1} < energy <= u_J with u_0 = -inf and u_m = inf."""
        du = (self.high - self.low) / self.m
        for i in range(1, self.m):
            if energy <= self.low + i * du:
                return i
        return self.m

    def observe(self, energy: float) -> float:
        """nu from the weights as they are, then their update."""
        if not math.isfinite(energy):
            return math.nan
        du = (self.high - self.low) / self.m
        j = self.index(energy)
        nu = 1.0
        if self.k >= self.warmup and 1 < j < self.m:
            slope = (math.log(self.theta[j - 1]) - math.log(self.theta[j - 2])) / du
            nu = 1.0 + self.zeta * self.tau * slope
            if self.clamp is not None:
                nu = min(max(nu, self.clamp[0]), self.clamp[1])
        rate = min(1e-2, 10 / (self.k**0.8 + 100)) * self.theta[j - 1] ** self.zeta
        for i in range(self.m):
            self.theta[i] += rate * ((1.0 if i == j - 1 else 0.0) - self.theta[i])
            self.theta[i] = max(self.theta[i], self.floor)
        total = math.fsum(self.theta)
        self.theta = [t / total for t in self.theta]
        self.k += 1
        return nu


def rotation_matrix(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion wxyz of any length."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def covariance(scale: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """R diag(exp(2 s)) R^T of log scales [3] and a quaternion [4]."""
    r = rotation_matrix(quat)
    return r @ np.diag(np.exp(2 * scale)) @ r.T


def adam_steps(
    x: np.ndarray,
    grads: list[np.ndarray],
    lr: float,
    factors: list[float],
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-8,
) -> np.ndarray:
    """Adam (Kingma and Ba 2015, algorithm 1) with a factor on every step."""
    x, m, v = x.copy(), np.zeros_like(x), np.zeros_like(x)
    for t, (g, factor) in enumerate(zip(grads, factors, strict=True), start=1):
        m = betas[0] * m + (1 - betas[0]) * g
        v = betas[1] * v + (1 - betas[1]) * g * g
        m_hat, v_hat = m / (1 - betas[0] ** t), v / (1 - betas[1] ** t)
        x = x - lr * factor * m_hat / (np.sqrt(v_hat) + eps)
    return x


class MovingHistogram:
    """Partitions of the energy's recent deviations, with sums over the partitions."""

    def __init__(self, warmup: int, clamp: tuple[float, float] | None, m: int = 48) -> None:
        self.m, self.warmup, self.clamp = m, warmup, clamp
        self.q = np.full(m, 1 / m)
        self.mean = self.absolute = self.mean_slope = 0.0
        self.k = 0

    @property
    def deviation(self) -> float:
        """Of a Gaussian with this mean absolute deviation."""
        return self.absolute * math.sqrt(math.pi / 2)

    def visit(self, z: float) -> np.ndarray:
        """A Gaussian of 0.4 deviations around z, over the partitions' centers."""
        centers = (np.arange(self.m) + 0.5) * 12 / self.m - 6
        exponent = centers * z / 0.16 - centers**2 / 0.32
        return np.exp(exponent - exponent.max()) / np.exp(exponent - exponent.max()).sum()

    def observe(self, energy: float) -> float:
        """nu from the density as it is, then its update."""
        self.k += 1
        if self.k == 1:
            self.mean = energy
        distance = energy - self.mean
        unit = self.absolute + 1e-6 * abs(distance)
        limit = 4 * math.sqrt(math.pi / 2) if self.k > 4 else 1e6
        t = min(max(distance / unit, -limit), limit) if unit else 0.0
        z = t * math.sqrt(2 / math.pi)
        kernel = self.visit(z)
        # d log q / dz of q read through the kernel: that of exp(-(c - z)^2 / 2 h^2)
        centers = (np.arange(self.m) + 0.5) * 12 / self.m - 6
        read = kernel * self.q
        slope = ((centers - z) * read).sum() / 0.16 / (read.sum() + 0.05 / self.m)
        slope *= 0.5 * 1.32  # 1 + 2 * 0.4^2: two Gaussians of 0.4 widen the density
        if self.k <= 4:  # it has no bound there
            slope = 0.0
        nu = 1 + slope - self.mean_slope
        if self.clamp is not None:
            nu = min(max(nu, self.clamp[0]), self.clamp[1])
        rate = max(1 / self.k, 0.01)
        self.mean += rate * t * unit
        self.absolute += rate * (abs(t * unit) - self.absolute)
        self.mean_slope += rate * (slope - self.mean_slope)
        self.q += rate * (kernel - self.q)
        return nu if self.k > self.warmup else 1.0
