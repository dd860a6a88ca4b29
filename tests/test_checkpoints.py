"""Checkpoints: what is damaged is refused, and nothing has changed; the rest goes on from there."""

from __future__ import annotations

import copy
import json
import math
from typing import Any

import numpy as np
import pytest
import row_edits
import torch
from gaussians import adam_of, adams_of, parameters, same_tensors, steps, through_a_file
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from opt3dgs_optim import Averaging, EnergyHistogram, Fading, OutOfView, PhaseScheduler

TOTAL, ROWS = 60, 4
NAMES = ("means", "scales")


def trained(count: int = 59) -> tuple[PhaseScheduler, Any, dict[str, Any]]:
    """One Adam of two groups, in the mean, with a part that learns and one with notes."""
    params = parameters(ROWS, *NAMES)
    parts = [Fading(), OutOfView(), Averaging(), EnergyHistogram(warmup=5)]
    phases = PhaseScheduler(TOTAL, parts=parts)
    optimizer = phases.upgrade(adam_of(params))
    for iteration in range(count):
        phases.observe(0.1 + 0.01 * (iteration % 7))
        steps({"all": optimizer}, params, 1, seed=iteration)
    return phases, optimizer, params


def opened(state: Any) -> Any:
    """With what is ours in the groups as the dict that the line of JSON is."""
    for group in state["param_groups"]:
        group["opt3dgs"] = json.loads(group["opt3dgs"])
    return state


def closed(state: Any) -> Any:
    """As it is saved."""
    if isinstance(state, dict) and isinstance(state.get("param_groups"), list):
        for group in state["param_groups"]:
            if isinstance(group, dict) and isinstance(group.get("opt3dgs"), dict):
                group["opt3dgs"] = json.dumps(group["opt3dgs"])
    return state


SAVED = opened(through_a_file(trained()[1].state_dict()))
PATHS: list[tuple[Any, ...]] = []  # of everything in it


def list_paths(value: Any, path: tuple[Any, ...] = ()) -> None:
    PATHS.append(path)
    items = value.items() if isinstance(value, dict) else ()
    if isinstance(value, (list, tuple)):
        items = list(enumerate(value))[:3]  # of the histogram's weights a few are enough
    for key, each in items:
        list_paths(each, (*path, key))


list_paths(SAVED)
IGNORED = {"name", "foreach", "fused", "decoupled_weight_decay"}  # torch's: any value
WRONG = ("gone", "renamed", None, "text", [], {}, -1, math.nan, True, 10**9, "shape", "complex")


def at(value: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        value = value[key]
    return value


def damaged(path: tuple[Any, ...], wrong: Any) -> Any:
    """The checkpoint with one thing in it spoiled; None where that would be no damage."""
    if not path:
        return None if wrong in ("gone", "renamed", "shape", "complex") else wrong
    result = copy.deepcopy(SAVED)
    holder, key = at(result, path[:-1]), path[-1]
    if isinstance(holder, tuple):
        return None
    value = holder[key]
    if wrong == "gone":
        del holder[key]
    elif wrong == "renamed":
        if not isinstance(holder, dict):
            return None
        holder["renamed"] = holder.pop(key)
    elif wrong in ("shape", "complex"):
        if not isinstance(value, Tensor):
            return None
        holder[key] = value[None, None] if wrong == "shape" else value.to(torch.complex64)
        if wrong == "shape" and value.numel() == 1:
            return None  # a count of steps
    else:
        holder[key] = wrong
    return closed(result)


def snapshot(phases: PhaseScheduler, optimizer: Any, params: dict[str, Any]) -> Any:
    numbers = (phases.iteration, repr(phases), repr(phases.part(EnergyHistogram)))
    return numbers, copy.deepcopy(optimizer.state_dict()), {k: v.clone() for k, v in params.items()}


def equal(a: Any, b: Any) -> bool:
    if isinstance(a, Tensor):
        return isinstance(b, Tensor) and torch.equal(a, b)
    if isinstance(a, dict):
        return set(a) == set(b) and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == b or (isinstance(a, float) and math.isnan(a) and math.isnan(b))


@pytest.mark.filterwarnings("ignore:PhaseScheduler. iteration .* of total_steps")  # that is told
@settings(max_examples=150)
@given(path=st.sampled_from(PATHS), wrong=st.sampled_from(WRONG), upgraded=st.booleans())
def test_what_is_damaged_is_refused_and_nothing_has_changed(
    path: tuple[Any, ...], wrong: Any, upgraded: bool
) -> None:
    """Or it is no damage, and the training steps on. In both orders of `upgrade` and load."""
    state = damaged(path, wrong)
    if state is None or (path and path[-1] in IGNORED):
        return
    phases, optimizer, params = trained(3)
    if not upgraded:
        optimizer = adam_of(params)
    if not upgraded and "opt3dgs" not in path:
        return  # a stock Adam takes it as it likes
    refused, before = "", snapshot(phases, optimizer, params)
    try:
        optimizer.load_state_dict(through_a_file(state))
        if not upgraded:
            before = snapshot(phases, optimizer, params)
            phases.upgrade(optimizer)
    except ValueError as error:
        refused = str(error)
    if refused:
        assert "load_state_dict: " in refused or "upgrade: " in refused
        assert equal(before, snapshot(phases, optimizer, params))
    else:
        phases.observe(0.1)
        steps({"all": optimizer}, params, 1)
        assert all(bool(torch.isfinite(param).all()) for param in params.values())


@pytest.mark.parametrize("wrong", ["gone", None, "text", [], {}, -1, math.nan])
@pytest.mark.parametrize(
    "path",
    [
        ("state",),
        ("state", 0),
        ("state", 0, "exp_avg"),
        ("state", 1, "step"),
        ("param_groups",),
        ("param_groups", 0),
        ("param_groups", 0, "params"),
        ("param_groups", 0, "lr"),
        ("param_groups", 0, "betas"),
        ("param_groups", 0, "opt3dgs", "format"),
        ("param_groups", 0, "opt3dgs", "iteration"),
        ("param_groups", 0, "opt3dgs", "notes"),
        ("param_groups", 0, "opt3dgs", "parts"),
        ("param_groups", 0, "opt3dgs", "last"),
    ],
    ids=lambda path: path[-1] if isinstance(path, tuple) else None,
)
def test_the_usual_damage_is_refused(path: tuple[Any, ...], wrong: Any) -> None:
    ours = ("param_groups", 0, "opt3dgs")
    fine = [  # an empty state is Adam's before its first step
        *[(("state",), {}), (("state", 0), {}), (("state", 0), "gone")],
        *[((*ours, "notes"), {}), ((*ours, "parts"), {})],
    ]
    phases, optimizer, params = trained(3)
    before = snapshot(phases, optimizer, params)
    if (path, wrong) in fine:
        optimizer.load_state_dict(damaged(path, wrong))
        return
    with pytest.raises(ValueError, match=r"Adam.load_state_dict: "):
        optimizer.load_state_dict(damaged(path, wrong))
    assert equal(before, snapshot(phases, optimizer, params))


def test_a_state_of_an_unknown_parameter_is_refused() -> None:
    phases, optimizer, params = trained(3)
    before, state = snapshot(phases, optimizer, params), closed(copy.deepcopy(SAVED))
    state["state"][len(NAMES)] = state["state"][0]
    with pytest.raises(ValueError, match=r"Adam.load_state_dict: the state is not of .* \[0, 1\]"):
        optimizer.load_state_dict(state)
    assert equal(before, snapshot(phases, optimizer, params))


@pytest.mark.parametrize("option", ["amsgrad", "maximize", "differentiable", "capturable"])
def test_options_that_are_refused_do_not_come_with_a_checkpoint(option: str) -> None:
    _, optimizer, params = trained(3)
    stock = adam_of(params)
    stock.param_groups[1][option] = True
    with pytest.raises(ValueError, match=f"group 1 has {option}=True"):
        optimizer.load_state_dict(stock.state_dict())


def test_the_state_is_plain_and_of_the_moment() -> None:
    """Tensors with rows first, float32; the rest survives weights_only=True."""
    _, optimizer, _ = trained()
    saved = optimizer.state_dict()
    for state in saved["state"].values():
        kept = set(state) - {"averaging.rest"}  # of positions
        assert kept == {"step", "exp_avg", "exp_avg_sq", "averaging.mean", "averaging.began"}
        assert all(v.dtype == torch.float32 for v in state.values())
        assert all(len(v) == ROWS for k, v in state.items() if k != "step")
    assert json.loads(saved["param_groups"][0]["opt3dgs"])["iteration"] == 59
    assert optimizer.param_groups[0]["opt3dgs"] == ""
    assert equal(saved, through_a_file(saved))


@pytest.mark.parametrize("anew", [False, True])
def test_a_stock_adam_that_goes_on_with_a_checkpoint_of_ours_is_noticed(
    anew: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """Its own steps say how far it has come, and its moments are no own frame's."""
    caplog.set_level("INFO")
    params = parameters(ROWS, "means", "scales", "quats")
    optimizer = PhaseScheduler(1000).upgrade(adam_of(params))
    steps({"all": optimizer}, params, 30)
    stock = adam_of(params)
    stock.load_state_dict(optimizer.state_dict())
    if anew:  # as docs/index.md says: it counts from 0
        stock.state.clear()
    steps({"all": stock}, params, 20)
    again = adam_of(params)
    again.load_state_dict(stock.state_dict())
    phases = PhaseScheduler(1000)
    phases.upgrade(again)
    assert caplog.text.count("a stock Adam has gone on for 20 steps with this checkpoint") == 1
    steps({"all": again}, params, 1)
    assert phases.iteration == 50
    assert again.state[params["means"]]["step"] == 1  # they begin anew, in the own frame
    assert again.state[params["scales"]]["step"] == (21 if anew else 51)


@pytest.mark.parametrize("ours", [False, True])
def test_it_is_told_where_a_stock_checkpoint_goes_on(
    ours: bool, caplog: pytest.LogCaptureFixture
) -> None:
    """A trainer that leaves out steps is further than Adam has counted."""
    caplog.set_level("INFO")
    params = parameters(5, "means", "scales")
    optimizers = adams_of(params)
    if ours:
        PhaseScheduler(100, parts=[Averaging()]).upgrade(optimizers)
    steps(optimizers, params, 30)
    saved = {name: optimizer.state_dict() for name, optimizer in optimizers.items()}
    made = adams_of(params)
    for name, optimizer in made.items():
        optimizer.load_state_dict(saved[name])
    PhaseScheduler(100, parts=[Averaging()]).upgrade(made)
    said = "goes on at iteration 30, by Adam's count of steps; where the trainer has left out steps"
    assert caplog.text.count(said) == (not ours)


def test_it_is_told_where_a_checkpoint_has_lost_its_mean(caplog: pytest.LogCaptureFixture) -> None:
    """As where torch.distributed.checkpoint loads what a new optimizer has, and no more."""
    caplog.set_level("INFO")
    _, optimizer, _ = trained()
    said = "the checkpoint was loaded without the mean of the last iterates"
    for told in (0, 1):
        saved = optimizer.state_dict()
        for state in saved["state"].values():
            for key in [key for key in state if "." in key] * told:
                del state[key]
        optimizer.load_state_dict(saved)
        assert caplog.text.count(said) == told


@pytest.mark.parametrize(
    "noted", [[1.0, 2.0], math.nan, torch.ones(()), np.float32(1), "text", None]
)
def test_notes_that_no_checkpoint_holds_are_refused_at_the_first_save(noted: Any) -> None:
    """And not when the run is to go on from it."""
    params = parameters(5, "means")
    phases = PhaseScheduler(60, parts=[Averaging()])
    optimizer = phases.upgrade(adam_of(params))
    phases.notes_of(phases.parts[0])["mine"] = noted
    with pytest.raises(ValueError, match=r"notes of Averaging are .*but finite numbers of Python"):
        optimizer.state_dict()
    phases.notes_of(phases.parts[0])["mine"] = True
    optimizer.load_state_dict(optimizer.state_dict())
    assert phases.notes_of(phases.parts[0]) == {"mine": True}


@pytest.mark.parametrize("copied", [False, True])
def test_rows_that_moved_since_the_last_step_are_not_saved_with_their_old_mean(
    copied: bool,
) -> None:
    """gsplat's relocation, and then a save, or a copy, before the next step."""
    ends = []
    for save in (False, True):
        params: Any = parameters(8, "means", "sh0")
        optimizers = PhaseScheduler(90, parts=[Averaging()]).upgrade(adams_of(params))
        steps(optimizers, params, 88)
        dead, alive = torch.tensor([1, 2]), torch.tensor([5, 6])
        with torch.no_grad():
            for param in params.values():
                param[dead] = param[alive]
        edit = row_edits.relocated(dead, alive)
        row_edits.apply(edit, params, list(optimizers.values()), ("means", "sh0"), False)
        if save and copied:
            params, optimizers = copy.deepcopy((params, optimizers))
        elif save:
            saved = {n: copy.deepcopy(each.state_dict()) for n, each in optimizers.items()}
            optimizers = PhaseScheduler(90, parts=[Averaging()]).upgrade(adams_of(params))
            for name, each in optimizers.items():
                each.load_state_dict(saved[name])
        steps(optimizers, params, 2, seed=1)
        ends.append({name: param.detach().clone() for name, param in params.items()})
    assert same_tensors(*ends)


def test_a_training_that_is_put_back_makes_the_same_steps_again() -> None:
    """The same optimizers: what was kept from step to step since then is of no use."""
    params = parameters(40)
    optimizer = PhaseScheduler(600).upgrade(adam_of(params))

    def train(iterations: range) -> None:
        for iteration in iterations:
            for name, param in params.items():
                draw = torch.Generator().manual_seed(iteration)
                param.grad = torch.randn(param.shape, generator=draw)
                if name == "means":  # a view sees one of forty
                    param.grad[torch.arange(40) != iteration % 40] = 0.0
            optimizer.step()

    train(range(250))
    saved, start = copy.deepcopy(optimizer.state_dict()), copy.deepcopy(params)
    train(range(250, 420))
    end = copy.deepcopy(params)
    for name, param in params.items():
        param.data.copy_(start[name])
    optimizer.load_state_dict(saved)
    train(range(250, 420))
    assert same_tensors(params, end)


def test_a_checkpoint_that_is_loaded_for_other_rows_keeps_its_mean() -> None:
    """A trainer that goes back to before its last edit."""
    params = parameters(ROWS, "sh0")
    optimizers = PhaseScheduler(300, parts=[Averaging()]).upgrade(adams_of(params))
    steps(optimizers, params, 295)
    saved = copy.deepcopy(optimizers["sh0"].state_dict())
    optimizers["sh0"].param_groups[0]["params"] = [torch.nn.Parameter(torch.zeros(ROWS, 1, 3))]
    optimizers["sh0"].state.clear()
    optimizers["sh0"].load_state_dict(saved)
    (state,) = optimizers["sh0"].state.values()
    assert torch.equal(state["averaging.mean"], saved["state"][0]["averaging.mean"])
