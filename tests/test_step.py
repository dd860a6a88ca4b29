"""The step in plain torch: in pieces, on a device, and where numbers leave their range."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any, cast

import numpy as np
import pytest
import torch
from simulated_device import on_device, on_host
from step_cases import case, moved, tensors
from torch import Tensor
from torch.utils._pytree import tree_leaves

from opt3dgs_optim import Fading, OwnFrame, PositionNoise
from opt3dgs_optim import step as module
from opt3dgs_optim.mean import Mean, places_of, take_into_mean
from opt3dgs_optim.moments import CODES, chances
from opt3dgs_optim.step import (
    Axes,
    finite,
    into_frame,
    mixed,
    out_of_frame,
    take_step,
)

CPU = torch.device("cpu")
NAN, INF = float("nan"), float("inf")
KINDS: dict[str, dict[str, Any]] = {
    "rows": {"fade": True, "hold": True, "decay": 0.1},
    "frame": {"frame": True, "shrink": 0.9},
    "plain": {"plain": True},
}
each_kind = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


def stepped(device: bool = False, rows: int = 50, seed: int = 0, **options: Any) -> list[Tensor]:
    """What a step leaves, on the CPU, and how many numbers were not finite."""
    step = case((rows, 3), torch.Generator().manual_seed(seed), **options)
    if device:
        step = moved(step, on_device)
    assert step.nonfinite is not None
    bad = take_step(step)
    assert bad == 0 or not device  # nobody waits
    return [on_host(each) for each in (*tensors(step), step.nonfinite + bad)]


@pytest.mark.parametrize("kind", [*KINDS.values(), {"coded": True}], ids=[*KINDS, "16 bits"])
def test_pieces_make_the_whole(kind: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    options = {**kind, "mean": True, "put": True, "bad": 100}
    whole = stepped(**options)
    monkeypatch.setattr(module, "CHUNK", 12)
    for ours, theirs in zip(whole, stepped(**options), strict=True):
        assert torch.equal(ours, theirs)
    assert whole[-1] == 100


@each_kind
def test_a_device_steps_as_a_cpu(kind: dict[str, Any]) -> None:
    """It counts there what was not finite, and reads a factor there."""
    options = {**kind, "fade": False, "mean": True, "put": True, "bad": 3}
    host = stepped(**options, factor=0.25)
    for ours, theirs in zip(
        host, stepped(device=True, **options, factor=torch.tensor(0.25)), strict=True
    ):
        torch.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-7)  # the factor's product
    assert host[-1] == 3
    grad = on_device(torch.tensor([1.0, NAN]))
    assert on_host(finite(grad, None)[0]).tolist() == [1.0, 0.0]  # where nobody counts


@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_a_number_that_is_not_finite_costs_no_other_its_place_in_the_mean(value: float) -> None:
    """An iterate leaves its mean alone, and is not put over; a mean begins with its iterate."""
    mean, began = torch.tensor([[2.0, 2.0], [value, 2.0], [7.0, 2.0]]), torch.tensor([1.0, 1.0, 0])
    param = torch.tensor([[8.0, value], [8.0, 8.0], [8.0, 8.0]])
    take_into_mean(Mean(True, 3, mean, began), param)
    assert mean.tolist() == [[4.0, 2.0], [8.0, 4.0], [8.0, 8.0]]
    torch.testing.assert_close(
        param, torch.tensor([[4.0, value], [8.0, 4.0], [8.0, 8.0]]), equal_nan=True
    )
    assert began.tolist() == [1.0, 1.0, 3.0]


GRID = 2.0**-12


def mean_of(param: Tensor, residue: Tensor) -> Tensor:
    return param + places_of(param, residue, GRID)[-1] * GRID


@pytest.mark.parametrize("centre", [0.0, -100.0, 2_000.0])
def test_a_mean_at_16_bits_is_that_of_a_thousand_iterates(centre: float) -> None:
    """Rounded a thousand times; of rows that begin at the first one, and at the 600th.

    They wander by two hundred places a step, a way of a tenth of what 16 bits reach.
    """
    draw, x = torch.Generator().manual_seed(0), torch.full((2, 2_000), centre)
    residue, began, iterates = torch.zeros(2, 2_000, dtype=CODES), torch.zeros(2), []
    chance = chances(x, mixed(0), 0)
    for number in range(1, 1_001):
        x += 200 * GRID * torch.randn(x.shape, generator=draw) + 1e-2 * (centre - x)
        iterates.append(x.double())
        if number == 600:
            began[1], residue[1] = 0.0, 0
        chance = chances(x, mixed(number), 0)
        take_into_mean(Mean(False, number, residue, began, GRID), x, chance=chance)
    for row, first in ((0, 0), (1, 599)):
        exact = torch.stack(iterates[first:]).mean(0)[row]
        off = (mean_of(x, residue)[row] - exact) / GRID
        assert 1.0 < off.square().mean() ** 0.5 < 9.0  # places: the docstring's seven
        assert abs(off.mean()) < 5 * off.std() / 2_000**0.5 + 0.1  # no drift
    assert began.tolist() == [1.0, 600.0]
    exact = torch.stack([*iterates, x.double()]).mean(0)[0]
    take_into_mean(Mean(True, 1_001, residue, began, GRID), x, chance=chance)
    assert (x[0] - exact).abs().max() < 40 * GRID


def test_a_mean_at_16_bits_that_is_too_far_follows_its_iterate() -> None:
    """16 bits reach for 32,768 places; one that runs on and on has its mean at 24,576 of them."""
    x = torch.zeros(1, 500)
    residue, began = torch.zeros(1, 500, dtype=CODES), torch.zeros(1)
    for number in range(1, 1_001):
        x += 100 * GRID
        take_into_mean(
            Mean(False, number, residue, began, GRID), x, chance=chances(x, mixed(number), 0)
        )
    away = (mean_of(x, residue) - x) / GRID
    assert (away + 24_576).abs().max() <= 1


@pytest.mark.parametrize("value", [NAN, INF, -INF, 3e38, -(2.0**11)])
def test_an_iterate_without_a_place_leaves_its_mean_alone(value: float) -> None:
    """It is not put over, and its row goes on where it was."""
    x = torch.tensor([[1.0, 1.0]])
    residue, began = torch.zeros(1, 2, dtype=CODES), torch.zeros(1)
    for number, iterate in ((1, 1.0), (2, value), (3, 2.0)):
        x[0, 0] = iterate
        take_into_mean(
            Mean(number == 2, number, residue, began, GRID), x, chance=chances(x, mixed(number), 0)
        )
        if number == 2:
            assert x[0, 0].isnan() if math.isnan(value) else x[0, 0] == value
            assert x[0, 1] == 1.0
    # Of three iterates the mean has seen two, with the weights 1 and a third.
    assert mean_of(x, residue)[0, 0] == pytest.approx(1.0 + 1 / 3, abs=2 * GRID)


@pytest.mark.parametrize("put", [False, True])
def test_a_mean_at_16_bits_is_the_same_mean(put: bool) -> None:
    """Also where the trainer decays the parameter."""
    options: dict[str, Any] = {"coded": True, "mean": True, "put": put, "shrink": 0.9, "decay": 0.1}
    step, step2 = (case((50, 3), torch.Generator().manual_seed(2), **options) for _ in range(2))
    assert step.mean is not None
    assert step2.mean is not None
    step.mean.grid = GRID
    step2.mean.tensor = mean_of(step2.param, step2.mean.tensor)
    take_step(step)
    take_step(step2)
    torch.testing.assert_close(step.param, step2.param, rtol=1e-6, atol=1e-6)
    near = mean_of(step2.param, step.mean.tensor) - step2.mean.tensor
    assert near.abs().max() <= GRID


# -- own frames ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_gradient_that_adam_cannot_square_counts_as_zero_in_the_frame(dtype: torch.dtype) -> None:
    """Half of the largest number that it can is taken; a row costs no other."""
    root = torch.finfo(dtype).max ** 0.5
    zero, one = torch.zeros(3, dtype=dtype), torch.ones(3, dtype=dtype)
    world = Axes((one, zero, zero, zero), (one, one, one))
    vectors = torch.tensor(
        [[root / 2, 1.0, -0.4 * root], [2.0 * root, -1.1 * root, 0.0], [1.0, 2.0, 3.0]], dtype=dtype
    )
    found = into_frame(world, vectors)
    assert torch.equal(found[[0, 2]], vectors[[0, 2]])
    assert found[1].tolist() == [0.0, 0.0, 0.0]


def test_a_step_to_no_finite_place_is_none() -> None:
    """The largest finite one is one."""
    zero, one, largest = torch.zeros(2), torch.ones(2), torch.finfo(torch.float32).max
    world = Axes((one, zero, zero, zero), (one, one, one))
    vectors = torch.tensor([[largest, 0.0, 0.0], [0.0, 1.0, INF]])
    assert out_of_frame(world, vectors).tolist() == [[largest, 0.0, 0.0], [0.0, 0.0, 0.0]]


@pytest.mark.parametrize("kind", [*KINDS.values(), {"coded": True}], ids=[*KINDS, "16 bits"])
def test_the_cases_of_a_gpu_lie_on_it(kind: dict[str, Any]) -> None:
    """In whole: the kernels of a GPU would read what is left on the host as its own."""
    step = case((9, 3), torch.Generator().manual_seed(0), mean=True, **kind)
    there = moved(step, lambda tensor: tensor.to("meta"))
    found = [x for x in tree_leaves(asdict(there)) if isinstance(x, Tensor)]
    assert {each.device.type for each in found} == {"meta"}
    assert len(found) >= 7  # of the parameter, the mean and the counter


def test_options_are_pythons_own_numbers() -> None:
    """A launcher takes another kind of number for another kind of argument."""
    half, three, two = cast(tuple[Any, ...], (np.float32(0.5), np.int64(3), np.float64(2)))
    own, fading = OwnFrame(rate=1, min_aspect=half), Fading(share=1, seed=three)
    noise = PositionNoise(scale=two)
    found = (own.rate, own.min_aspect, fading.share, fading.seed, noise.scale)
    assert [type(each) for each in found] == [float, float, float, int, float]
