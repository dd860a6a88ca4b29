"""Damaged, foreign and older checkpoints: all of one is loaded, or nothing."""

from __future__ import annotations

import copy
import io
import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from trainers import begun, everything, gsplat_optimizers, train

from opt3dgs_optim import (
    AWSGLD,
    Annealing,
    Curvature,
    EnergyHistogram,
    Fading,
    LQNAdam,
    Part,
    PhaseScheduler,
    StepAdam,
)
from opt3dgs_optim.names import GAUSSIAN

BOTH = [AWSGLD, LQNAdam]


def noise(rows: int, seed: int) -> Tensor:
    return torch.randn(rows, 3, generator=torch.Generator().manual_seed(seed))


def made(cls: Any, x: Tensor, **options: Any) -> Any:
    if cls is AWSGLD:
        paper = options.get("histogram") == "paper"
        histogram = EnergyHistogram.paper(warmup=4) if paper else EnergyHistogram(warmup=4)
        options = {"histogram": histogram} | ({} if paper else options)
    return cls([x], lr=0.01, **options)


def run(x: Tensor, optimizer: Any, first: int, last: int) -> None:
    for step in range(first, last):
        if isinstance(optimizer, AWSGLD) and optimizer.histogram is not None:
            optimizer.histogram.observe(0.1 + 0.05 * math.sin(step))
        x.grad = 2 * x.detach() * torch.tensor([1.0, 5.0, 25.0]) + noise(len(x), step) * 0.1
        optimizer.step()


def trained(cls: Any, rows: int = 6, steps: int = 8, **options: Any) -> tuple[Tensor, Any]:
    """A parameter and its optimizer after some steps."""
    x = torch.nn.Parameter(noise(rows, 0))
    optimizer = made(cls, x, **options)
    run(x, optimizer, 0, steps)
    return x, optimizer


def reread(item: Any, *, weights_only: bool = True) -> Any:
    """Saved and loaded."""
    torch.save(item, buffer := io.BytesIO())
    buffer.seek(0)
    return torch.load(buffer, weights_only=weights_only)


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
OURS = (*GROUP, "opt3dgs")
TORCHS: dict[str, Callable[[Any], Any]] = {  # which torch refuses itself, in words of its own
    "no dict": lambda state: [],
    "None": lambda state: None,
    "no state": without("state"),
    "no groups": without("param_groups"),
    "groups are a dict": having({}, "param_groups"),
    "no params": without(*GROUP, "params"),
    "a group more": lambda s: {**s, "param_groups": s["param_groups"] * 2},
    "a parameter more": having([0, 1], *GROUP, "params"),
    "no groups at all": having([], "param_groups"),
}
DAMAGE: dict[str, tuple[Callable[[Any], Any], str]] = {
    "moment of another shape": (having(torch.ones(6, 4), "state", 0, "exp_avg"), "exp_avg"),
    "flat moment": (having(torch.ones(18), "state", 0, "exp_avg_sq"), "exp_avg_sq"),
    "moment is a list": (having([1.0], "state", 0, "exp_avg"), "exp_avg"),
    "no second moment": (without("state", 0, "exp_avg_sq"), "exp_avg_sq"),
    "no step": (without("state", 0, "step"), "step"),
    "SGD's state": (having({"momentum_buffer": torch.ones(6, 3)}, "state", 0), "exp_avg"),
    "state of a parameter is a number": (having(3, "state", 0), "dict"),
    "ours is a list": (having([1], *OURS), "dict"),
    "ours is a number": (having(7, *OURS), "dict"),
    "another format": (having(1, *OURS, "format"), "format=1, but one of (2, 3) is needed"),
    "no iteration": (without(*OURS, "iteration"), "iteration"),
    "negative iteration": (having(-3, *OURS, "iteration"), "iteration=-3"),
    "half an iteration": (having(2.5, *OURS, "iteration"), "iteration=2.5"),
    "count is a string": (having("8", *OURS, "num_observed"), "num_observed='8'"),
    "no parts": (without(*OURS, "parts"), "parts"),
    "parts are a list": (having([], *OURS, "parts"), "dict"),
    "switched off is a list": (having(["Fading"], *OURS, "switched_off"), "dict"),
}
CASES = [
    pytest.param(cls, change, message, id=f"{cls.__name__}: {name}")
    for cls in BOTH
    for name, (change, message) in DAMAGE.items()
]
CASES += [
    pytest.param(cls, change, "", id=f"{cls.__name__}: {name}")
    for cls in BOTH
    for name, change in TORCHS.items()
]
PART = {AWSGLD: "EnergyHistogram", LQNAdam: "Curvature"}


COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda optimizer: pickle.loads(pickle.dumps(optimizer)),
    "torch.save": lambda optimizer: reread(optimizer, weights_only=False),
}


@pytest.mark.parametrize("how", [*COPIES, "state_dict"])
@pytest.mark.parametrize(
    ("cls", "options"),
    [
        (AWSGLD, {}),
        (AWSGLD, {"histogram": "paper"}),
        (LQNAdam, {}),
        (LQNAdam, {"history_size": 2, "graft": False}),
    ],
)
def test_copies_and_resumed_runs_go_on_alike(cls: Any, options: dict[str, Any], how: str) -> None:
    x, optimizer = trained(cls, steps=11, **options)
    if how == "state_dict":
        values, state = reread([x.detach(), optimizer.state_dict()])
        twin = made(cls, torch.nn.Parameter(values), **options)
        twin.load_state_dict(state)
    else:
        twin = COPIES[how](optimizer)
    y = twin.param_groups[0]["params"][0]
    assert y is not x
    for each in ((x, optimizer), (y, twin)):
        run(*each, 11, 20)
    assert torch.equal(x, y)


@pytest.mark.parametrize(("cls", "change", "message"), CASES)
def test_a_damaged_checkpoint_is_refused_and_nothing_is_loaded(
    cls: Any, change: Callable[[Any], Any], message: str
) -> None:
    saved = trained(cls, steps=11)[1].state_dict()
    x, optimizer = trained(cls)
    before, position = flat(optimizer.state_dict()), x.detach().clone()
    errors = ValueError if message else (ValueError, TypeError, KeyError, AttributeError)
    with pytest.raises(errors) as error:
        optimizer.load_state_dict(change(copy.deepcopy(saved)))
    assert message in str(error.value)
    if message:
        assert ".load_state_dict" in str(error.value)
    assert flat(optimizer.state_dict()) == before
    # and it goes on as if nothing had been tried
    y, twin = trained(cls)
    for each in ((x, optimizer), (y, twin)):
        run(*each, 8, 9)
    assert torch.equal(x, y)
    assert not torch.equal(x, position)


@pytest.mark.parametrize("value", [None, [], {}, 3, "state"])
@pytest.mark.parametrize("cls", BOTH)
def test_a_damaged_part_is_refused_and_nothing_is_loaded(cls: Any, value: Any) -> None:
    saved = trained(cls, steps=11)[1].state_dict()
    _, optimizer = trained(cls)
    before = flat(optimizer.state_dict())
    with pytest.raises(ValueError, match="load_state_dict"):
        optimizer.load_state_dict(having(value, *OURS, "parts", PART[cls])(saved))
    assert flat(optimizer.state_dict()) == before


class Halves(Part):
    """A part that loads the first half of its state before it notices the second."""

    def __init__(self) -> None:
        self.halves = [1.0, 2.0]

    def state_dict(self) -> dict[str, Any]:
        return {"halves": list(self.halves)}

    def load_state_dict(self, state: Any) -> None:
        self.halves[0] = float(state["halves"][0])
        self.halves[1] = float(state["halves"][1])


@pytest.mark.parametrize("halves", [[5.0], [5.0, "two"], [5.0, None]])
def test_a_part_that_fails_halfway_is_put_back(halves: list[Any]) -> None:
    part = Halves()
    phases = PhaseScheduler(10, parts=[Fading(), part])
    state = {**phases.state_dict(), "iteration": 7, "parts": {"Halves": {"halves": halves}}}
    with pytest.raises(ValueError, match=r"PhaseScheduler\.load_state_dict"):
        phases.load_state_dict(state)
    assert part.halves == [1.0, 2.0]
    assert phases.iteration == 0


@pytest.mark.parametrize("cut", [0, 1, 100, 0.5, 0.99])
def test_a_truncated_file_raises_before_it_reaches_us(cut: float) -> None:
    buffer = io.BytesIO()
    torch.save(trained(LQNAdam)[1].state_dict(), buffer)
    whole = buffer.getvalue()
    kept = whole[: cut if isinstance(cut, int) else int(len(whole) * cut)]
    with pytest.raises((RuntimeError, EOFError, Exception)):
        torch.load(io.BytesIO(kept), weights_only=True)


def scheduler_state() -> tuple[PhaseScheduler, Any, dict]:
    others = Annealing(names=GAUSSIAN), Fading()
    splats, optimizers = begun(phases := everything(60, 40, *others))
    train(splats, optimizers, phases, 0, 45)
    return phases, optimizers["means"], copy.deepcopy(optimizers["means"].state_dict())


@pytest.mark.parametrize(
    ("part", "message"), [("EnergyHistogram", "missing"), ("Curvature", "seen")]
)
def test_a_damaged_schedule_is_refused_and_nothing_is_loaded(part: str, message: str) -> None:
    phases, optimizer, saved = scheduler_state()
    before = flat([optimizer.state_dict(), phases.state_dict()])
    with pytest.raises(ValueError, match="load_state_dict") as error:
        optimizer.load_state_dict(having({}, *OURS, "parts", part)(saved))
    assert message in str(error.value)
    assert flat([optimizer.state_dict(), phases.state_dict()]) == before


def test_pairs_of_other_rows_are_dropped_and_it_is_said() -> None:
    """Trainers that load the optimizer before they resize the points."""
    saved = trained(LQNAdam, rows=6)[1].state_dict()
    x = torch.nn.Parameter(noise(4, 0))
    optimizer = LQNAdam([x], lr=0.01)
    with pytest.warns(UserWarning, match="Curvature.history of 6 rows for a parameter of 4"):
        optimizer.load_state_dict(saved)
    assert "Curvature.history" not in optimizer.state[x]
    assert "exp_avg" in optimizer.state[x]


def test_pairs_of_other_rows_than_the_moments_are_refused() -> None:
    """Those of a checkpoint have one number of rows."""
    saved = trained(LQNAdam, rows=6)[1].state_dict()
    saved["state"][0]["exp_avg"] = saved["state"][0]["exp_avg"][:4]
    saved["state"][0]["exp_avg_sq"] = saved["state"][0]["exp_avg_sq"][:4]
    optimizer = LQNAdam([torch.nn.Parameter(noise(4, 0))], lr=0.01)
    with pytest.raises(ValueError, match=r"Curvature.history has shape \(6, 5, 8\)"):
        optimizer.load_state_dict(saved)
    assert not optimizer.state


def test_parts_that_a_checkpoint_does_not_know_begin_anew_and_others_are_left_out() -> None:
    """A run may go on with other parts than those that it was saved with."""
    phases, optimizer, saved = scheduler_state()
    x = torch.nn.Parameter(torch.zeros(12, 3))
    other = PhaseScheduler(60, 40, [Halves(), Annealing(names=GAUSSIAN)])
    means = other.upgrade({"means": torch.optim.Adam([x], lr=0.01)})["means"]
    means.load_state_dict(saved)
    assert other.iteration == phases.iteration == 45
    assert other.parts[0].state_dict() == {"halves": [1.0, 2.0]}
    x.grad = torch.ones(12, 3)
    other.observe(0.1)
    means.step()
    assert isinstance(optimizer, StepAdam)


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


def test_a_checkpoint_of_ours_loads_into_the_stock_trainer() -> None:
    """What is ours is in it, and stands in nobody's way."""
    splats, optimizers = begun(phases := everything(60, 40, Fading(), settling=0))
    train(splats, optimizers, phases, 0, 45)
    stock = gsplat_optimizers(splats)
    for name, optimizer in stock.items():
        optimizer.load_state_dict(optimizers[name].state_dict())
    train(splats, stock, None, 45, 47)
    assert float(stock["means"].state[splats["means"]]["step"]) == 7.0  # anew at 40


# -- torch's hooks ---------------------------------------------------------------------------------


def test_load_hooks_run_before_our_checks() -> None:
    """A hook that repairs a layout: gsplat's users rename keys so."""
    x, optimizer = trained(LQNAdam)
    saved = copy.deepcopy(optimizer.state_dict())
    saved["moments"] = {k: saved["state"][0].pop(k) for k in ("exp_avg", "exp_avg_sq")}

    def repair(_: Any, state: dict[str, Any]) -> dict[str, Any]:
        own = {**state["state"][0], **state["moments"]}
        return {"state": {0: own}, "param_groups": state["param_groups"]}

    y, other = trained(LQNAdam, steps=2)
    other.register_load_state_dict_pre_hook(repair)
    other.load_state_dict(saved)
    assert torch.equal(other.state[y]["exp_avg"], optimizer.state[x]["exp_avg"])


def test_state_hooks_see_what_is_saved() -> None:
    phases, optimizer, _ = scheduler_state()
    seen = []
    optimizer.register_state_dict_post_hook(
        lambda _, state: seen.append(state["param_groups"][0]["opt3dgs"]["iteration"])
    )
    optimizer.register_state_dict_pre_hook(lambda own: seen.append(len(own.param_groups)))
    saved = optimizer.state_dict()
    assert seen == [1, 45]
    assert {**phases.state_dict(), "optimizer": ...} == {
        **saved["param_groups"][0]["opt3dgs"],
        "optimizer": ...,
    }
    assert "opt3dgs" not in optimizer.param_groups[0]


def test_everything_in_it_is_plain() -> None:
    """torch.load(weights_only=True) takes it."""
    _, optimizer, saved = scheduler_state()
    assert flat(reread(saved)) == flat(saved)
    assert optimizer.course.part(Curvature) is not None
