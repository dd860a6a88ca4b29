"""Mistakes of a set-up are said early, in one sentence that names the cure."""

from __future__ import annotations

import copy
import re
import warnings
from argparse import Namespace
from typing import Any

import pytest
import torch
from opt3dgs_optim._mistakes import FROZEN_STEPS
from torch.optim.lr_scheduler import ExponentialLR
from trainers import (
    edit_rows,
    everything,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    train,
    view_loss,
)


@pytest.mark.parametrize("theirs", [5e5, Namespace(noise_lr=5e5), {"noise_lr": 5e5}], ids=str)
def test_noise_twice(theirs: Any) -> None:
    splats = make_splats()
    with pytest.raises(ValueError, match="noise twice; set the trainer's noise_lr to 0, or leave"):
        everything(10, noise_scale=5e5).upgrade(gsplat_optimizers(splats), splats, strategy=theirs)
    everything(10).upgrade(gsplat_optimizers(splats), splats, strategy=theirs)


def test_noise_once_is_fine() -> None:
    splats = make_splats()
    for theirs in (0.0, Namespace(noise_lr=0.0), {"noise_lr": 0}, {}, object(), None):
        everything(10, noise_scale=5e5).upgrade(gsplat_optimizers(splats), splats, strategy=theirs)


def test_observe_never_called() -> None:
    splats = make_splats()
    upgraded = everything(10).upgrade(inria_optimizer(splats))
    view_loss(splats, 0).backward()
    with pytest.warns(UserWarning, match=re.escape("Call observe(loss)")):
        upgraded.step()


@pytest.mark.parametrize("switch", [1.5, 61])
def test_a_switch_beyond_the_last_step(switch: float) -> None:
    with pytest.raises(ValueError, match=re.escape(f"switch={switch}")) as error:
        everything(60, switch)
    assert "is needed" in str(error.value)


def test_a_run_longer_than_announced() -> None:
    """A switch that comes too early for the run it is in."""
    splats, phases = make_splats(), everything(10)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, 10)
    phases.observe(0.1, iteration=10)  # a trainer that counts from 1
    with pytest.warns(UserWarning, match=r"total_steps=10.*pass the training's number"):
        phases.observe(0.1)
    phases.observe(0.1)  # once


def test_frozen_positions_at_the_switch() -> None:
    splats, phases = make_splats(), everything(20, 10)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, 10)
    splats["means"].requires_grad_(False)
    phases.observe(0.1)
    optimizers["scales"].step()
    with pytest.warns(UserWarning, match=r"frozen \(requires_grad is False\).*move the switch"):
        optimizers["means"].step()
    phases.observe(0.1)
    optimizers["means"].step()  # once


def test_positions_without_gradients_after_the_switch() -> None:
    """An iteration or two without is what an edit makes; twenty are not."""
    splats, phases = make_splats(), everything(90, 10)
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, 12)
    for _ in range(FROZEN_STEPS):
        phases.observe(0.1)
        optimizers["means"].step()
    with pytest.warns(UserWarning, match=f"no gradient for {FROZEN_STEPS} steps"):
        optimizers["means"].step()


def test_an_optimizer_that_is_not_adam() -> None:
    splats = make_splats()
    mixed: Any = gsplat_optimizers(splats)
    mixed["means"] = torch.optim.SparseAdam([splats["means"]])  # gsplat's sparse_grad
    with pytest.raises(TypeError, match=r"optimizers\['means'\] is a .*SparseAdam.*is needed"):
        everything(10).upgrade(mixed)


def test_two_groups_of_one_name() -> None:
    optimizer = inria_optimizer(make_splats())
    optimizer.param_groups[2]["name"] = "xyz"
    with pytest.raises(ValueError, match="two groups are named 'xyz'"):
        everything(10).upgrade(optimizer)


def test_a_learning_rate_scheduler_built_before() -> None:
    optimizers = gsplat_optimizers(make_splats())
    ExponentialLR(optimizers["means"], 0.9)
    with pytest.warns(UserWarning, match=r"on optimizers\['means'\].*build learning-rate sched"):
        everything(10).upgrade(optimizers)


def test_a_learning_rate_scheduler_built_on_the_old_object() -> None:
    splats, phases = make_splats(), everything(10)
    old = gsplat_optimizers(splats)
    new = phases.upgrade(old)
    ExponentialLR(old["means"], 0.9)
    with pytest.raises(RuntimeError, match=r"build it on the optimizer that upgrade\(\) returned"):
        train(splats, new, phases, 0, 1)


def test_the_old_optimizer_is_stepped() -> None:
    splats, phases = make_splats(), everything(10)
    old = inria_optimizer(splats)
    new = phases.upgrade(old)
    with pytest.raises(RuntimeError, match=r"replaced by upgrade\(\); keep what it returns"):
        old.step()
    train(splats, new, phases, 0, 2)
    copy.deepcopy(new)  # the watch does not stand in the way


def test_an_unknown_slot() -> None:
    optimizer = gsplat_optimizers(make_splats())["means"]
    with pytest.raises(ValueError, match="name='pose'"):
        everything(10).upgrade_slot("pose", optimizer)


@pytest.mark.parametrize("host_adds_noise", [True, False])
def test_noise_of_a_trainer_that_nobody_told_us_of(host_adds_noise: bool) -> None:
    """The trainer writes noise into the positions after every step, as ours does."""
    splats = make_splats()
    phases = everything(60, multiplier=None, noise_scale=1.0)
    upgraded = phases.upgrade(gsplat_optimizers(splats), splats)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for iteration in range(20):
            train(splats, upgraded, phases, iteration, iteration + 1)
            if host_adds_noise:
                with torch.no_grad():
                    splats["means"].add_(0.01 * torch.randn(splats["means"].shape))
            if iteration % 7 == 0:
                edit_rows(splats, upgraded, torch.arange(len(splats["means"])), 1)
    said = [str(warning.message) for warning in told if "noise_lr to 0" in str(warning.message)]
    assert len(said) == host_adds_noise


def test_a_trainers_noise_is_fine_where_ours_is_off() -> None:
    splats, phases = make_splats(), everything(60, multiplier=None)
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    for iteration in range(10):
        train(splats, upgraded, phases, iteration, iteration + 1)
        with torch.no_grad():
            splats["means"].add_(0.01)
