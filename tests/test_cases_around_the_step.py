"""What others put around a step: hooks, profilers, steps of their own; and what breaks it off.

A stock optimizer stands beside an upgraded one, which must do what that does.
"""

from __future__ import annotations

import functools
import pickle
import types
import warnings
import weakref
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch._C._profiler import _ExperimentalConfig
from torch.nn import Parameter
from torch.optim import Adam, AdamW
from torch.optim.lr_scheduler import ExponentialLR
from torch.optim.optimizer import (
    register_optimizer_step_post_hook,
    register_optimizer_step_pre_hook,
)
from torch.profiler import ProfilerActivity, profile

from opt3dgs_optim import AWSGLD, ConstantMultiplier, LQNAdam, Part, PhaseScheduler
from opt3dgs_optim.overrides import TemporaryOverrides


def made(kind: type[Adam] = Adam, **options: Any) -> Adam:
    """An optimizer of positions, which have a gradient."""
    param = Parameter(torch.zeros(5, 3))
    param.grad = torch.ones(5, 3)
    return kind([{"params": [param], "name": "means", "lr": 0.01}], **options)


def upgraded(optimizer: Adam, *parts: Part) -> tuple[PhaseScheduler, Adam]:
    phases = PhaseScheduler(100, parts=[*parts])
    phases.upgrade(optimizer)
    phases.observe(1.0)
    return phases, optimizer


PARTS = pytest.mark.parametrize(
    "parts", [[], [ConstantMultiplier(2.0)]], ids=["no parts", "a part"]
)


# -- hooks and profilers ---------------------------------------------------------------------------


@PARTS
def test_hooks_of_all_optimizers(parts: list[Part]) -> None:
    calls = []
    handles = [
        register_optimizer_step_pre_hook(lambda o, *_: calls.append(("pre", type(o).__name__))),
        register_optimizer_step_post_hook(lambda o, *_: calls.append(("post", type(o).__name__))),
    ]
    try:
        made().step()
        _phases, optimizer = upgraded(made(), *parts)
        optimizer.step()
    finally:
        for handle in handles:
            handle.remove()
    optimizer.step()
    assert calls == 2 * [("pre", "Adam"), ("post", "Adam")]


@PARTS
def test_a_hook_that_a_closure_registers(parts: list[Part]) -> None:
    calls: list[str] = []
    for optimizer in (made(), upgraded(made(), *parts)[1]):

        def closure(optimizer: Adam = optimizer) -> float:
            optimizer.register_step_post_hook(lambda *_: calls.append("post"))
            return 1.0

        optimizer.step(closure)
    assert calls == ["post", "post"]


@pytest.mark.parametrize("kind", [AWSGLD, LQNAdam])
def test_hooks_run_once_around_the_step_of_a_subclass(kind: Any) -> None:
    class Clipping(kind):
        def step(self, closure: Any = None) -> Any:
            return super().step(closure)

    seen: list[float] = []
    optimizer: Any = made(Clipping)
    param = optimizer.param_groups[0]["params"][0]

    def halve(*_: Any) -> None:
        param.grad.mul_(0.5)

    optimizer.register_step_pre_hook(halve)
    optimizer.register_step_post_hook(lambda *_: seen.append(float(param.grad[0, 0])))
    optimizer.step()
    assert seen == [0.5]


def steps_seen(optimizer: Adam, **options: Any) -> list[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with profile(activities=[ProfilerActivity.CPU], **options) as seen:
            optimizer.step()
    return [event.name for event in seen.events() or () if "Optimizer.step" in event.name]


@PARTS
@pytest.mark.parametrize(
    "options",
    [{}, {"experimental_config": _ExperimentalConfig(profile_all_threads=True)}],
    ids=["", "all threads"],
)
def test_a_profiler(parts: list[Part], options: dict[str, Any]) -> None:
    _phases, optimizer = upgraded(made(), *parts)
    assert steps_seen(optimizer, **options) == steps_seen(made(), **options)
    assert steps_seen(optimizer, **options) == ["Optimizer.step#Adam.step"]


# -- steps of the trainer's own --------------------------------------------------------------------


def counted(calls: list[int], step: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(step)
    def around(*args: Any, **options: Any) -> Any:
        calls.append(1)
        return step(*args, **options)

    return around


def a_class(calls: list[int]) -> Adam:
    return made(type("Own", (Adam,), {"step": counted(calls, Adam.step)}))


def an_instance(calls: list[int]) -> Adam:
    optimizer: Any = made()
    optimizer.step = counted(calls, optimizer.step)
    return optimizer


def an_instance_before_its_scheduler(calls: list[int]) -> Adam:
    optimizer: Any = made()
    optimizer.step = types.MethodType(counted(calls, Adam.step), optimizer)
    ExponentialLR(optimizer, 0.9)
    return optimizer


def an_instance_after_its_scheduler(calls: list[int]) -> Adam:
    optimizer: Any = made()
    ExponentialLR(optimizer, 0.9)
    optimizer.step = counted(calls, optimizer.step)
    return optimizer


@PARTS
@pytest.mark.parametrize(
    "make",
    [a_class, an_instance, an_instance_before_its_scheduler, an_instance_after_its_scheduler],
    ids=lambda make: make.__name__,
)
def test_a_step_of_the_trainers_own_is_never_dropped(make: Any, parts: list[Part]) -> None:
    """Whatever says that it is a wrapper: `functools.wraps` copies what torch marks its own by."""
    calls = list[int]()
    optimizer = make(calls)
    with pytest.raises(TypeError, match=r"of its own|replaced the step"):
        upgraded(optimizer, *parts)
    optimizer.step()
    assert calls == [1]


@PARTS
def test_the_classs_own_step_as_an_attribute_is_no_other_step(parts: list[Part]) -> None:
    optimizer: Any = made()
    optimizer.step = optimizer.step  # as wrappers do that put back what they had replaced
    _phases, optimizer = upgraded(optimizer, *parts)
    optimizer.step()
    assert optimizer.param_groups[0]["params"][0][0, 0].item() < -0.009


@pytest.mark.parametrize("kind", [Adam, AdamW])
def test_its_class_makes_optimizers(kind: type[Adam]) -> None:
    """As `type(optimizer)(...)` of a trainer that makes it anew: they have no parts."""
    _phases, optimizer = upgraded(made(kind), ConstantMultiplier(2.0))
    again = type(optimizer)([Parameter(torch.zeros(2, 3))], lr=0.5)
    assert type(again) is kind
    assert again.param_groups[0]["lr"] == 0.5
    again.step()


class GivesAll(Adam):
    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__.copy()


def test_a_class_whose_pickles_hold_all_attributes() -> None:
    _phases, optimizer = upgraded(made(GivesAll), ConstantMultiplier(2.0))
    optimizer.step()
    copy = pickle.loads(pickle.dumps(optimizer))
    assert copy.param_groups[0]["lr"] == 0.01
    copy.step()


# -- closures --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "value", [(torch.tensor(1.0), {"psnr": 20.0}), {"loss": 1.0}, torch.ones(3), "done"], ids=str
)
@pytest.mark.parametrize("kind", ["Adam, upgraded", "AWSGLD"])
def test_without_parts_a_closure_returns_what_it_likes(kind: str, value: Any) -> None:
    optimizer = made(AWSGLD) if kind == "AWSGLD" else upgraded(made())[1]
    assert optimizer.step(lambda: value) is value
    assert optimizer.param_groups[0]["params"][0][0, 0].item() < -0.009


def test_with_parts_a_closure_returns_a_number() -> None:
    _phases, optimizer = upgraded(made(), ConstantMultiplier(2.0))
    optimizer.step(lambda: 1.0)
    with pytest.raises(ValueError, match="one real number is needed"):
        optimizer.step(lambda: (1.0, {}))


# -- groups that are held --------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["lr", "betas", "weight_decay"])
def test_writing_into_a_group_of_before_is_said_once(key: str) -> None:
    stock = made()
    held = stock.param_groups[0]
    phases, optimizer = upgraded(stock, ConstantMultiplier(2.0))
    held[key] = 0.5 if key != "betas" else (0.5, 0.5)

    def go_on() -> None:
        for _ in range(40):
            phases.observe(1.0)
            optimizer.step()

    with pytest.warns(UserWarning, match=f"'{key}' of means was changed.*after") as said:
        go_on()
    assert len(said) == 1


def test_a_group_of_before_that_nobody_writes_into_is_no_mistake() -> None:
    stock = made()
    held = stock.param_groups[0]
    phases, optimizer = upgraded(stock, ConstantMultiplier(2.0))
    scheduler = ExponentialLR(optimizer, 0.9)
    for _ in range(40):
        phases.observe(1.0)
        optimizer.step()
        scheduler.step()
    assert held["lr"] == 0.01
    held["weight_decay"] = 0.0  # which was 0
    phases.observe(1.0)


def test_the_group_of_before_does_not_keep_parameters_alive() -> None:
    phases, optimizer = upgraded(made(), ConstantMultiplier(2.0))
    gone = weakref.ref(optimizer.param_groups[0]["params"][0])
    new = Parameter(torch.zeros(4, 3))
    optimizer.param_groups[0]["params"] = [new]
    optimizer.state.clear()
    for _ in range(12):
        new.grad = torch.ones(4, 3)
        phases.observe(1.0)
        optimizer.step()
    assert gone() is None


# -- steps that are broken off ---------------------------------------------------------------------


@pytest.mark.parametrize("fused", [False, True])
@PARTS
def test_hidden_rows_stay_where_a_masked_step_fails(fused: bool, parts: list[Part]) -> None:
    """In the second of two groups, whose gradient torch's Adam does not take."""
    first, second = Parameter(torch.zeros(5, 3)), Parameter(torch.zeros(5, 3))
    first.grad, second.grad = torch.ones(5, 3), torch.ones(5, 3).to_sparse()
    groups = [{"params": [p], "name": n} for p, n in ((first, "means"), (second, "scales"))]
    _phases, optimizer = upgraded(Adam(groups, lr=0.01, fused=fused), *parts)
    step: Any = optimizer.step
    mask = torch.tensor([True, False, True, False, True])
    with pytest.raises(RuntimeError, match="sparse"):
        step(visible=mask)
    assert not first[~mask].any()


def test_an_interrupt_while_values_are_restored_restores_them_all() -> None:
    class Interrupting(dict[str, Any]):
        times = 1

        def __setitem__(self, key: str, value: Any) -> None:
            super().__setitem__(key, value)
            if value == "own" and Interrupting.times:
                Interrupting.times -= 1
                raise KeyboardInterrupt

    owners = [dict[str, Any](lr="own"), Interrupting(lr="own"), dict[str, Any](lr="own")]

    def change() -> None:
        with TemporaryOverrides() as temporary:
            for owner in owners:
                temporary.item(owner, "lr", "ours")

    with pytest.raises(KeyboardInterrupt):
        change()
    assert [owner["lr"] for owner in owners] == ["own"] * 3
