"""Many chains of AWSGLD at once, compiled: the package's arithmetic, written out per chain.

A step of `AWSGLD` in Python takes a tenth of a millisecond for one chain, and each chain has an
energy histogram of its own; the study needs 10^8 steps of chains. `tests/test_landscapes.py` runs
the real `AWSGLD`, `EnergyHistogram` and `IsotropicNoise` beside this kernel, chain by chain, with
the same random numbers, and finds the same trajectories, multipliers and weights to rounding.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

NINE_MODES, DOUBLE_WELL = 0, 1
PLAIN, ADAM = 0, 1
WAVE = 1.2 * math.pi
FLOOR = 1e-8  # of the weights, EnergyHistogram's default
EPS = 1e-8  # Adam's


@njit(cache=True)
def nine_modes(x: np.ndarray, gradient: np.ndarray) -> float:
    """Energy at x [2]; the gradient is written to `gradient` [2]."""
    square = x[0] * x[0] + x[1] * x[1]
    energy = (square / 10 - math.cos(WAVE * x[0]) - math.cos(WAVE * x[1])) / 0.3
    outer = 2.0 if square > 7 else 0.0
    for d in range(2):
        gradient[d] = (x[d] / 5 + WAVE * math.sin(WAVE * x[d])) / 0.3 + outer * x[d]
    return energy + max(square - 7, 0.0)


@njit(cache=True)
def double_well(x: np.ndarray, height: float, gradient: np.ndarray) -> float:
    """Energy h (x^2 - 1)^2 at x [1]; the gradient is written to `gradient` [1]."""
    inner = x[0] * x[0] - 1
    gradient[0] = 4 * height * inner * x[0]
    return height * inner * inner


@njit(cache=True)
def partition(energy: float, low: float, width: float, count: int) -> int:
    """Eq. 13, counted from 0; the end partitions are open."""
    return min(max(math.ceil((energy - low) / width) - 1, 0), count - 1)


@njit(cache=True)
def multiplier(theta: np.ndarray, at: int, slope: float, low: float, high: float) -> float:
    """Eq. 14, clamped to [low, high]; slope = zeta tau / du."""
    if at == 0 or at == len(theta) - 1:
        return 1.0
    return min(max(1 + slope * (math.log(theta[at]) - math.log(theta[at - 1])), low), high)


@njit(cache=True)
def importance(theta: np.ndarray, energy: float, low: float, width: float, zeta: float) -> float:
    """Psi(energy)^zeta, which undoes eq. 14's drift exactly where nu is not clamped.

    log Psi runs straight from theta[J - 1] at the partition's lower edge to theta[J] at its upper
    one: that is the slope in nu. In the end partitions nu is 1 and Psi constant.
    """
    at, last = partition(energy, low, width, len(theta)), len(theta) - 1
    if at in (0, last):
        return theta[min(at, last - 1)] ** zeta
    share = (energy - low) / width - at
    below = math.log(theta[at - 1])
    return math.exp(zeta * (below + share * (math.log(theta[at]) - below)))


@njit(cache=True)
def update_weights(theta: np.ndarray, at: int, zeta: float, count: int) -> None:
    """Eq. 16 with the package's lambda, floor and renormalisation."""
    rate = min(10 / (count**0.8 + 100), 1e-2) * theta[at] ** zeta
    for i in range(len(theta)):
        theta[i] -= rate * theta[i]
    theta[at] += rate
    total = 0.0
    for i in range(len(theta)):
        theta[i] = max(theta[i], FLOOR)
        total += theta[i]
    for i in range(len(theta)):
        theta[i] /= total


@njit(cache=True)
def advance(
    landscape,
    drift,
    x,  # [C, D]
    exp_avg,  # [C, D]
    exp_avg_sq,  # [C, D]
    theta,  # [C, m]; m = 0: no histogram
    nu_sum,  # [C]
    heights,  # [C]
    first_step,
    rates,  # [K] learning rates
    deviations,  # [K] of the Langevin noise
    constant,
    zeta,
    temperature,
    low,
    width,
    clamp,  # (low, high)
    betas,
    boundary,
    stream_noise,
    normals,  # [K, C, 2 D + 1]: energy, gradient, Langevin noise
    every,
    positions,  # [S, C, D], S = K / every
    energies,  # [S, C]
    weights,  # [S, C]
):
    """K steps of C chains, in place; the state before every `every`-th step is written out."""
    chains, dim = x.shape
    count = theta.shape[1]
    gradient, proposal = np.zeros(dim), np.zeros(dim)
    for k in range(len(rates)):
        step = first_step + k
        bias1, bias2 = 1 - betas[0] ** (step + 1), 1 - betas[1] ** (step + 1)
        for c in range(chains):
            if landscape == 0:
                energy = nine_modes(x[c], gradient)
            else:
                energy = double_well(x[c], heights[c], gradient)
            if k % every == 0:
                s = k // every
                positions[s, c], energies[s, c], weights[s, c] = x[c], energy, 1.0
                if count:
                    weights[s, c] = importance(theta[c], energy, low, width, zeta)
            draws = normals[k, c]
            nu = constant
            if count:
                at = partition(energy + stream_noise * draws[0], low, width, count)
                nu = multiplier(theta[c], at, zeta * temperature / width, clamp[0], clamp[1])
                update_weights(theta[c], at, zeta, step)
            nu_sum[c] += nu
            inside = True
            for d in range(dim):
                g = gradient[d] + stream_noise * draws[1 + d]
                move = rates[k] * nu * g
                if drift == 1:
                    exp_avg[c, d] += (1 - betas[0]) * (g - exp_avg[c, d])
                    exp_avg_sq[c, d] = betas[1] * exp_avg_sq[c, d] + (1 - betas[1]) * g * g
                    denominator = math.sqrt(exp_avg_sq[c, d]) / math.sqrt(bias2) + EPS
                    move = rates[k] * nu / bias1 * exp_avg[c, d] / denominator
                proposal[d] = x[c, d] - move + deviations[k] * draws[1 + dim + d]
                inside = inside and abs(proposal[d]) <= boundary
            if inside:
                x[c] = proposal
