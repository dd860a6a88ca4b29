"""The mean of the last iterates: what it is, when it takes their place, and what it survives."""

from __future__ import annotations

import math
from typing import Any

import devices
import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from trainers import (
    AveragedThroughout,
    assert_same,
    edit_rows,
    every_one,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    train,
    trained_by_adam,
    upgraded,
    values_of,
)

from opt3dgs_optim import Averaging, PhaseScheduler

TOTAL = 60
FIRST = 45  # the first iteration of the last quarter, whose iterates are averaged


class LastQuarter(Averaging):
    share = 0.25


class LastHalf(Averaging):
    share = 0.5


def kept(optimizers: Any, param: Parameter, name: str) -> Tensor:
    """What the only part keeps of a parameter."""
    state = state_of(optimizers, param)
    (key,) = (key for key in state if key.endswith(f".{name}"))
    return state[key]


MAKERS = pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])


@MAKERS
def test_a_run_ends_at_the_mean_of_its_last_iterates(make: Any) -> None:
    splats, phases, optimizers = upgraded(TOTAL, LastQuarter(), make=make)
    iterates = []
    for i in range(TOTAL - 2):
        train(splats, optimizers, phases, i, i + 1)
        iterates.append(values_of(splats))
    assert_same(trained_by_adam(TOTAL - 2), splats)  # until then it changes nothing
    # INRIA's trainer saves before its last iteration and makes no step in it.
    train(splats, optimizers, phases, TOTAL - 2, TOTAL - 1)
    last = trained_by_adam(TOTAL - 1)
    for name, param in splats.items():
        averaged = [*(each[name] for each in iterates[FIRST:]), last[name]]
        expected = torch.stack([each.detach().double() for each in averaged]).mean(0)
        assert len(averaged) == TOTAL - FIRST - 1
        torch.testing.assert_close(param.double(), expected, rtol=1e-5, atol=1e-7)
    # gsplat's saves before its last step, and evaluates after it: that step stays at the mean.
    mean = values_of(splats)
    train(splats, optimizers, phases, TOTAL - 1, TOTAL)
    for name, param in splats.items():
        off = (param - mean[name]).norm()
        assert off <= 0.1 * (last[name] - mean[name]).norm(), name
        assert torch.equal(param, kept(optimizers, param, "mean"))


def test_a_run_that_goes_on_is_let_go_and_its_memory_given_back() -> None:
    splats, phases, optimizers = upgraded(TOTAL, LastQuarter())
    train(splats, optimizers, phases, 0, TOTAL)
    mean = values_of(splats)
    train(splats, optimizers, phases, TOTAL, TOTAL + 1)
    for name, param in splats.items():
        assert not torch.equal(param, mean[name])
        assert set(state_of(optimizers, param)) == {"step", "exp_avg", "exp_avg_sq"}


def test_it_is_the_mean_of_the_last_thirtieth() -> None:
    splats, phases, optimizers = upgraded(300, Averaging())
    train(splats, optimizers, phases, 0, 300)
    for param in splats.values():
        assert kept(optimizers, param, "count").tolist() == [10.0] * 12


@pytest.mark.parametrize("on_device", [False, True])
def test_steps_that_are_dropped_count_for_nothing(on_device: bool, monkeypatch: Any) -> None:
    """Whether the loss is finite is known on the host, or on the device only."""
    if on_device:
        devices.on_a_device(monkeypatch)
    x = Parameter(torch.full((2, 3), 9.0))
    phases = only(40, AveragedThroughout())
    adam: Any = phases.upgrade({"means": torch.optim.Adam([x], lr=0.1, fused=True)})["means"]
    iterates = []
    for i in range(40):
        x.grad = x.detach().clone()
        before = x.detach().clone()
        phases.observe(float("nan") if i % 3 == 1 else 0.1)
        adam.step()
        if i % 3 == 1:
            assert torch.equal(x, before)
        elif i < 30:
            iterates.append(x.detach().clone())
        if i == 30:
            assert torch.equal(kept(adam, x, "count"), torch.full((2,), 21.0))
            mean = torch.stack([*iterates, x.detach()]).mean(0)
            torch.testing.assert_close(kept(adam, x, "mean"), mean)


def test_it_ends_nearer_to_where_noise_leads_it_around() -> None:
    """Adam at a constant rate about the minimum of a bowl, its gradients noisy."""
    ends = []
    for parts in ([], [LastHalf()]):
        x = Parameter(torch.ones(500, 3))
        phases = only(3_000, *parts)
        (adam,) = phases.upgrade({"means": torch.optim.Adam([x], lr=0.01)}).values()
        generator = torch.Generator().manual_seed(0)
        for _ in range(3_000):
            x.grad = x.detach() + torch.randn(500, 3, generator=generator)
            phases.observe(0.1)
            adam.step()
        ends.append(float(x.detach().square().mean()))
    assert ends[1] < 0.25 * ends[0]


def test_rows_that_density_control_edits_begin_anew() -> None:
    """Alone, too: no other part asks whose rows they are."""
    splats, phases, optimizers = upgraded(TOTAL, AveragedThroughout())
    train(splats, optimizers, phases, 0, 40)
    edit_rows(splats, optimizers, torch.arange(11, -1, -2), 3)
    iterates: list[dict[str, Tensor]] = []
    for i in range(40, 50):
        train(splats, optimizers, phases, i, i + 1)
        iterates.append(values_of(splats))
    for name, param in splats.items():
        assert kept(optimizers, param, "count").tolist() == [10.0] * 9
        expected = torch.stack([each[name] for each in iterates]).mean(0)
        torch.testing.assert_close(kept(optimizers, param, "mean"), expected)


def test_rows_that_are_edited_in_the_last_moment_are_left_where_they_are() -> None:
    splats, phases, optimizers = upgraded(TOTAL, AveragedThroughout())
    train(splats, optimizers, phases, 0, TOTAL - 2)
    edit_rows(splats, optimizers, torch.arange(12), 0)
    before = values_of(splats)
    train(splats, optimizers, phases, TOTAL - 2, TOTAL)
    for name, param in splats.items():
        assert bool((param != 0).all())
        torch.testing.assert_close(param.detach(), before[name], rtol=0, atol=0.2)


def test_with_masks_every_row_has_the_mean_of_its_own_iterates() -> None:
    splats, phases, optimizers = upgraded(TOTAL, LastQuarter(), make=inria_optimizer)
    train(splats, optimizers, phases, 0, FIRST)
    generator, seen = torch.Generator().manual_seed(0), torch.zeros(12)
    sums = {name: torch.zeros_like(param) for name, param in splats.items()}
    for _ in range(FIRST, TOTAL - 2):
        mask = torch.rand(12, generator=generator) < 0.6
        for param in splats.values():
            param.grad = torch.randn(param.shape, generator=generator)
        phases.observe(0.1)
        optimizers.step(mask, 12)
        seen += mask
        for name, param in splats.items():
            sums[name][mask] += param.detach()[mask]
    assert 0 < seen.min() < seen.max()
    for name, param in splats.items():
        assert torch.equal(kept(optimizers, param, "count"), seen)
        expected = sums[name] / seen.reshape(-1, *[1] * (param.dim() - 1))
        torch.testing.assert_close(kept(optimizers, param, "mean"), expected)


def test_with_masks_rows_take_their_means_as_views_see_them() -> None:
    """In the last tenth of the steps that are averaged; what no view sees there stays."""
    splats, phases, optimizers = upgraded(TOTAL, AveragedThroughout(), make=inria_optimizer)
    train(splats, optimizers, phases, 0, TOTAL - 6)
    before = values_of(splats)
    for first in (0, 4):  # of the last six steps two, in which views see eight rows in turns
        mask = (torch.arange(12) >= first) & (torch.arange(12) < first + 4)
        for param in splats.values():
            param.grad = torch.ones_like(param)
        phases.observe(0.1)
        optimizers.step(mask, 12)
    for name, param in splats.items():
        mean = kept(optimizers, param, "mean")
        assert torch.equal(param[:8], mean[:8])
        assert torch.equal(param[8:], before[name][8:])
        assert not torch.equal(param[8:], mean[8:])


def test_what_is_infinite_stays() -> None:
    """gsplat's `--app_opt` takes the logit of the points' colours, and some are 0 or 1."""
    x = Parameter(torch.tensor([[0.0, math.inf, -math.inf], [1.0, 2.0, math.nan]]))
    phases = only(TOTAL, LastHalf())
    (adam,) = phases.upgrade({"sh0": torch.optim.Adam([x], lr=0.1)}).values()
    for _ in range(TOTAL):
        x.grad = torch.where(x.detach().isfinite(), 1.0, 0.0)
        phases.observe(0.1)
        adam.step()
    assert x[0, 1:].tolist() == [math.inf, -math.inf]
    assert bool(x[1, 2].isnan())
    finite, mean = x.isfinite(), kept(adam, x, "mean")
    assert int(finite.sum()) == 3
    assert torch.equal(x[finite], mean[finite])
    assert torch.equal(mean[~finite], torch.zeros(3)), "in a checkpoint all of it must be finite"


def test_half_precision_is_averaged_in_single() -> None:
    x = Parameter(torch.full((4, 3), 100.0, dtype=torch.bfloat16))
    phases = only(400, AveragedThroughout())
    (adam,) = phases.upgrade({"means": torch.optim.Adam([x], lr=0.0)}).values()
    for _ in range(400):
        x.grad = torch.ones_like(x)
        phases.observe(0.1)
        adam.step()
    assert kept(adam, x, "mean").dtype == torch.float32
    assert bool((x == 100).all())


def test_it_takes_its_memory_only_in_the_end() -> None:
    splats, phases, optimizers = upgraded(30_000, Averaging(), make=gsplat_optimizers)
    train(splats, optimizers, phases, 0, 5)
    state = [set(each.state[p]) for each in every_one(optimizers) for p in each.state]
    assert all(keys == {"step", "exp_avg", "exp_avg_sq"} for keys in state)
    assert len(state) == len(make_splats())


@pytest.mark.parametrize("finite", [True, False], ids=["finite", "with a NaN"])
def test_complex_parameters_are_averaged_with_both_their_parts(finite: bool) -> None:
    real, ours = Parameter(torch.zeros(4, 2)), Parameter(torch.zeros(4, dtype=torch.complex64))
    with torch.no_grad():
        if not finite:
            real[1] = torch.view_as_real(ours.data)[1] = float("nan")
    adams = {"means": torch.optim.Adam([ours]), "scales": torch.optim.Adam([real])}
    phases = PhaseScheduler(60, parts=[Averaging()])
    phases.upgrade(adams)
    draw = torch.Generator().manual_seed(0)
    for _ in range(60):
        real.grad = torch.randn(4, 2, generator=draw)
        ours.grad = torch.view_as_complex(real.grad)
        phases.observe(0.1)
        for adam in adams.values():
            adam.step()
    rows = [0, 2, 3]  # torch's own complex step makes a NaN of both parts
    assert torch.equal(torch.view_as_real(ours.detach())[rows], real.detach()[rows])
