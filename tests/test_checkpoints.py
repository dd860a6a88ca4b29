"""Damaged, foreign and older checkpoints: all of one is loaded, or nothing."""

from __future__ import annotations

import copy
import io
import math
import pickle
import re
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from trainers import begun, everything, gsplat_optimizers, train

from opt3dgs_optim import (
    AWSGLD,
    Annealing,
    Averaging,
    Curvature,
    EnergyHistogram,
    Fading,
    Kept,
    LQNAdam,
    OutOfView,
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


@pytest.mark.parametrize("rows", [4, 6, 9])
def test_pairs_of_other_rows_than_the_moments_are_dropped_and_it_is_said(rows: int) -> None:
    """A stock trainer's edit of rows, which knows the moments alone; then its checkpoint."""
    saved = trained(LQNAdam, rows=6)[1].state_dict()
    kept = torch.arange(4)
    for key in ("exp_avg", "exp_avg_sq"):
        saved["state"][0][key] = saved["state"][0][key][kept]
    x = torch.nn.Parameter(noise(rows, 0))
    optimizer = LQNAdam([x], lr=0.01)
    with pytest.warns(UserWarning, match="Curvature.history of 6 rows beside moments of 4"):
        optimizer.load_state_dict(saved)
    assert set(optimizer.state[x]) == {"step", "exp_avg", "exp_avg_sq"}


def phased(
    x: Any,
    parts: list[Part],
    steps: int = 0,
    *,
    total: int = 60,
    kind: Any = torch.optim.Adam,
    **options: Any,
) -> tuple[PhaseScheduler, Any]:
    """A scheduler without exploration, and its optimizer of the positions `x`, after some steps."""
    phases = PhaseScheduler(total, 0, parts)
    adam = phases.upgrade(kind([{"params": [x], "name": "xyz"}], **{"lr": 0.01, **options}))
    go_on(x, phases, adam, steps)
    return phases, adam


def go_on(x: Any, phases: PhaseScheduler, adam: Any, steps: int) -> None:
    for _ in range(steps):
        step = phases.iteration
        grad = 2 * x.detach() * torch.tensor([1.0, 5.0, 25.0]) + noise(len(x), step) * 0.1
        x.grad = grad.nan_to_num(0.0, 0.0, 0.0).to(x.dtype)
        phases.observe(0.1)
        adam.step()


def points(rows: int = 6) -> torch.nn.Parameter:
    return torch.nn.Parameter(noise(rows, 0))


def stock_of(x: Any, saved: Any, **options: Any) -> Any:
    """The stock trainer's optimizer, which has loaded a checkpoint."""
    stock = torch.optim.Adam([{"params": [x], "name": "xyz"}], **{"lr": 0.01, **options})
    stock.load_state_dict(copy.deepcopy(saved))
    return stock


SHAPES = [(3,), (), (1, 3), (15, 3), (1,)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("before", "after"), [(4, 0), (0, 0), (0, 4)])
def test_an_optimizer_may_be_loaded_where_there_are_no_points(
    before: int, after: int, shape: tuple[int, ...]
) -> None:
    """A trainer that makes an empty model first, and takes the points from its file afterwards."""

    def made(rows: int) -> tuple[Any, PhaseScheduler, Any]:
        x = torch.nn.Parameter(torch.ones(rows, *shape))
        phases = PhaseScheduler(30, 5, [Fading(), OutOfView(), Curvature(), Averaging()])
        adam = phases.upgrade(torch.optim.Adam([{"params": [x], "name": "xyz"}], lr=0.01))
        return x, phases, adam

    def step(x: Any, phases: PhaseScheduler, adam: Any) -> None:
        x.grad = torch.ones_like(x)
        phases.observe(0.1)
        adam.step()

    first = made(before)
    for _ in range(30):
        step(*first)
    second = made(after)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        second[2].load_state_dict(first[2].state_dict())
    assert bool(said) == (before != after)
    assert second[1].iteration == 30
    grown = made(4)
    state = second[2].state_dict()
    if before == after:  # and from there into a model that has points again
        with pytest.warns(UserWarning, match="of 0 rows for a parameter of 4"):
            grown[2].load_state_dict(state)
        assert set(grown[2].state[grown[0]]) == {"step", "exp_avg", "exp_avg_sq"}


@pytest.mark.parametrize("road", ["upgrade", "checkpoint"])
@pytest.mark.parametrize("edit", ["prune", "append", "prune and append"])
def test_a_stock_trainers_edit_of_rows_before_its_first_step(road: str, edit: str) -> None:
    """INRIA's edits replace the parameter, and of the state the moments alone."""
    x = points()
    saved = phased(x, [Curvature()], 8)[1].state_dict()
    stock = stock_of(x, saved)
    state = stock.state.pop(x)
    for key in ("exp_avg", "exp_avg_sq"):
        left = state[key][1:] if "prune" in edit else state[key]
        state[key] = torch.cat([left, torch.zeros(2, 3)]) if "append" in edit else left
    y = torch.nn.Parameter(torch.ones_like(state["exp_avg"]))
    stock.param_groups[0]["params"], stock.state[y] = [y], state
    phases = PhaseScheduler(60, 0, [Curvature()])
    saved = stock.state_dict()
    if road == "checkpoint":
        stock = phases.upgrade(torch.optim.Adam([{"params": [y], "name": "xyz"}]))
    with pytest.warns(UserWarning, match=r"Curvature\.history of 6 rows beside"):
        _ = phases.upgrade(stock) if road == "upgrade" else stock.load_state_dict(saved)
    assert set(stock.state[y]) == {"step", "exp_avg", "exp_avg_sq"}
    assert phases.iteration == 8
    go_on(y, phases, stock, 2)


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


# -- Adam's own state ------------------------------------------------------------------------------


def of_one(value: float) -> Callable[[Tensor], Tensor]:
    """The same tensor with one number exchanged."""

    def change(tensor: Tensor) -> Tensor:
        changed = tensor.clone()
        changed.view(-1)[2] = value
        return changed

    return change


BAD_STEPS: dict[str, Any] = {
    "None": None,
    "a list": [8],
    "an empty list": [],
    "a string": "8",
    "a bool": True,
    "complex": 8j,
    "infinite": math.inf,
    "negative": -1.0,
    "not a number": math.nan,
    "an infinite tensor": torch.tensor(math.inf),
    "a negative tensor": torch.tensor(-5.0),
    "a tensor that is not a number": torch.tensor(math.nan),
    "a complex tensor": torch.tensor(8j),
    "a tensor of a bool": torch.tensor(True),
    "a tensor of several": torch.tensor([8.0, 8.0]),
    "a tensor of none": torch.tensor([]),
}
BAD_MOMENTS: dict[str, Callable[[Tensor], Any]] = {
    "None": lambda value: None,
    "a list": lambda value: value.tolist(),
    "a number": lambda value: 0.5,
    "0-d": lambda value: torch.tensor(0.5),
    "fewer rows": lambda value: value[:3].clone(),
    "more rows": lambda value: torch.cat([value, value]),
    "no rows": lambda value: value[:0].clone(),
    "other columns": lambda value: value[:, :2].clone(),
    "a dimension less": lambda value: value[:, 0].clone(),
    "a dimension more": lambda value: value[..., None].clone(),
    "integers": lambda value: value.long(),
    "booleans": lambda value: value.bool(),
    "complex": lambda value: value.to(torch.complex64),
    "sparse": lambda value: value.to_sparse(),
    "NaN": of_one(math.nan),
    "infinite": of_one(math.inf),
    "infinite below": of_one(-math.inf),
}
SECOND_MOMENTS = {"negative": of_one(-1e-3)}  # what no mean of squares is
DAMAGED_ADAM = [("step", how) for how in BAD_STEPS]
DAMAGED_ADAM += [
    (key, how) for key in ("exp_avg", "exp_avg_sq", "max_exp_avg_sq") for how in BAD_MOMENTS
]
DAMAGED_ADAM += [(key, "negative") for key in ("exp_avg_sq", "max_exp_avg_sq")]
DAMAGED_ADAM += [(key, "missing") for key in ("step", "exp_avg", "exp_avg_sq", "max_exp_avg_sq")]


def damage(state: dict[str, Any], key: str, how: str) -> None:
    """Damage one entry of the state of one parameter."""
    if how == "missing":
        del state[key]
    elif key == "step":
        state[key] = BAD_STEPS[how]
    else:
        state[key] = (BAD_MOMENTS | SECOND_MOMENTS)[how](state[key])


@pytest.mark.parametrize("parts", ["none", "Averaging"])
@pytest.mark.parametrize(("key", "how"), DAMAGED_ADAM)
def test_damaged_moments_are_refused_and_nothing_is_loaded(key: str, how: str, parts: str) -> None:
    def made() -> list[Part]:
        return [Averaging()] if parts == "Averaging" else []

    if key == "exp_avg" and how in ("fewer rows", "more rows", "no rows"):
        said = "exp_avg_sq has 6 rows, but exp_avg has"  # the first is what the others must be
    else:
        said = key
    saved = phased(points(), made(), 59, amsgrad=True)[1].state_dict()
    damage(saved["state"][0], key, how)
    x = points()
    phases, adam = phased(x, made(), 3, amsgrad=True)
    before = flat([adam.state_dict(), phases.state_dict()])
    with pytest.raises(ValueError, match=rf"\.load_state_dict.*{said}"):
        adam.load_state_dict(saved)
    assert flat([adam.state_dict(), phases.state_dict()]) == before
    go_on(x, phases, adam, 2)
    assert bool(x.isfinite().all())


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize(("key", "how"), DAMAGED_ADAM)
def test_damaged_moments_of_a_stock_optimizer_leave_it_one(key: str, how: str, first: bool) -> None:
    """Where one of two optimizers cannot be upgraded, neither is."""
    stock: dict[str, Any] = {}
    for name, width in (("means", 3), ("scales", 3)):
        x = torch.nn.Parameter(torch.ones(6, width))
        phases = PhaseScheduler(60, 0, [Averaging(), OutOfView()])
        adam = phases.upgrade({name: torch.optim.Adam([x], lr=0.01, amsgrad=True)})[name]
        go_on(x, phases, adam, 59)
        y = torch.nn.Parameter(torch.ones(6, width))
        stock[name] = torch.optim.Adam([y], lr=0.01, amsgrad=True)
        stock[name].load_state_dict(adam.state_dict())
    damaged = stock["means" if first else "scales"]
    sound = copy.deepcopy(damaged.state_dict())
    damage(next(iter(damaged.state.values())), key, how)
    phases = PhaseScheduler(60, 0, [Averaging(), OutOfView()])
    before = [(type(o), set(vars(o)), str(o.state_dict())) for o in stock.values()]
    groups = [o.param_groups[0] for o in stock.values()]
    clock = flat(phases.state_dict())
    with pytest.raises(ValueError, match="StepAdam: a checkpoint that was loaded before"):
        phases.upgrade(stock)
    assert [(type(o), set(vars(o)), str(o.state_dict())) for o in stock.values()] == before
    assert all(o.param_groups[0] is g for o, g in zip(stock.values(), groups, strict=True))
    assert flat(phases.state_dict()) == clock
    assert [*phases.followers] == []
    # The other one, and the damaged one once it is mended, get their parts.
    damaged.load_state_dict(sound)
    phases.upgrade(stock)
    assert phases.iteration == 59


class IntegerStep(torch.optim.Adam):
    """An Adam with a step of its own, which counts in Python, as older ones do."""

    def step(self, visibility: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        for group in self.param_groups:
            for param in group["params"]:
                state = self.state[param]
                if not state:
                    state["exp_avg"] = torch.zeros_like(param)
                    state["exp_avg_sq"] = torch.zeros_like(param)
                state["step"] = state.get("step", 0) + 1


HEALTHY: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a step of Python": lambda s: s.update(step=int(s["step"])),
    "a step of Python's floats": lambda s: s.update(step=float(s["step"])),
    "a step in float64": lambda s: s.update(step=s["step"].double()),
    "a step of integers": lambda s: s.update(step=s["step"].long()),
    "a step of one dimension": lambda s: s.update(step=s["step"].reshape(1)),
    "other rows than the parameter": lambda s: s.update(
        {k: torch.zeros(9, 3) for k in s if "exp" in k}
    ),
    "no rows": lambda s: s.update({k: torch.zeros(0, 3) for k in s if "exp" in k}),
    "in half precision": lambda s: s.update({k: s[k].half() for k in s if "exp" in k}),
    "in double precision": lambda s: s.update({k: s[k].double() for k in s if "exp" in k}),
}


@pytest.mark.parametrize("how", HEALTHY)
def test_moments_of_other_kinds_are_loaded(how: str) -> None:
    """Other versions of torch, other precisions, and trainers that resize the points later."""
    saved = phased(points(), [], 5)[1].state_dict()
    HEALTHY[how](saved["state"][0])
    x = points()
    phases, adam = phased(x, [])
    adam.load_state_dict(saved)
    assert phases.iteration == 5
    assert float(adam.state[x]["step"]) == 5.0


def test_another_base_may_count_its_steps_in_python() -> None:
    x = points()
    phases, adam = phased(x, [], kind=IntegerStep)
    x.grad = torch.ones_like(x)
    for _ in range(3):
        phases.observe(0.1)
        adam.step(torch.ones(6, dtype=torch.bool))
    assert adam.state[x]["step"] == 3
    again, other = phased(points(), [], kind=IntegerStep)
    other.load_state_dict(adam.state_dict())
    assert again.iteration == 3


@pytest.mark.parametrize("road", ["load_state_dict", "upgrade"])
def test_second_moments_that_have_overflowed_in_float16_are_no_damage(road: str) -> None:
    """The square of a gradient of 300: Adam's step is zero, in the stock trainer, too."""
    value = torch.ones(6, 3, dtype=torch.float16)
    x, y = (torch.nn.Parameter(value.clone()) for _ in range(2))
    first = phased(x, [], eps=1e-4)
    for _ in range(3):
        x.grad = torch.ones_like(x)
        x.grad[0] = 3e4
        first[0].observe(0.1)
        first[1].step()
    assert bool(first[1].state[x]["exp_avg_sq"].isinf().any())
    y.data.copy_(x.data)
    if road == "upgrade":
        phases = PhaseScheduler(60, 0, [])
        adam = phases.upgrade(stock_of(y, first[1].state_dict(), eps=1e-4))
    else:
        phases, adam = phased(y, [], eps=1e-4)
        adam.load_state_dict(copy.deepcopy(first[1].state_dict()))
    for param, (clock, optimizer) in ((x, first), (y, (phases, adam))):
        go_on(param, clock, optimizer, 3)
    assert torch.equal(x, y)


@pytest.mark.parametrize("road", ["load_state_dict", "upgrade"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("parts", ["none", "Curvature", "Averaging"])
def test_a_lost_point_does_not_keep_a_training_from_going_on(
    parts: str, value: float, road: str
) -> None:
    """Its position is not finite, and weight decay makes its moments so: bit for bit the same."""

    def made() -> list[Part]:
        return {"none": list[Part], "Curvature": lambda: [Curvature()],
                "Averaging": lambda: [Averaging()]}[parts]()  # fmt: skip

    decay = 0.0 if parts == "Curvature" else 0.1
    x = points()
    x.data[2, 0] = value
    first = phased(x, made(), 59, total=60 if parts == "Averaging" else 90, weight_decay=decay)
    saved = copy.deepcopy(first[1].state_dict())
    y = torch.nn.Parameter(x.detach().clone())
    if road == "upgrade":
        phases = PhaseScheduler(first[0].total_steps, 0, made())
        adam = phases.upgrade(stock_of(y, saved, weight_decay=decay))
    else:
        phases, adam = phased(y, made(), total=first[0].total_steps, weight_decay=decay)
        adam.load_state_dict(saved)
    for param, (clock, optimizer) in ((x, first), (y, (phases, adam))):
        go_on(param, clock, optimizer, 1)
    assert torch.equal(x.nan_to_num(7.0), y.nan_to_num(7.0))
    assert bool(x[[0, 1, 3, 4, 5]].isfinite().all())


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_was_kept_of_a_point_that_is_mended_begins_anew(value: float) -> None:
    """Its history has the position that was lost; the trainer has put it somewhere since."""
    x = points()
    x.data[2, 0] = value
    saved = phased(x, [Curvature()], 20)[1].state_dict()
    assert not bool(saved["state"][0]["Curvature.history"].isfinite().all())
    y = points()
    phases, adam = phased(y, [Curvature()])
    with pytest.warns(UserWarning, match="what Curvature keeps of 1 of 6 rows is not finite"):
        adam.load_state_dict(saved)
    history = adam.state[y]["Curvature.history"]
    assert not history[2].any()
    others = [0, 1, 3, 4, 5]
    assert torch.equal(history[others], saved["state"][0]["Curvature.history"][others])
    go_on(y, phases, adam, 5)
    assert bool(y.isfinite().all())


# -- what parts say and what belongs to an optimizer -----------------------------------------------


BAD_NUMBERS: dict[str, Any] = {
    "None": None,
    "a dict": {},
    "a list": [],
    "a string": "3",
    "infinite": math.inf,
    "not a number": math.nan,
    "beyond every float": 10**400,
    "a tensor": torch.zeros(4),
    "complex": 3j,
}
BAD_EVIDENCE: dict[str, Any] = {
    **BAD_NUMBERS,
    "too few": [1.0, 2.0],
    "too many": [1.0] * 5,
    "a number that is none": [1.0, 2.0, "x", 4.0],
    "one that is not finite": [1.0, math.nan, 0.0, 1.0],
    "beyond float32": [1e300, 2.0, 0.0, 1.0],
    "fewer than none accepted": [-1.0, 2.0, 0.0, 1.0],
    "nested": [[1.0, 2.0, 0.0, 1.0]],
}
BAD_PROBES: dict[str, Any] = {**BAD_NUMBERS, "half": 2.5, "negative": -1, "a bool": True}
del BAD_PROBES["beyond every float"]
HISTOGRAM = ("num_observed", "num_taken", "sums", "recent", "nu")
DAMAGED_PARTS = [("Curvature", "seen", how) for how in BAD_EVIDENCE]
DAMAGED_PARTS += [("Curvature", "probes", how) for how in BAD_PROBES]
DAMAGED_PARTS += [("EnergyHistogram", key, how) for key in HISTOGRAM for how in BAD_NUMBERS]
DAMAGED_PARTS += [("EnergyHistogram", key, "negative") for key in HISTOGRAM[:2]]


@pytest.mark.parametrize("adaptive", [False, True])
@pytest.mark.parametrize(("part", "key", "how"), DAMAGED_PARTS)
def test_damaged_words_of_a_part_are_refused_and_nothing_is_loaded(
    part: str, key: str, how: str, adaptive: bool
) -> None:
    def begun_training() -> tuple[Any, PhaseScheduler, Any]:
        x = points()
        parts = [EnergyHistogram(warmup=4), Curvature()]
        phases = PhaseScheduler(60, 20, parts, adaptive=adaptive)
        return x, phases, phases.upgrade(torch.optim.Adam([{"params": [x], "name": "xyz"}]))

    x, phases, adam = begun_training()
    go_on(x, phases, adam, 40)
    saved = copy.deepcopy(adam.state_dict())
    value = {**BAD_EVIDENCE, **BAD_PROBES}[how]
    saved["param_groups"][0]["opt3dgs"]["parts"][part][key] = value
    x, phases, adam = begun_training()
    go_on(x, phases, adam, 3)
    before = flat([adam.state_dict(), phases.state_dict()])
    with pytest.raises(ValueError, match=rf"{part}\.load_state_dict: {key}"):
        adam.load_state_dict(saved)
    assert flat([adam.state_dict(), phases.state_dict()]) == before
    own = phases.parts[0] if part == "EnergyHistogram" else phases.parts[1]
    with pytest.raises(ValueError, match=rf"{part}\.load_state_dict: {key}"):
        own.load_state_dict(saved["param_groups"][0]["opt3dgs"]["parts"][part])
    assert flat([adam.state_dict(), phases.state_dict()]) == before
    go_on(x, phases, adam, 30)


class Learnt(Part):
    """A part that has taken over all of a state when it notices that this is damaged.

    Before it has learnt anything it saves nothing; then it writes into its list.
    """

    names = None

    def __init__(self, count: int, error: BaseException | None = None) -> None:
        self.error, self.known, self.count = error, [1.0, 2.0], count

    def state_dict(self) -> dict[str, Any]:
        return {"known": list(self.known), "count": self.count} if self.count else {}

    def load_state_dict(self, state: Any) -> None:
        if self.count:
            self.known[:] = state["known"]
        else:
            self.known = list(state["known"])
        self.count = state["count"]
        if self.error is not None and state["known"] == [7.0]:
            raise self.error


ERRORS = [
    ValueError("no"), KeyError("no"), TypeError("no"), AttributeError("no"), RuntimeError("no"),
    OverflowError("no"), ZeroDivisionError("no"), NotImplementedError("no"), AssertionError("no"),
    StopIteration("no"), OSError("no"), UnicodeDecodeError("utf-8", b"", 0, 1, "no"),
]  # fmt: skip
OTHER_ERRORS = [MemoryError("no"), KeyboardInterrupt("no"), torch.cuda.OutOfMemoryError("no")]


@pytest.mark.parametrize("error", [*ERRORS, *OTHER_ERRORS], ids=lambda error: type(error).__name__)
@pytest.mark.parametrize("count", [0, 1])
@pytest.mark.parametrize("road", ["optimizer", "scheduler", "upgrade"])
def test_whatever_a_part_raises_all_of_a_load_is_undone(
    road: str, count: int, error: BaseException
) -> None:
    """Damage is a ValueError; want of memory and an interrupt are what they are."""

    def made(error: BaseException | None = None) -> list[Part]:
        return [EnergyHistogram(warmup=4), Learnt(count), Learnt(count, error), Averaging()]

    saved = copy.deepcopy(phased(points(), made(), 30)[1].state_dict())
    learnt = {"Learnt": {"known": [5.0], "count": 9}, "Learnt#2": {"known": [7.0], "count": 9}}
    saved["param_groups"][0]["opt3dgs"]["parts"] |= learnt
    y = points()
    phases, other = phased(y, made(error), 0 if road == "upgrade" else 3)
    before = flat([other.state_dict(), phases.state_dict()])
    expected: Any = type(error) if error in OTHER_ERRORS else ValueError
    stock = stock_of(points(), saved)
    roads: dict[str, Callable[[], Any]] = {
        "upgrade": lambda: phases.upgrade(stock),
        "optimizer": lambda: other.load_state_dict(saved),
        "scheduler": lambda: phases.load_state_dict(saved["param_groups"][0]["opt3dgs"]),
    }
    with pytest.raises(expected, match="no"):
        roads[road]()
    assert type(stock) is torch.optim.Adam
    assert [*phases.followers] == [other]
    assert flat([other.state_dict(), phases.state_dict()]) == before
    for part in phases.parts[1:3]:
        assert isinstance(part, Learnt)
        assert (part.known, part.count) == ([1.0, 2.0], count)
    go_on(y, phases, other, 2)


ENTRIES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "a tensor as the format": (having(torch.tensor([3, 3]), *OURS, "format"), "format=tensor"),
    "one number's tensor": (having(torch.tensor(3), *OURS, "format"), "format=tensor"),
    "an array as the format": (having(np.array([3, 3]), *OURS, "format"), "format=array"),
    "a list as the format": (having([3], *OURS, "format"), "format="),
    "a bool as the format": (having(True, *OURS, "format"), "format=True"),
    "no format": (without(*OURS, "format"), "format"),
    "a far iteration": (having(10**400, *OURS, "iteration"), "iteration=1000"),
    "far observations": (having(10**400, *OURS, "num_observed"), "num_observed=1000"),
    "no records": (without(*OURS, "optimizer", "records"), "records"),
    "records of no group": (having([], *OURS, "optimizer", "records"), "records has 0"),
    "records of no parameter": (having([[]], *OURS, "optimizer", "records"), "records has 0"),
    "a record is None": (having([[None]], *OURS, "optimizer", "records"), "records"),
    "a far last step": (
        having(10**400, *OURS, "optimizer", "records", 0, 0, "last_step"),
        "last_step=1000",
    ),
    "kept is a number": (having({"0": 3}, *OURS, "optimizer", "kept"), "kept['0']=3"),
    "kept is a string": (having({"0": "mean"}, *OURS, "optimizer", "kept"), "kept['0']='mean'"),
    "kept is None": (having({"0": None}, *OURS, "optimizer", "kept"), "kept['0']=None"),
    "no optimizer": (without(*OURS, "optimizer"), "dict"),
    "windows is a list": (having([1], *OURS, "optimizer", "windows"), "windows"),
    "steps are infinite": (having(math.inf, *OURS, "optimizer", "steps"), "steps=inf"),
}


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("road", ["load_state_dict", "upgrade"])
def test_damaged_entries_of_an_optimizer_are_refused_and_nothing_is_loaded(
    entry: str, road: str
) -> None:
    change, said = ENTRIES[entry]
    saved = change(copy.deepcopy(phased(points(), [Averaging()], 59)[1].state_dict()))
    phases, adam = phased(points(), [Averaging()], 3)
    before = flat([adam.state_dict(), phases.state_dict()])
    stock = stock_of(points(), saved)
    with pytest.raises(ValueError, match=re.escape(said)):
        _ = phases.upgrade(stock) if road == "upgrade" else adam.load_state_dict(saved)
    assert flat([adam.state_dict(), phases.state_dict()]) == before
    assert [*phases.followers] == [adam]


class Numbers(Part):
    """A part that keeps numbers of all kinds, as nobody here does."""

    keeps = (
        Kept("least", per="parameter", initial=math.inf),
        Kept("whole", per="parameter", dtype=torch.int64),
        Kept("seen", per="parameter", dtype=torch.bool),
        Kept("total", per="training", initial=-math.inf),
        Kept("undefined", per="training", initial=math.nan),
    )

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        state["whole"] += 1
        state["seen"].fill_(True)
        for name in ("least", "total", "undefined"):
            _ = state[name]
        return grad


def test_numbers_of_all_kinds_are_gone_on_with() -> None:
    """Infinite where nothing has begun, whole ones and yes or no: a checkpoint may have them."""
    first, adam = phased(points(), [Numbers()], 3)
    phases, other = phased(points(), [Numbers()])
    other.load_state_dict(adam.state_dict())
    assert str(other.state_dict()["param_groups"]) == str(adam.state_dict()["param_groups"])
    assert str(phases.state_dict()) == str(first.state_dict())
    assert "'Numbers.least': inf" in str(adam.state_dict())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("least", None), ("least", "inf"), ("least", True), ("least", [1.0]), ("least", 3j),
        ("whole", 2.5), ("whole", 10**30), ("whole", math.inf), ("whole", True),
        ("seen", 1), ("seen", 0.0), ("seen", None),
    ],
)  # fmt: skip
def test_numbers_of_another_kind_are_refused_and_nothing_is_loaded(key: str, value: Any) -> None:
    saved = copy.deepcopy(phased(points(), [Numbers()], 3)[1].state_dict())
    record = saved["param_groups"][0]["opt3dgs"]["optimizer"]["records"][0][0]
    record["numbers"][f"Numbers.{key}"] = value
    phases, adam = phased(points(), [Numbers()], 1)
    before = str(adam.state_dict())
    with pytest.raises(ValueError, match=f"Numbers.{key}="):
        adam.load_state_dict(saved)
    assert str(adam.state_dict()) == before
    assert phases.iteration == 1


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


BAD = (float("nan"), float("inf"), -1.0, "1", None)
OPTIONS = [(name, value) for name in ("lr", "eps", "weight_decay") for value in BAD]
OPTIONS += [("betas", value) for value in (0.9, (0.9,), (0.9, 2.0), (float("nan"), 0.9), None)]
OPTIONS += [(name, -1) for name in ("amsgrad", "maximize", "capturable", "foreach", "fused")]
OPTIONS += [("params", 0), ("params", "01")]


MISSING = "missing"  # of the option itself
OPTIONS += [(name, MISSING) for name in ("lr", "eps", "betas", "weight_decay", "params")]


@pytest.mark.parametrize(("name", "value"), OPTIONS, ids=str)
def test_damaged_options_of_adam_are_refused_and_nothing_is_loaded(name: str, value: Any) -> None:
    _, adam = phased(points(), [Averaging()], 5)
    before, saved = copy.deepcopy(adam.state_dict()), copy.deepcopy(adam.state_dict())
    saved["state"][0]["exp_avg"].zero_()
    group = saved["param_groups"][0]
    group[name] = value
    if value == MISSING:
        del group[name]
    with pytest.raises(ValueError, match=name):
        adam.load_state_dict(saved)
    assert flat(adam.state_dict()) == flat(before)


def test_a_parameter_whose_state_is_none_has_made_no_step() -> None:
    _, adam = phased(points(), [Averaging()], 5)
    saved = copy.deepcopy(adam.state_dict())
    saved["state"][0] = None
    _, fresh = phased(fresh_x := points(), [Averaging()])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the moments are of another number of steps
        fresh.load_state_dict(saved)
    assert not fresh.state.get(fresh_x)


@pytest.mark.parametrize("key", ["ema.mean", "ema", "my.own.mean"])
def test_what_a_trainer_keeps_under_names_of_its_own_survives(key: str) -> None:
    _, adam = phased(x := points(), [Averaging()], 5)
    adam.state[x][key] = torch.full_like(x, 3.0)
    saved = copy.deepcopy(adam.state_dict())
    _, again = phased(y := points(), [Averaging()])
    again.load_state_dict(saved)
    assert torch.equal(again.state[y][key], torch.full_like(y, 3.0))


class Wide(Part):
    """Keeps whole numbers that float32 has not."""

    keeps = (Kept("count", shape=(), dtype=torch.int64),)

    def after(self, group: Any, param: Tensor, state: Any, course: Any) -> None:
        state["count"] += self.step

    def __init__(self, step: int) -> None:
        self.step = step


@pytest.mark.parametrize(("step", "said"), [(16_777_217, True), (3, False)])
def test_whole_numbers_that_a_stock_trainer_rounds_are_said(step: int, said: bool) -> None:
    _, adam = phased(x := points(), [Wide(step)], 3)
    stock = stock_of(x, adam.state_dict())
    _, again = phased(y := points(), [Wide(step)])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        again.load_state_dict(stock.state_dict())
    assert any("rounded to torch.float32" in str(each.message) for each in caught) is said
    assert int(again.state[y]["Wide.count"][0]) == pytest.approx(3 * step, abs=4)
