"""Hostile input: broken gradients and broken losses. Nothing is lost."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from trainers import (
    everything,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    view_loss,
)

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam

BAD = [math.nan, math.inf, -math.inf]
BOTH = [AWSGLD, LQNAdam]
ROWS = 20_000
PATHS = [{}, {"foreach": True}, {"foreach": False}, {"fused": True}]
MILLIONS = pytest.param({}, 2_000_000, marks=pytest.mark.slow, id="millions")


def noise(rows: int, seed: int) -> Tensor:
    return torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed))


def state_of(optimizer: Any, x: Tensor) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in optimizer.state[x].items() if k != "step"}


# -- gradients -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "rows"), [*(pytest.param(path, ROWS, id=str(path)) for path in PATHS), MILLIONS]
)
@pytest.mark.parametrize("cls", BOTH)
def test_broken_rows_stand_still_and_the_others_do_not_notice(
    cls: Any, path: dict, rows: int
) -> None:
    """Among 20,000 rows, or millions, a few break in some steps; the rest is bit-identical."""
    x, y = [torch.nn.Parameter(noise(rows, 0)) for _ in "ab"]
    hostile, clean = cls([x], lr=0.01, **path), cls([y], lr=0.01, **path)
    generator = torch.Generator().manual_seed(1)
    touched = torch.zeros(rows, dtype=torch.bool)
    count = 0
    broken, before = torch.zeros(0), (torch.zeros(0), {})
    for step in range(12):
        x.grad, y.grad = [2 * p.detach() + noise(rows, step) * 0.1 for p in (x, y)]
        if step % 3 == 1:
            broken = torch.randint(rows, (7,), generator=generator).unique()
            x.grad[broken, step % 3] = BAD[step % len(BAD)]
            touched[broken] = True
            count += len(broken)
            before = (
                x.detach()[broken].clone(),
                {k: v[broken] for k, v in state_of(hostile, x).items()},
            )
        hostile.step()
        clean.step()
        if step % 3 == 1:
            assert torch.equal(x.detach()[broken], before[0])
            for key, value in before[1].items():
                assert torch.equal(hostile.state[x][key][broken], value), key
    assert int(hostile.skipped_rows) == count
    assert int(clean.skipped_rows) == 0
    assert torch.equal(x[~touched], y[~touched])
    for key, value in state_of(clean, y).items():
        assert torch.equal(hostile.state[x][key][~touched], value[~touched]), key
    # they recover: after the last broken step (10) they have moved again, and not far
    assert bool(torch.isfinite(x).all())
    assert float((x - y).detach()[touched].abs().max()) < 12 * 0.01 * 4


@pytest.mark.parametrize("cls", BOTH)
def test_rows_broken_for_ever_stand_still_for_ever(cls: Any) -> None:
    x = torch.nn.Parameter(noise(5, 0))
    start = x.detach().clone()
    optimizer = cls([x], lr=0.01)
    for step in range(50):
        x.grad = noise(5, step)
        x.grad[2] = math.nan
        optimizer.step()
    assert torch.equal(x[2], start[2])
    assert not bool((x[[0, 1, 3, 4]] == start[[0, 1, 3, 4]]).any())
    assert int(optimizer.skipped_rows) == 50


@pytest.mark.parametrize("cls", BOTH)
def test_all_rows_broken(cls: Any) -> None:
    x = torch.nn.Parameter(noise(5, 0))
    start = x.detach().clone()
    optimizer = cls([x], lr=0.01)
    for _ in range(3):
        x.grad = torch.full((5, 3), math.nan)
        optimizer.step()
    assert torch.equal(x, start)
    assert int(optimizer.skipped_rows) == 15


@pytest.mark.parametrize("cls", BOTH)
def test_a_sum_that_overflows_is_no_broken_row(cls: Any) -> None:
    """Finite gradients whose sum is infinite are stepped."""
    x = torch.nn.Parameter(torch.ones(4, 3))
    optimizer = cls([x], lr=0.01)
    x.grad = torch.full((4, 3), 3e38)
    optimizer.step()
    assert int(optimizer.skipped_rows) == 0


def test_skipping_can_be_off_and_is_then_torch() -> None:
    x, y = [torch.nn.Parameter(torch.ones(4, 3)) for _ in "ab"]
    ours, theirs = AWSGLD([x], lr=0.01, skip_nonfinite=False), torch.optim.Adam([y], lr=0.01)
    for param, optimizer in ((x, ours), (y, theirs)):
        param.grad = torch.ones(4, 3)
        param.grad[1, 1] = math.nan
        optimizer.step()
    assert torch.equal(x.isnan(), y.isnan())
    assert bool(x.isnan().any())


# -- losses ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
def test_broken_loss_skips_the_step_and_leaves_the_histogram(make: Any, bad: float) -> None:
    """A run with broken losses thrown in is the run without them, in both phases."""
    ends, histograms = [], []
    for hostile in (False, True):
        splats = make_splats()
        histogram = EnergyHistogram(warmup=10, step_size=0.1)
        phases = everything(60, 40, multiplier=histogram)
        optimizers: Any = phases.upgrade(make(splats))
        every = list(optimizers.values()) if isinstance(optimizers, dict) else [optimizers]
        for iteration in range(60):
            if hostile and iteration in (0, 5, 22, 38, 40, 55):
                (view_loss(splats, 1, phases) * bad).backward()
                phases.observe(bad, iteration=iteration)
                for optimizer in every:
                    optimizer.step()
                    optimizer.zero_grad()
            loss = view_loss(splats, iteration % 5, phases)
            loss.backward()
            phases.observe(loss, iteration=iteration)
            for optimizer in every:
                optimizer.step()
                optimizer.zero_grad()
        ends.append(splats)
        histograms.append({**histogram.state_dict(), "num_observed": 0})
    assert histograms[0] == histograms[1]
    for name in ends[0]:
        assert torch.equal(ends[0][name], ends[1][name]), name


@pytest.mark.parametrize("bad", BAD)
def test_closure_with_a_broken_loss(bad: float) -> None:
    x = torch.nn.Parameter(torch.ones(4, 3))
    optimizer = AWSGLD([x], lr=0.01, histogram=EnergyHistogram.paper(warmup=0))

    def closure() -> Tensor:
        loss = (x * bad).sum()
        loss.backward()
        return loss

    optimizer.step(closure)
    assert torch.equal(x, torch.ones(4, 3))
