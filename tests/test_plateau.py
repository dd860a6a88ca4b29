"""Whether more iterations still help, by the losses that a training has seen."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from gaussians import adams_of, parameters

from opt3dgs_optim import PhaseScheduler
from opt3dgs_optim.plateau import WINDOW, Plateau, gain


def lines(losses: Any) -> list[tuple[int, str]]:
    """The iterations in which something is said, and what."""
    plateau = Plateau()
    found = ((i + 1, plateau.line(loss, i)) for i, loss in enumerate(losses))
    return [(i, said) for i, said in found if said is not None]


def test_a_gain_is_in_decibels_of_an_amplitude() -> None:
    assert gain([0.2, 0.2], [0.1, 0.1]) == pytest.approx((20 * math.log10(2), 0.0))
    draw = torch.Generator().manual_seed(0)
    noisy = 0.1 * (1 + 0.1 * torch.randn(2, 1_000, generator=draw, dtype=torch.float64))
    found, error = gain(*noisy.tolist())
    assert error == pytest.approx(8.686 * 0.1 * math.sqrt(2 / 1_000), rel=0.05)
    assert abs(found) < 3 * error


def test_a_loss_that_falls_no_more_is_told_once() -> None:
    draw = torch.Generator().manual_seed(0)
    losses = 0.05 * (1 + 0.02 * torch.randn(5 * WINDOW, generator=draw))
    ((at, said),) = lines(losses)
    assert at == 2 * WINDOW
    assert "the 2,000 iterations up to 4,000 gained" in said
    assert said.endswith("phases.finish_in(800) ends the training")


def test_a_loss_that_falls_is_not() -> None:
    iteration = torch.arange(5 * WINDOW)
    assert not lines(0.05 * 10 ** (-0.1 / 20 * iteration / WINDOW))


@pytest.mark.parametrize("loss", [0.0, -1.0, math.nan, math.inf])
def test_where_nothing_can_be_said(loss: float) -> None:
    assert not lines(torch.full((3 * WINDOW,), loss))


def test_views_that_differ_take_longer() -> None:
    """Three hundred views, whose losses differ by a half, in an order anew for each epoch."""
    draw = torch.Generator().manual_seed(0)
    views = 0.05 * torch.exp(0.47 * torch.randn(300, generator=draw))
    epochs = [views[torch.randperm(300, generator=draw)] for _ in range(100)]
    ((at, said),) = lines(torch.cat(epochs))
    assert 5 * WINDOW < at < 12 * WINDOW
    assert f"the {at // 5:,} iterations up to {at:,} gained" in said


def test_a_loss_whose_views_differ_too_much_says_nothing() -> None:
    draw = torch.Generator().manual_seed(0)
    assert not lines(0.05 * torch.randn(4 * WINDOW, generator=draw).exp().pow(2))


@pytest.mark.parametrize(("total", "said"), [(None, True), (30_000, False)])
def test_it_is_said_where_no_end_is_planned(total: Any, said: bool, caplog: Any) -> None:
    caplog.set_level("INFO")
    phases = PhaseScheduler(total)
    phases.upgrade(adams_of(parameters(5, "means")))
    for iteration in range(2 * WINDOW):
        phases.observe(0.1, iteration=iteration)
    assert ("dB in the loss" in caplog.text) is said


def test_a_loss_that_rises_is_another_loss() -> None:
    """As where a trainer resets opacities."""
    iteration = torch.arange(5 * WINDOW)
    assert not lines(0.05 * 10 ** (1.0 / 20 * iteration / WINDOW))


@pytest.mark.parametrize(("stride", "calls", "at"), [(1, 4, 2 * WINDOW), (10, 1, None)])
def test_iterations_count_and_not_calls(stride: int, calls: int, at: Any) -> None:
    """Several losses of an iteration are one; without those of each iteration nothing is said."""
    plateau, said = Plateau(), None
    for iteration in range(0, 4 * WINDOW * stride, stride):
        for _ in range(calls):
            if plateau.line(torch.tensor(0.1), iteration) is not None:
                said = iteration + 1
    assert said == at


def test_a_loss_that_is_changed_in_place_afterwards() -> None:
    plateau, loss, said = Plateau(), torch.zeros(()), []
    for iteration in range(2 * WINDOW):
        said.append(plateau.line(loss.fill_(0.1), iteration))
        loss.zero_()
    assert "gained 0.00 dB" in said[-1]
