"""Damaged, foreign and older checkpoints: all of one is loaded, or nothing."""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from trainers import (
    everything,
    gsplat_optimizers,
    make_splats,
    train,
)

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam, PhaseScheduler
from opt3dgs_optim.multiplier import ConstantMultiplier

BOTH = [AWSGLD, LQNAdam]


def noise(rows: int, seed: int) -> Tensor:
    return torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed))


def trained(cls: Any, rows: int = 6, steps: int = 8, **options: Any) -> tuple[Tensor, Any]:
    """A parameter and its optimizer after some steps."""
    x = torch.nn.Parameter(noise(rows, 0))
    if cls is AWSGLD:
        options.setdefault("histogram", EnergyHistogram(warmup=4))
    optimizer: Any = cls([x], lr=0.01, **options)
    for step in range(steps):
        if cls is AWSGLD:
            optimizer.histogram.observe(0.1 + 0.01 * step)
        x.grad = 2 * x.detach() + noise(rows, step) * 0.1
        optimizer.step()
    return x, optimizer


def flat(value: Any) -> Any:
    """A state_dict with tensors as lists, for comparison."""
    if isinstance(value, Tensor):
        return [tuple(value.shape), str(value.dtype), value.flatten().tolist()]
    if isinstance(value, dict):
        return {key: flat(item) for key, item in value.items()}
    return [flat(item) for item in value] if isinstance(value, list) else value


def without(*path: Any) -> Callable[[Any], Any]:
    """Remove one key of a nested state."""

    def change(state: Any) -> Any:
        inner = state
        for key in path[:-1]:
            inner = inner[key]
        del inner[path[-1]]
        return state

    return change


def having(value: Any, *path: Any) -> Callable[[Any], Any]:
    """Set one entry of a nested state."""

    def change(state: Any) -> Any:
        inner = state
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = value
        return state

    return change


GROUP = ("param_groups", 0)
HISTOGRAM = (*GROUP, "opt3dgs", "histogram")
DAMAGE: dict[str, tuple[Callable[[Any], Any], str]] = {
    "no dict": (lambda state: [], "state_dict"),
    "None": (lambda state: None, "state_dict"),
    "no state": (without("state"), "'state'"),
    "no groups": (without("param_groups"), "'param_groups'"),
    "groups are a dict": (having({}, "param_groups"), "'param_groups'"),
    "no params": (without(*GROUP, "params"), "params"),
    "a group more": (lambda s: {**s, "param_groups": s["param_groups"] * 2}, "groups of"),
    "a parameter more": (having([0, 1], *GROUP, "params"), "groups of [2]"),
    "no groups at all": (having([], "param_groups"), "groups of []"),
    "moment of another shape": (having(torch.ones(6, 4), "state", 0, "exp_avg"), "exp_avg"),
    "flat moment": (having(torch.ones(18), "state", 0, "exp_avg_sq"), "exp_avg_sq"),
    "moment is a list": (having([1.0], "state", 0, "exp_avg"), "exp_avg"),
    "no second moment": (without("state", 0, "exp_avg_sq"), "exp_avg_sq"),
    "no step": (without("state", 0, "step"), "step"),
    "SGD's state": (having({"momentum_buffer": torch.ones(6, 3)}, "state", 0), "exp_avg"),
    "state of a parameter is a number": (having(3, "state", 0), "dict"),
    "ours is a list": (having([1], *GROUP, "opt3dgs"), "dict"),
}
DAMAGED_HISTOGRAM: dict[str, tuple[Callable[[Any], Any], str]] = {
    "histogram is None": (having(None, *HISTOGRAM), "dict"),
    "no weights": (without(*HISTOGRAM, "weights"), "weights"),
    "few weights": (having([0.5, 0.5], *HISTOGRAM, "weights"), "2 weights"),
    "weights are a number": (having(1.0, *HISTOGRAM, "weights"), "weights"),
    "NaN in the weights": (having(math.nan, *HISTOGRAM, "weights", 7), "positive"),
    "negative weight": (having(-0.005, *HISTOGRAM, "weights", 7), "positive"),
    "four scalars": (without(*HISTOGRAM, "scalars", 4), "5 numbers"),
    "NaN scalar": (having(math.nan, *HISTOGRAM, "scalars", 2), "5 numbers"),
    "width 0": (having(0.0, *HISTOGRAM, "scalars", 1), "finite"),
    "negative temperature": (having(-1.0, *HISTOGRAM, "scalars", 2), "temperature"),
    "count is a string": (having("8", *HISTOGRAM, "num_observed"), "num_observed"),
    "negative count": (having(-8, *HISTOGRAM, "num_observed"), "num_observed"),
    "half a count": (having(8.5, *HISTOGRAM, "num_observed"), "num_observed"),
    "recent is short": (having([1.0], *HISTOGRAM, "recent"), "4 numbers"),
    "views without means": (without(*HISTOGRAM, "views", "means"), "means"),
    "views too many": (having([1, 2], *HISTOGRAM, "views", "views"), "2 numbers"),
}
CASES = [(cls, name, *case) for cls in BOTH for name, case in DAMAGE.items()]
CASES += [(AWSGLD, name, *case) for name, case in DAMAGED_HISTOGRAM.items()]


@pytest.mark.parametrize(
    ("cls", "change", "message"),
    [pytest.param(c, f, m, id=f"{c.__name__}: {name}") for c, name, f, m in CASES],
)
def test_a_damaged_checkpoint_is_refused_and_nothing_is_loaded(
    cls: Any, change: Callable[[Any], Any], message: str
) -> None:
    if cls is LQNAdam and message == "dict" and "opt3dgs" in str(change):
        pytest.skip("LQNAdam has no state of ours")
    saved = trained(cls, steps=11)[1].state_dict()
    x, optimizer = trained(cls)
    before, position = flat(optimizer.state_dict()), x.detach().clone()
    with pytest.raises(ValueError) as error:
        optimizer.load_state_dict(change(copy.deepcopy(saved)))
    assert f"{cls.__name__}.load_state_dict" in str(error.value) or cls is AWSGLD
    assert message in str(error.value)
    assert flat(optimizer.state_dict()) == before
    # and it goes on as if nothing had been tried
    y, twin = trained(cls)
    for param, each in ((x, optimizer), (y, twin)):
        param.grad = 2 * param.detach()
        each.step()
    assert torch.equal(x, y)
    assert not torch.equal(x, position)


@pytest.mark.parametrize("cut", [0, 1, 100, 0.5, 0.99])
def test_a_truncated_file_raises_before_it_reaches_us(cut: float) -> None:
    buffer = io.BytesIO()
    torch.save(trained(LQNAdam)[1].state_dict(), buffer)
    whole = buffer.getvalue()
    kept = whole[: cut if isinstance(cut, int) else int(len(whole) * cut)]
    with pytest.raises((RuntimeError, EOFError, Exception)):
        torch.load(io.BytesIO(kept), weights_only=True)


def scheduler_state(change: Callable[[Any], Any]) -> tuple[PhaseScheduler, Any, dict]:
    splats = make_splats()
    phases = everything(60, 40, multiplier=EnergyHistogram(warmup=10))
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    train(splats, optimizers, phases, 0, 45)
    saved = copy.deepcopy(optimizers["means"].state_dict())
    return phases, optimizers["means"], change(saved)


OURS = (*GROUP, "opt3dgs")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without(*OURS, "switched"), "switched"),
        (without(*OURS, "scheduler"), "scheduler"),
        (without(*OURS, "scheduler", "iteration"), "iteration"),
        (having(-3, *OURS, "scheduler", "iteration"), "iteration=-3"),
        (having("3", *OURS, "scheduler", "num_observed"), "num_observed='3'"),
        (having([0.5, 0.5], *OURS, "scheduler", "multiplier", "weights"), "2 weights"),
        (having({}, *OURS, "scheduler", "multiplier"), "missing"),
        (having(7, *OURS), "dict"),
    ],
)
def test_a_damaged_schedule_is_refused_and_nothing_is_loaded(
    change: Callable[[Any], Any], message: str
) -> None:
    phases, optimizer, damaged = scheduler_state(change)
    before = flat([optimizer.state_dict(), phases.state_dict()])
    with pytest.raises(ValueError, match="load_state_dict") as error:
        optimizer.load_state_dict(damaged)
    assert message in str(error.value)
    assert flat([optimizer.state_dict(), phases.state_dict()]) == before


def test_constant_multiplier_state() -> None:
    control = ConstantMultiplier(2.0)
    control.observe(0.1)
    saved = control.state_dict()
    other = ConstantMultiplier(2.0)
    other.load_state_dict(saved)
    assert other.num_observed == 1
    for bad in ({}, None, {"num_observed": -1}, {"num_observed": math.inf}):
        with pytest.raises(ValueError, match=r"ConstantMultiplier\.load_state_dict"):
            other.load_state_dict(bad)  # pyright: ignore[reportArgumentType]
        assert other.num_observed == 1


def test_pairs_of_other_rows_are_dropped_and_it_is_said() -> None:
    """Trainers that load the optimizer before they resize the points."""
    saved = trained(LQNAdam, rows=6)[1].state_dict()
    saved["state"][0]["exp_avg"] = saved["state"][0]["exp_avg"][:4]
    saved["state"][0]["exp_avg_sq"] = saved["state"][0]["exp_avg_sq"][:4]
    x = torch.nn.Parameter(noise(4, 0))
    optimizer = LQNAdam([x], lr=0.01)
    with pytest.warns(UserWarning, match="curvature pairs of 6 rows for a parameter of 4"):
        optimizer.load_state_dict(saved)
    assert "history" not in optimizer.state[x]
    x.grad = torch.ones(4, 3)
    optimizer.step()
    assert optimizer.state[x]["history"].shape[0] == 4


def test_pairs_of_another_history_size_are_collected_anew() -> None:
    saved = trained(LQNAdam, history_size=5)[1].state_dict()
    x = torch.nn.Parameter(noise(6, 0))
    optimizer = LQNAdam([x], lr=0.01, history_size=7)
    optimizer.load_state_dict(saved)
    x.grad = torch.ones(6, 3)
    optimizer.step()
    assert optimizer.state[x]["history"].shape == (6, 7, 8)


def test_checkpoints_of_older_versions_load() -> None:
    """What came later starts anew: the histogram's running means, the mean multiplier."""
    _, first = trained(AWSGLD)
    saved = copy.deepcopy(first.state_dict())
    for key in ("recent", "nu_moments", "smooth", "views"):
        del saved["param_groups"][0]["opt3dgs"]["histogram"][key]
    x, second = trained(AWSGLD, steps=3)
    second.load_state_dict(saved)
    assert torch.equal(second.histogram.weights, first.histogram.weights)
    assert math.isfinite(float(second.histogram.observe(0.1)))
    plain = torch.optim.Adam([torch.nn.Parameter(noise(6, 0))], lr=0.01)
    second.load_state_dict(plain.state_dict())  # before its first step: no state at all
    assert not second.state[x] if x in second.state else True


def test_a_foreign_checkpoint_of_ours() -> None:
    """AWSGLD's into LQNAdam and back: the moments are Adam's, the rest is another one's."""
    x, ours = trained(LQNAdam)
    y = torch.nn.Parameter(noise(6, 1))
    theirs = AWSGLD([y], lr=0.01)
    theirs.load_state_dict(ours.state_dict())
    ours.load_state_dict(theirs.state_dict())
    for param, optimizer in ((x, ours), (y, theirs)):
        param.grad = torch.ones(6, 3)
        optimizer.step()
    assert bool(torch.isfinite(x).all())
