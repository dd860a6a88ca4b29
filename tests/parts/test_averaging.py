"""The mean of the last iterates: what it is, when it takes their place, and what it survives."""

from __future__ import annotations

from typing import Any

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

from opt3dgs_optim import Averaging, Course

TOTAL = 60
FIRST = 45  # the first iteration of the last quarter: from the next one on iterates are averaged


class LastQuarter(Averaging):
    share = 0.25


class LastHalf(Averaging):
    share = 0.5


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
        averaged = [*(each[name] for each in iterates[FIRST + 1 :]), last[name]]
        expected = torch.stack([each.detach().double() for each in averaged]).mean(0)
        assert len(averaged) == TOTAL - FIRST - 2
        torch.testing.assert_close(param.double(), expected, rtol=1e-5, atol=1e-7)
    # gsplat's saves before its last step, and evaluates after it: that step stays at the mean.
    mean = values_of(splats)
    train(splats, optimizers, phases, TOTAL - 1, TOTAL)
    for name, param in splats.items():
        off = (param - mean[name]).norm()
        assert off <= 0.1 * (last[name] - mean[name]).norm(), name
        assert torch.equal(param, state_of(optimizers, param)["mean_iterate"])


def test_a_run_that_goes_on_is_let_go() -> None:
    splats, phases, optimizers = upgraded(TOTAL, LastQuarter())
    train(splats, optimizers, phases, 0, TOTAL)
    mean = values_of(splats)
    train(splats, optimizers, phases, TOTAL, TOTAL + 1)
    for name, param in splats.items():
        assert not torch.equal(param, mean[name])
        assert not torch.equal(param, state_of(optimizers, param)["mean_iterate"])


def test_it_is_the_mean_of_the_last_thirtieth() -> None:
    splats, phases, optimizers = upgraded(300, Averaging())
    train(splats, optimizers, phases, 0, 300)
    for param in splats.values():  # the first of the ten only makes room
        assert state_of(optimizers, param)["num_averaged"].tolist() == [9.0] * 12


def test_steps_that_a_device_drops_count_for_nothing() -> None:
    """Whether a loss was finite is a tensor there, and the parts' doing is not asked."""
    part, state = AveragedThroughout(), {}
    course = Course([part], total_steps=4)
    for current, valid, value in ((0, True, 9.0), (1, False, 8.0), (2, False, 7.0), (3, True, 6.0)):
        course.current, course.valid = current, torch.tensor(valid)
        param = torch.full((2, 3), value)
        part.after({}, param, state, course)
        assert bool((param == value).all())
        mean = 6.0 if current == 3 else 0.0
        assert bool((state["mean_iterate"] == mean).all())
        assert state["num_averaged"].tolist() == [float(current == 3)] * 2
    course.current, course.valid = 2, torch.tensor(False)
    part.after({}, param := torch.full((2, 3), 5.0), state, course)
    assert bool((param == 5.0).all())


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
        state = state_of(optimizers, param)
        assert state["num_averaged"].tolist() == [9.0] * 9
        expected = torch.stack([each[name] for each in iterates[1:]]).mean(0)
        torch.testing.assert_close(state["mean_iterate"], expected)


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
    train(splats, optimizers, phases, 0, FIRST + 1)
    generator, seen = torch.Generator().manual_seed(0), torch.zeros(12)
    sums = {name: torch.zeros_like(param) for name, param in splats.items()}
    for _ in range(FIRST + 1, TOTAL - 2):
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
        state = state_of(optimizers, param)
        assert torch.equal(state["num_averaged"], seen)
        expected = sums[name] / seen.reshape(-1, *[1] * (param.dim() - 1))
        torch.testing.assert_close(state["mean_iterate"], expected)


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
        mean = state_of(optimizers, param)["mean_iterate"]
        assert torch.equal(param[:8], mean[:8])
        assert torch.equal(param[8:], before[name][8:])
        assert not torch.equal(param[8:], mean[8:])


def test_what_is_infinite_stays() -> None:
    """gsplat's `--app_opt` takes the logit of the points' colours, and some are 0 or 1."""
    x = Parameter(torch.tensor([[0.0, float("inf"), -float("inf")], [1.0, 2.0, 3.0]]))
    phases = only(TOTAL, LastHalf())
    (adam,) = phases.upgrade({"sh0": torch.optim.Adam([x], lr=0.1)}).values()
    for _ in range(TOTAL):
        x.grad = torch.where(x.detach().isinf(), 0.0, 1.0)
        phases.observe(0.1)
        adam.step()
    assert x[0, 1:].tolist() == [float("inf"), -float("inf")]
    finite, mean = x.isfinite(), adam.state[x]["mean_iterate"]
    assert int(finite.sum()) == 4
    assert torch.equal(x[finite], mean[finite])


def test_half_precision_is_averaged_in_single() -> None:
    x = Parameter(torch.full((4, 3), 100.0, dtype=torch.bfloat16))
    phases = only(400, AveragedThroughout())
    (adam,) = phases.upgrade({"means": torch.optim.Adam([x], lr=0.0)}).values()
    for _ in range(400):
        x.grad = torch.ones_like(x)
        phases.observe(0.1)
        adam.step()
    assert adam.state[x]["mean_iterate"].dtype == torch.float32
    assert bool((x == 100).all())


def test_it_takes_its_memory_only_in_the_end() -> None:
    splats, phases, optimizers = upgraded(30_000, Averaging(), make=gsplat_optimizers)
    train(splats, optimizers, phases, 0, 5)
    state = [set(each.state[p]) for each in every_one(optimizers) for p in each.state]
    assert all(keys == {"step", "exp_avg", "exp_avg_sq"} for keys in state)
    assert len(state) == len(make_splats())
