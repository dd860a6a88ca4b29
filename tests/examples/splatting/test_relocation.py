"""Relocated values: the printed equation, and what it is made to preserve."""

from __future__ import annotations

import math

import pytest
import torch
from splatting.relocation import relocated_values

F64 = torch.float64


def printed_equation(opacity: float, copies: int) -> tuple[float, float]:
    """Eq. 9 of the 3DGS-MCMC paper as it is printed: new opacity and factor on the scale."""
    new = 1.0 - (1.0 - opacity) ** (1.0 / copies)
    total = 0.0
    for i in range(1, copies + 1):
        for k in range(i):
            total += math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
    return new, opacity / total


@pytest.mark.parametrize("opacity", [0.005, 0.1, 0.5, 0.9, 0.999])
@pytest.mark.parametrize("copies", [1, 2, 3, 7, 20, 51])
def test_relocated_values_against_the_printed_equation(opacity, copies):
    opacities, scales = relocated_values(
        torch.tensor([opacity], dtype=F64),
        torch.tensor([[0.3, 1.0, 2.0]], dtype=F64),
        torch.tensor([copies]),
    )
    new, factor = printed_equation(opacity, copies)
    # 1e-9: the oracle's alternating double sum cancels up to 1e5 (51 copies, opacity .999)
    torch.testing.assert_close(opacities, torch.tensor([new], dtype=F64), rtol=1e-9, atol=0)
    expected = factor * torch.tensor([[0.3, 1.0, 2.0]], dtype=F64)
    torch.testing.assert_close(scales, expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.95])
@pytest.mark.parametrize("copies", [2, 5, 51])
def test_copies_composite_to_the_old_centre_and_the_old_integral(opacity, copies):
    old_scale = 0.7
    new, scale = relocated_values(
        torch.tensor([opacity], dtype=F64),
        torch.full((1, 3), old_scale, dtype=F64),
        torch.tensor([copies]),
    )
    # Alpha compositing of N equal Gaussians along one axis: 1 - (1 - o G(x))^N.
    x = torch.linspace(-12, 12, 20_001, dtype=F64)
    composite = 1 - (1 - new * torch.exp(-0.5 * (x / scale[0, 0]) ** 2)) ** copies
    before = opacity * torch.exp(-0.5 * (x / old_scale) ** 2)
    # 1e-12 and 1e-9: float64; the trapezoid rule is exact for functions that vanish so smoothly
    torch.testing.assert_close(composite[10_000], before[10_000], rtol=1e-12, atol=0)
    torch.testing.assert_close(
        torch.trapezoid(composite, x), torch.trapezoid(before, x), rtol=1e-9, atol=0
    )


def test_one_copy_changes_nothing_and_extremes_stay_finite():
    opacities = torch.tensor([0.2, 1.0, 1e-30, 0.5])
    scales = torch.ones(4, 3)
    new, scale = relocated_values(opacities, scales, torch.tensor([1, 51, 3, 10_000]))
    assert new.dtype == scale.dtype == torch.float32
    torch.testing.assert_close(new[0], opacities[0])
    torch.testing.assert_close(scale[0], scales[0])
    assert torch.isfinite(new).all()
    assert torch.isfinite(scale).all()
    assert (scale > 0).all()
    capped, _ = relocated_values(opacities[3:], scales[3:], torch.tensor([51]))
    assert torch.equal(new[3:], capped)
    assert relocated_values(opacities[:0], scales[:0], torch.zeros(0).long())[1].shape == (0, 3)
