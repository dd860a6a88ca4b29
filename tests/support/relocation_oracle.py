"""Eq. 9 of the 3DGS-MCMC paper, slow and obvious; imports nothing of ours."""

from __future__ import annotations

import math


def printed_equation(opacity: float, copies: int) -> tuple[float, float]:
    """Return eq. 9 as it is printed: new opacity and factor on the scale, plain floats."""
    new = 1.0 - (1.0 - opacity) ** (1.0 / copies)
    total = 0.0
    for i in range(1, copies + 1):
        for k in range(i):
            total += math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
    return new, opacity / total
