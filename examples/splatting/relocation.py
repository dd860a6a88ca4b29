"""The equation by which 3DGS-MCMC replaces one Gaussian by several equal ones."""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_COPIES = 51  # gsplat's table of binomial coefficients ends here; 3dgs-mcmc stops at 50
MAX_OPACITY = 1.0 - torch.finfo(torch.float32).eps  # their upper bound: its logit is finite


def relocated_values(
    opacities: Tensor, scales: Tensor, copies: Tensor, min_opacity: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Opacity and scale of N copies that together look like one Gaussian (MCMC paper, eq. 9).

    The composite keeps its opacity at the centre and its integral over every line through it.
    (Eq. 3 of the Opt3DGS paper is the same equation.)

    Args:
        opacities: [M], after the sigmoid.
        scales: [M, 3], world units, after the exponential.
        copies: [M] int, N, the original included; more than 51 count as 51, as in gsplat.
        min_opacity: of a copy; gsplat after 1.5.3 has it before the scales are computed.

    Returns:
        opacities [M] and scales [M, 3]. Computed in float64, which the alternating sum deserves.
    """
    number = copies.clamp(1, MAX_COPIES)
    # An opacity that rounded to 1 would make terms of 1e14 cancel.
    old = opacities.double().clamp(max=MAX_OPACITY)
    # 1 - (1 - o)^(1/N) without the cancellation
    new = (-torch.expm1(torch.log1p(-old) / number)).clamp(min=min_opacity)
    # The sum over i = 1..N of binom(i - 1, k) is binom(N, k + 1): one sum is left of two.
    table = _signed_binomials(old.device)[number]  # [M, 51]
    powers = new[:, None] ** torch.arange(1, MAX_COPIES + 1, device=old.device)
    ratio = old / (table * powers).sum(dim=1)
    return new.to(opacities.dtype), (scales * ratio[:, None]).to(scales.dtype)


def _signed_binomials(device: torch.device) -> Tensor:
    """(-1)^(j - 1) binom(N, j) / sqrt(j) for N = 0..51 (rows) and j = 1..51, float64."""
    columns = range(1, MAX_COPIES + 1)
    rows = [
        [(-1) ** (j - 1) * math.comb(n, j) / math.sqrt(j) for j in columns]
        for n in range(MAX_COPIES + 1)
    ]
    return torch.tensor(rows, dtype=torch.float64, device=device)
