"""The class of an optimizer stays the trainer's: what it is, what it overrides, how it is pickled.

Trainers choose by `isinstance` (nv-tlabs/3dgrut #58), override `zero_grad`, or are AdamW, whose old
checkpoints lack a key that its own `__setstate__` fills in (pytorch PR #144972).
"""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch.nn import Parameter
from torch.optim import Adam, AdamW

from opt3dgs_optim import Averaging, Fading, OutOfView, PhaseScheduler, StepAdam


class Counting(Adam):
    """A trainer's, with overrides and an attribute of its own."""

    def __init__(self, params: Any, **options: Any) -> None:
        super().__init__(params, **options)
        self.calls: list[str] = []

    def zero_grad(self, set_to_none: bool = True) -> None:
        self.calls.append("zero_grad")
        super().zero_grad(set_to_none)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        if hasattr(self, "calls"):
            self.calls.append("add_param_group")
        super().add_param_group(param_group)

    def state_dict(self) -> dict[str, Any]:
        self.calls.append("state_dict")
        return super().state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.calls.append("load_state_dict")
        super().load_state_dict(state_dict)

    def lowest_rate(self) -> float:
        return min(group["lr"] for group in self.param_groups)


class Deeper(Counting):
    """And a class of that."""


class Decoupled(AdamW):
    """A trainer's AdamW."""


KINDS: dict[str, type[Adam]] = {
    "Adam": Adam,
    "AdamW": AdamW,
    "a trainer's": Counting,
    "a class of a trainer's": Deeper,
    "a trainer's AdamW": Decoupled,
}
SOME = (Fading(), OutOfView(), Averaging())  # that ask for no other parameter
PARTS = {"no parts": (), "parts": SOME}


def upgraded(kind: type[Adam], parts: Any = SOME, **options: Any) -> Any:
    x = Parameter(torch.ones(4, 3))
    optimizer = kind([{"params": [x], "name": "xyz"}], lr=0.1, **options)  # pyright: ignore
    return PhaseScheduler(90, parts=list(parts)).upgrade(optimizer)


def step(optimizer: Any, times: int = 1) -> None:
    for _ in range(times):
        for group in optimizer.param_groups:
            for param in group["params"]:
                param.grad = torch.ones_like(param)
        course = getattr(optimizer, "course", None)
        if course is not None:
            course.observe(0.1)
        optimizer.step()


@pytest.mark.parametrize("name", KINDS)
def test_it_is_still_of_its_class(name: str) -> None:
    kind = KINDS[name]
    optimizer = upgraded(kind)
    assert isinstance(optimizer, kind)
    assert isinstance(optimizer, StepAdam)
    assert isinstance(optimizer, torch.optim.Adam)
    assert kind.__name__ in type(optimizer).__name__ or type(optimizer).__name__ == "StepAdam"
    # One class for each of the trainer's, made once.
    assert type(upgraded(kind)) is type(optimizer)


def test_what_a_trainer_overrides_is_called() -> None:
    optimizer = upgraded(Deeper)
    optimizer.zero_grad()
    optimizer.add_param_group({"params": [Parameter(torch.ones(2))], "name": "pose"})
    optimizer.load_state_dict(optimizer.state_dict())
    expected = ["zero_grad", "add_param_group", "state_dict", "load_state_dict"]
    assert [call for call in optimizer.calls if call in expected] == expected
    assert optimizer.lowest_rate() == 0.1


def test_what_a_trainer_overrides_calls_super_once_for_each_step() -> None:
    """An override that wraps torch's own keeps its effect on what is saved."""

    class Tagged(Adam):
        def state_dict(self) -> dict[str, Any]:
            return {**super().state_dict(), "tag": 7}

    optimizer = upgraded(Tagged)
    step(optimizer, 3)
    saved = optimizer.state_dict()
    assert saved["tag"] == 7
    assert float(saved["state"][0]["step"]) == 3.0


COPIES: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("way", COPIES)
def test_it_is_copied_and_pickled(name: str, way: str) -> None:
    """The class that is made is found again by pickle, in this process and in another."""
    optimizer = upgraded(KINDS[name])
    step(optimizer, 3)
    twin = COPIES[way](optimizer)
    assert type(twin) is type(optimizer)
    assert isinstance(twin, KINDS[name])
    ends = []
    for each in (optimizer, twin):
        step(each, 3)
        ends.append(each.param_groups[0]["params"][0].detach())
    assert torch.equal(*ends)


# -- AdamW on every road of a checkpoint -----------------------------------------------------------


def by_file(state: Any) -> Any:
    torch.save(state, buffer := io.BytesIO())
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


def of_an_older_torch(state: Any) -> Any:
    older = copy.deepcopy(state)
    for group in older["param_groups"]:
        group.pop("decoupled_weight_decay", None)
    return older


ROADS: dict[str, Callable[[Any], Any]] = {
    "as it is": copy.deepcopy,
    "a file": by_file,
    "of an older torch": of_an_older_torch,
}


def trained(kind: type[Adam], parts: Any, saved: Any) -> torch.Tensor:
    """Where a parameter is after three steps from a checkpoint; `parts` None: not upgraded."""
    if parts is None:
        x = Parameter(torch.ones(4, 3))
        optimizer: Any = kind([{"params": [x], "name": "xyz"}], lr=0.1, weight_decay=0.1)
    else:
        optimizer = upgraded(kind, parts, weight_decay=0.1)
        x = optimizer.param_groups[0]["params"][0]
    optimizer.load_state_dict(copy.deepcopy(saved))  # torch takes its tensors as they are
    step(optimizer, 3)
    return x.detach()


@pytest.mark.parametrize("road", ROADS)
@pytest.mark.parametrize("kind", [AdamW, Decoupled])
def test_a_stock_adamws_checkpoint_is_an_adamws(road: str, kind: type[Adam]) -> None:
    x = Parameter(torch.ones(4, 3))
    stock = kind([{"params": [x], "name": "xyz"}], lr=0.1, weight_decay=0.1)
    step(stock, 2)
    saved = ROADS[road](stock.state_dict())
    ours, theirs = trained(kind, (), saved), trained(kind, None, saved)
    assert torch.equal(ours, theirs)


@pytest.mark.parametrize("road", ROADS)
@pytest.mark.parametrize("kind", [AdamW, Decoupled])
def test_an_upgraded_adamws_checkpoint_is_an_adamws(road: str, kind: type[Adam]) -> None:
    """Ours to ours, and ours to stock."""
    first = upgraded(kind, (), weight_decay=0.1)
    step(first, 2)
    saved = ROADS[road](first.state_dict())
    ours, theirs = trained(kind, (), saved), trained(kind, None, saved)
    assert torch.equal(ours, theirs)


# -- what cannot be kept is refused ----------------------------------------------------------------


class Slotted(Adam):
    """A step of its own, which no part can be put around."""

    def step(self, closure: Any = None) -> Any:
        raise NotImplementedError


@pytest.mark.parametrize("parts", PARTS)
def test_what_upgrade_cannot_keep_is_refused_before_anything_has_changed(parts: str) -> None:
    """Of a dict, none is changed where one cannot be."""
    params = {name: Parameter(torch.ones(4, 3)) for name in ("means", "scales")}
    optimizers: dict[str, Any] = {
        "means": Adam([params["means"]]),
        "scales": Slotted([params["scales"]]),
    }
    before = {name: (type(o), o.state_dict(), set(vars(o))) for name, o in optimizers.items()}
    with pytest.raises(TypeError, match="scales"):
        PhaseScheduler(90, parts=list(PARTS[parts])).upgrade(optimizers)
    after = {name: (type(o), o.state_dict(), set(vars(o))) for name, o in optimizers.items()}
    assert after == before
