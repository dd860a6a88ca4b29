"""What a load restores, drops, or refuses: of parts that keep or learn things in uncommon ways."""

from __future__ import annotations

import copy
import gc
import math
import weakref
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam, AdamW

from opt3dgs_optim import (
    DEFAULTS,
    Averaging,
    EnergyHistogram,
    Kept,
    OutOfView,
    OwnFrame,
    Part,
    PhaseScheduler,
)
from opt3dgs_optim.names import ADAM_KEYS

TOTAL = 100
SHAPES = {"means": (6, 3), "scales": (6, 3), "quats": (6, 4), "opacities": (6, 1)}
NAMES = tuple(SHAPES)


class Training:
    """Gaussians with gradients of their own seed, six rows each, an optimizer per parameter."""

    def __init__(self, *parts: Part, dtype: torch.dtype = torch.float32) -> None:
        self.phases = PhaseScheduler(TOTAL, parts=[*parts])
        self.params = {n: Parameter(torch.zeros(s, dtype=dtype)) for n, s in SHAPES.items()}
        self.adams = {n: Adam([p], lr=0.01) for n, p in self.params.items()}
        self.phases.upgrade(self.adams)

    def run(self, start: int, stop: int, fall: float = 1.0) -> Training:
        for i in range(start, stop):
            for param in self.params.values():
                generator = torch.Generator().manual_seed(i)
                param.grad = torch.randn(param.shape, generator=generator).to(param)
            self.phases.observe(1.0 - fall * i / TOTAL)
            for adam in self.adams.values():
                adam.step()
        return self

    def saved(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        values = {name: param.detach().clone() for name, param in self.params.items()}
        return values, {n: copy.deepcopy(adam.state_dict()) for n, adam in self.adams.items()}

    def load(self, saved: tuple[dict[str, Tensor], dict[str, Any]]) -> Training:
        with torch.no_grad():
            for name, value in saved[0].items():
                self.params[name].copy_(value)
        for name, adam in self.adams.items():
            adam.load_state_dict(copy.deepcopy(saved[1][name]))
        return self

    def values(self) -> list[list[float]]:
        return [param.flatten().tolist() for param in self.params.values()]


# -- what is kept ----------------------------------------------------------------------------------


class ByName(Part):
    """Reads one entry for one parameter, the other for another."""

    names = NAMES
    keeps = (Kept("drift"), Kept("growth"), Kept("turns", per="parameter"))

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        name = "drift" if group["gaussian"] == "means" else "growth"
        state[name].lerp_(grad, 0.1)
        return grad + state[name]


class Late(Part):
    """Reads a second entry after a while."""

    keeps = (Kept("fast"), Kept("slow"))

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        state["fast"].lerp_(grad, 0.1)
        if course.current >= 30:
            state["slow"].lerp_(grad, 0.01)
            return grad + state["slow"]
        return grad + state["fast"]


class Sliding(Part):
    """Begins anew every 20 iterations."""

    keeps = (Kept("n", shape=()), Kept("c", per="parameter"), Kept("t", per="training"))

    def window(self, course: Any) -> tuple[int, int]:
        start = max(course.current, 0) // 20 * 20
        return start, start + 20

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        for name in ("n", "c", "t"):
            state[name] += 1
        return grad * state["n"][:, None] * state["c"] * state["t"]


class FromWhereItIsLow(Sliding):
    """Begins anew where the loss has fallen, which it has learnt."""

    def __init__(self) -> None:
        self.begin = 0

    def window(self, course: Any) -> tuple[int, int]:
        return self.begin, 10**9

    def observe(self, energy: Tensor, valid: Any, course: Any) -> None:
        if self.begin == 0 and float(energy) < 0.8:
            self.begin = course.current + 1

    def state_dict(self) -> dict[str, Any]:
        return {"begin": self.begin}

    def load_state_dict(self, state: Any) -> None:
        self.begin = state["begin"]


@pytest.mark.parametrize("at", [10, 30, 45, 59])
@pytest.mark.parametrize("kind", [ByName, Late, Sliding, FromWhereItIsLow])
def test_a_training_goes_on_as_if_it_had_not_been_stopped(kind: Any, at: int) -> None:
    whole = Training(kind()).run(0, at)
    saved = whole.saved()
    whole.run(at, 65)
    assert Training(kind()).load(saved).run(at, 65).values() == whole.values()
    assert whole.adams["means"].state[whole.params["means"]].keys() > set(ADAM_KEYS[:-1])
    # Into objects that have gone as far already, with losses that have fallen elsewhere.
    other = Training(kind()).run(0, at, fall=2.0)
    assert other.load(saved).run(at, 65).values() == whole.values()


@pytest.mark.parametrize("saved_in", [torch.float64, torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
@pytest.mark.filterwarnings("ignore:.*rounded to")
def test_a_model_of_another_dtype_goes_on(saved_in: torch.dtype, dtype: torch.dtype) -> None:
    """In the last thirtieth, where a mean is kept, too."""
    saved = Training(Averaging(), dtype=saved_in).run(0, 98).saved()
    training = Training(Averaging(), dtype=dtype).load(saved)
    state = training.adams["means"].state[training.params["means"]]
    assert state["Averaging.count"].tolist() == [1.0] * 6
    training.run(98, TOTAL)
    assert all(math.isfinite(x) for values in training.values() for x in values)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1.0, 1.5])
def test_a_number_that_cannot_be_is_damage(value: float) -> None:
    saved = Training(OutOfView()).run(0, 10).saved()
    numbers = saved[1]["means"]["param_groups"][0]["opt3dgs"]["optimizer"]["records"][0][0]
    numbers["numbers"]["OutOfView.seen_share"] = value
    training = Training(OutOfView())
    with pytest.raises(ValueError, match=r"seen_share=.*but a number of torch.float32 in \[0, 1\]"):
        training.load(saved)
    assert training.phases.iteration == 0


@pytest.mark.parametrize("value", [-1.0, -6.0, math.nan])
def test_rows_that_cannot_be_begin_anew(value: float) -> None:
    saved = Training(Averaging()).run(0, 98).saved()
    saved[1]["means"]["state"][0]["Averaging.count"][2] = value
    training = Training(Averaging())
    with pytest.warns(UserWarning, match="of 1 of 6 rows is not finite, or cannot be"):
        training.load(saved)
    state = training.adams["means"].state[training.params["means"]]
    assert state["Averaging.count"].tolist() == [1, 1, 0, 1, 1, 1]


@pytest.mark.parametrize(
    "options",
    [
        *({"name": "a.b"}, {"name": ""}, {"name": 1}, {"name": "n", "dtype": "float32"}),
        {"name": "n", "per": "training", "initial": None},
    ],
    ids=str,
)
def test_a_declaration_that_cannot_be(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"Kept: (name|dtype|initial)="):
        Kept(**options)


# -- what is learnt --------------------------------------------------------------------------------


class Lowest(Part):
    """Says nothing of what it has learnt before it has learnt something."""

    def __init__(self) -> None:
        self.low: dict[str, float] = {}

    def observe(self, energy: Tensor, valid: Any, course: Any) -> None:
        if course.current >= 10:
            self.low["least"] = min(float(energy), self.low.get("least", 9.0))

    def factor(self, group: Any, course: Any) -> float:
        return self.low.get("least", 1.0)

    def state_dict(self) -> dict[str, Any]:
        return dict(self.low)

    def load_state_dict(self, state: Any) -> None:
        self.low.clear()
        self.low.update(state)


def test_what_a_checkpoint_does_not_know_is_forgotten() -> None:
    training = Training(Lowest()).run(0, 5)
    saved = training.saved()
    fresh = Training(Lowest()).load(saved).run(5, 9)
    assert training.run(5, 40).load(saved).run(5, 9).values() == fresh.values()


def test_a_histogram_that_a_checkpoint_does_not_know_begins_anew() -> None:
    saved = Training(Averaging()).run(0, 5).saved()
    histogram = EnergyHistogram(warmup=4)
    Training(histogram, Averaging()).run(0, 50).load(saved)
    assert histogram.num_observed == 0
    assert float(histogram.multiplier) == 1.0


def test_what_cannot_be_forgotten_is_said() -> None:
    class Stubborn(Lowest):
        def load_state_dict(self, state: Any) -> None:
            self.low = {"least": state["least"]}

    training = Training(Stubborn()).run(0, 5)
    saved = training.saved()
    with pytest.warns(UserWarning, match="Stubborn has learnt something that this checkpoint"):
        training.run(5, 40).load(saved)


def test_a_load_that_is_refused_leaves_nothing_of_itself() -> None:
    """The first of two parts had loaded its own already, in place."""
    saved = Training(Lowest(), EnergyHistogram()).run(0, 40).saved()
    saved[1]["means"]["param_groups"][0]["opt3dgs"]["parts"]["EnergyHistogram"]["nu"] = "much"
    training = Training(Lowest(), EnergyHistogram())
    with pytest.raises(ValueError, match="nu='much'"):
        training.load(saved)
    lowest = training.phases.part(Lowest)
    assert lowest is not None
    assert lowest.low == {}
    assert training.phases.iteration == 0


# -- whose parameters they are ---------------------------------------------------------------------


@pytest.mark.parametrize("parts", [[OwnFrame()], [*DEFAULTS]], ids=["OwnFrame", "defaults"])
def test_a_second_set_of_the_same_names_is_left_alone_and_said(parts: list[Part]) -> None:
    def gaussians(size: float) -> list[dict[str, Any]]:
        values = {"xyz": torch.zeros(4, 3), "scaling": torch.full((4, 3), size)}
        values["rotation"] = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(4, 1)
        return [{"params": [Parameter(v)], "name": n, "lr": 0.01} for n, v in values.items()]

    trained = []
    for second in (False, True):
        phases = PhaseScheduler(TOTAL, parts=parts)
        optimizer = phases.upgrade(Adam(gaussians(-1.0)))
        if second:
            xyz, *others = gaussians(-7.0)
            with pytest.warns(UserWarning, match="the first group that holds 'means'"):
                optimizer.add_param_group(xyz)
            for group in others:
                optimizer.add_param_group(group)
        for _ in range(8):
            for group in optimizer.param_groups:
                group["params"][0].grad = torch.ones_like(group["params"][0])
            phases.observe(1.0)
            optimizer.step()
        trained.append(optimizer.param_groups[0]["params"][0].tolist())
    assert trained[0] == trained[1]


def test_parameters_that_density_control_has_replaced_are_let_go() -> None:
    """With their gradients and moments, before the next forward: that is when memory peaks."""
    training = Training(*DEFAULTS).run(0, 3)
    alive = [weakref.ref(param) for param in training.params.values()]
    for adam in training.adams.values():
        old = adam.param_groups[0]["params"][0]
        state = adam.state.pop(old)
        new = Parameter(torch.cat([old.detach(), old.detach()]))
        moments = {k: torch.cat([v, v]) for k, v in state.items() if k.startswith("exp")}
        adam.state[new] = {"step": state["step"], **moments}
        adam.param_groups[0]["params"] = [new]
    training.params = {n: adam.param_groups[0]["params"][0] for n, adam in training.adams.items()}
    old = new = state = moments = None
    training.phases.observe(1.0)
    gc.collect()
    assert [ref() for ref in alive] == [None] * len(SHAPES)
    training.run(4, 8)


# -- what hooks give -------------------------------------------------------------------------------


class Expanded(Part):
    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        return grad.mean(0, keepdim=True).expand_as(grad)


class Transposed(Part):
    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        return (2 * grad).t().contiguous().t()


class Wide(Part):
    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        return 2 * grad.double()


@pytest.mark.parametrize("kind", [Expanded, Transposed, Wide])
@pytest.mark.parametrize("transposed", [False, True])
def test_a_gradient_of_another_layout_or_dtype(kind: Any, transposed: bool) -> None:
    """torch's fused step reads it as if it lay in memory as the parameter does."""
    ends = []
    for fused in (False, True):
        value = torch.zeros(3, 50).t() if transposed else torch.zeros(50, 3)
        param = Parameter(value)
        phases = PhaseScheduler(TOTAL, parts=[kind()])
        adam = Adam([{"params": [param], "name": "means"}], lr=0.01, fused=fused)
        phases.upgrade(adam)
        for i in range(10):
            grad = torch.randn(50, 3, generator=torch.Generator().manual_seed(i))
            param.grad = torch.empty_like(param).copy_(grad)
            phases.observe(1.0)
            adam.step()
        ends.append(param.detach())
    torch.testing.assert_close(*ends, rtol=1e-5, atol=1e-7)


class Refuses(Part):
    names = ("scales",)

    def before(self, group: Any, param: Any, grad: Any, state: Any, course: Any) -> Any:
        return None


class Moves(Part):
    names = ("means",)

    def displacement(self, group: Any, param: Any, step: Any, state: Any, course: Any) -> Tensor:
        return step


class Doubles(Part):
    def factor(self, group: Any, course: Any) -> float:
        return 2.0


@pytest.mark.parametrize("parts", [[Moves(), Refuses()], [Doubles(), Refuses()]], ids=str)
def test_weights_do_not_decay_before_a_hook_is_refused(parts: list[Part]) -> None:
    params = [Parameter(torch.ones(4, 3)) for _ in range(2)]
    groups = [{"params": [p], "name": n} for p, n in zip(params, NAMES, strict=False)]
    phases = PhaseScheduler(TOTAL, parts=parts)
    optimizer = phases.upgrade(AdamW(groups, lr=0.01, weight_decay=0.5))
    phases.observe(1.0)
    for param in params:
        param.grad = torch.ones_like(param)
    with pytest.raises(ValueError, match=r"Refuses\.before"):
        optimizer.step()
    assert all(bool((param == 1).all()) for param in params)
    assert [group["weight_decay"] for group in optimizer.param_groups] == [0.5] * 2


def test_a_part_is_asked_once_a_step_whether_it_can_act() -> None:
    asked = []

    class Asked(Part):
        names = ("means",)

        def ready(self, group: Any, course: Any) -> bool:
            asked.append(course.current)
            return len(asked) % 2 == 1

        def before(self, group: Any, param: Any, grad: Any, state: Any, course: Any) -> Tensor:
            return 2 * grad

        def factor(self, group: Any, course: Any) -> float:
            return 2.0

        def after(self, group: Any, param: Any, state: Any, course: Any) -> None:
            assert len(asked) % 2 == 1

    Training(Asked()).run(0, 4)
    assert asked == [0, 1, 2, 3]
