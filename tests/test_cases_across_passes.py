"""A second pass over the same iterations, another optimizer in between, a trainer's own names."""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from functools import partial
from typing import Any

import pytest
import torch
from simulated_device import SimulatedDevice
from torch import Tensor, distributed
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import (
    Annealing,
    Averaging,
    Course,
    Curvature,
    EnergyHistogram,
    Fading,
    FreshMoments,
    Kept,
    OutOfView,
    Part,
    PhaseScheduler,
    RunLog,
    StepAdam,
)

TOTAL = 300
ROWS = 6


class Training:
    """Gaussian parameters of six rows, of one optimizer with named groups; None: without parts."""

    def __init__(
        self,
        *parts: Part,
        stock: bool = False,
        total: int = TOTAL,
        kind: type[Adam] = Adam,
        names: tuple[str, ...] = ("means",),
    ) -> None:
        self.params = {name: Parameter(torch.zeros(ROWS, 3)) for name in names}
        groups = [{"params": [param], "name": name} for name, param in self.params.items()]
        self.adam: Any = kind(groups, lr=0.01)
        self.phases: Any = None
        if not stock:
            self.phases = PhaseScheduler(total, 0.9, parts=[*parts])
            self.phases.upgrade(self.adam)

    def run(self, start: int, stop: int) -> Training:
        for i in range(start, stop):
            for param in self.params.values():
                generator = torch.Generator().manual_seed(i)
                param.grad = torch.randn(param.shape, generator=generator)
            if self.phases is not None:
                self.phases.observe(0.1)
            self.adam.step()
        return self

    def saved(self) -> Any:
        return copy.deepcopy(self.adam.state_dict())

    def load(self, saved: Any) -> Training:
        self.adam.load_state_dict(copy.deepcopy(saved))
        return self

    def state(self, name: str = "means") -> dict[str, Any]:
        return self.adam.state[self.params[name]]


# -- steps that somebody else has made ---------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*The clock is moved on")
@pytest.mark.parametrize("between", ["a plain Adam", "no parts"])
def test_events_of_steps_that_were_made_without_the_part_are_over(between: str) -> None:
    """A step that the trainer leaves out makes up for them; here none was left out."""
    saved = Training(Fading(), total=3000).run(0, 100).saved()
    other = Training(stock=between == "a plain Adam", total=3000).load(saved).run(100, 1000)
    training = Training(Fading(), total=3000).load(other.saved())
    before = training.state()["exp_avg_sq"].clone()
    training.run(1000, 1001)
    assert (training.state()["exp_avg_sq"] / before).min() > 0.5


def test_steps_without_parts_are_noted_where_there_are_some_only() -> None:
    """A parameter without a gradient has made none; after a load none has been made yet."""
    training = Training(names=("means", "scales"))
    for i in range(5):
        training.params["means"].grad = torch.ones(ROWS, 3)
        training.phases.observe(0.1, iteration=i)
        training.adam.step()
    records = training.saved()["param_groups"][0]["opt3dgs"]["optimizer"]["records"]
    assert [group[0]["last_step"] for group in records] == [4, None]
    again = Training(names=("means", "scales")).load(training.saved())
    assert again.saved()["param_groups"][0]["opt3dgs"]["optimizer"]["records"] == records


# -- a second pass ------------------------------------------------------------------------------


def passes(save: bool) -> dict[str, tuple[float, float]]:
    """A rarely stepped parameter, saved between the rewind and its next step."""
    names = ("means", "shN")

    def fresh() -> tuple[Any, Any, Any]:
        params = {name: Parameter(torch.zeros(ROWS, 3)) for name in names}
        adams = {name: Adam([param], lr=0.01) for name, param in params.items()}
        phases = PhaseScheduler(TOTAL, parts=[Averaging()])
        phases.upgrade(adams)
        return phases, adams, params

    def one(i: int, rare: bool) -> None:
        for param in params.values():
            param.grad = param.detach() - 1
        phases.observe(0.1, iteration=i)
        adams["means"].step()
        if rare:
            adams["shN"].step()

    phases, adams, params = fresh()
    for i in range(TOTAL):
        one(i, True)
    with torch.no_grad():
        for param in params.values():
            param.zero_()
    for i in range(292, 296):
        one(i, False)
    if save:
        saved = {name: copy.deepcopy(adam.state_dict()) for name, adam in adams.items()}
        values = {name: param.detach().clone() for name, param in params.items()}
        phases, adams, params = fresh()
        for name, adam in adams.items():
            adam.load_state_dict(saved[name])
            with torch.no_grad():
                params[name].copy_(values[name])
    for i in range(296, TOTAL):
        one(i, True)
    return {
        name: (param[0, 0].item(), adams[name].state[param]["Averaging.count"][0].item())
        for name, param in params.items()
    }


def test_what_was_kept_in_the_first_pass_is_in_no_checkpoint_of_the_second() -> None:
    assert passes(save=True) == passes(save=False)


class Tally(Part):
    """Counts steps, per parameter and per training."""

    keeps = (Kept("p", per="parameter"), Kept("t", per="training"))

    def window(self, course: Any) -> tuple[int, int]:
        return 0, TOTAL

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        state["p"] += 1
        state["t"] += 1
        return grad


def test_a_number_of_the_first_pass_is_in_no_checkpoint_of_the_second() -> None:
    training = Training(Tally()).run(0, 10)
    training.phases.observe(0.1, iteration=3)
    shared = training.saved()["param_groups"][0]["opt3dgs"]
    assert shared["kept"] == {}
    assert shared["optimizer"]["records"][0][0]["numbers"] == {}


@pytest.mark.parametrize("how", ["observe", "load_state_dict"])
def test_the_clock_is_set_back_by_a_load_of_the_scheduler_too(how: str) -> None:
    training = Training(Averaging())
    param = training.params["means"]

    def go(steps: int, goal: float) -> None:
        for _ in range(steps):
            param.grad = param.detach() - goal
            training.phases.observe(0.1)
            training.adam.step()

    go(292, 1.0)
    saved, value = copy.deepcopy(training.phases.state_dict()), param.detach().clone()
    go(7, 50.0)
    with torch.no_grad():
        param.copy_(value)
    if how == "load_state_dict":
        training.phases.load_state_dict(saved)
    else:
        param.grad = param.detach() - 1.0
        training.phases.observe(0.1, iteration=292)
        training.adam.step()
    go(8 if how == "load_state_dict" else 7, 1.0)
    assert training.state()["Averaging.count"].tolist() == [8.0] * ROWS
    assert param.max() < 2.0


def test_loading_again_and_again_is_no_mistake(recwarn: pytest.WarningsRecorder) -> None:
    training = Training(Tally()).run(0, 5)
    saved = training.saved()
    for _ in range(10):
        training.run(5, 8).load(saved)
    assert not recwarn.list


@pytest.mark.parametrize("rewound", [False, True])
def test_moments_restart_in_each_pass(rewound: bool) -> None:
    phases = PhaseScheduler(TOTAL, 0.9, parts=[FreshMoments()])
    params = {name: Parameter(torch.zeros(ROWS, 3)) for name in ("means", "shN")}
    adams = phases.upgrade({name: Adam([param], lr=0.01) for name, param in params.items()})

    def one(i: int, rare: bool) -> None:
        for param in params.values():
            param.grad = torch.ones_like(param)
        phases.observe(0.1, iteration=i)
        adams["means"].step()
        if rare:
            adams["shN"].step()

    for i in range(TOTAL if rewound else 256):
        one(i, True)
    for i in range(256, TOTAL):
        one(i, i == 284)
    steps = {name: adams[name].state[param]["step"].item() for name, param in params.items()}
    assert steps == {"means": 30.0, "shN": 1.0}


@pytest.mark.parametrize("back", ["a longer run", "an earlier iteration"])
def test_a_second_exploitation_is_judged_by_itself(back: str) -> None:
    def evidence(phases: PhaseScheduler) -> float:
        part = phases.part(Curvature)
        assert part is not None
        return part.evidence(phases).abs().sum().item()

    def fresh(total: int) -> tuple[PhaseScheduler, Any, Parameter]:
        phases = PhaseScheduler(total, 0.5, parts=[Curvature()], adaptive=True)
        generator = torch.Generator().manual_seed(1)
        param = Parameter(torch.randn(200, 3, generator=generator))
        return phases, phases.upgrade(Adam([{"params": [param], "name": "means"}])), param

    def go(training: Any, start: int, stop: int) -> None:
        phases, adam, param = training
        for i in range(start, stop):
            param.grad = torch.randn(param.shape, generator=torch.Generator().manual_seed(i))
            phases.observe(0.1, iteration=i)
            adam.step()

    training = fresh(400)
    go(training, 0, 400)
    assert evidence(training[0]) > 0
    assert "Curvature" in training[0].switched_off
    if back == "a longer run":
        saved = copy.deepcopy(training[1].state_dict())
        training = fresh(1200)
        training[1].load_state_dict(saved)
        go(training, 400, 501)
    else:
        go(training, 0, 101)
    assert evidence(training[0]) == 0
    assert training[0].switched_off == {}
    go(training, 501 if back == "a longer run" else 101, 590 if back == "a longer run" else 190)
    assert evidence(training[0]) == 0


def test_the_same_exploitation_goes_on_with_its_evidence() -> None:
    part = Curvature()
    phases = PhaseScheduler(400, 0.5, parts=[part], adaptive=True)
    param = Parameter(torch.zeros(20, 3))
    adam: Any = phases.upgrade(Adam([{"params": [param], "name": "means"}]))
    for i in range(300):
        param.grad = torch.randn(20, 3, generator=torch.Generator().manual_seed(i))
        phases.observe(0.1)
        adam.step()
    again = Curvature()
    other = PhaseScheduler(400, 0.5, parts=[again], adaptive=True)
    resumed: Any = other.upgrade(
        Adam([{"params": [Parameter(torch.zeros(20, 3))], "name": "means"}])
    )
    resumed.load_state_dict(copy.deepcopy(adam.state_dict()))
    assert again.evidence(other).tolist() == part.evidence(phases).tolist()
    assert again.evidence(other).sum() > 0


@pytest.mark.parametrize("window", [5, [1], [1.0, 2.0], "ab"])
def test_a_damaged_window_of_the_evidence(window: Any) -> None:
    part = Curvature()
    with pytest.raises(ValueError, match=r"window=.*but None or two iterations are needed"):
        part.load_state_dict({**part.state_dict(), "window": window})


@pytest.mark.parametrize("order", [("means", "scales"), ("scales", "means")])
def test_what_was_published_before_a_load_is_of_another_step(order: tuple[str, ...]) -> None:
    """One step is taken back by a load into the same objects."""

    def trained(same: bool) -> list[float]:
        def fresh() -> tuple[Any, Any, Any]:
            params = {name: Parameter(torch.zeros(50, 3)) for name in order}
            adams = {name: Adam([param], lr=0.01) for name, param in params.items()}
            phases = PhaseScheduler(3000, parts=[OutOfView()])
            phases.upgrade(adams)
            return phases, adams, params

        def step(seed: int) -> None:
            seen = torch.rand(50, generator=torch.Generator().manual_seed(seed)) < 0.1
            for name, param in params.items():
                grad = torch.randn(50, 3, generator=torch.Generator().manual_seed(seed))
                param.grad = grad * seen[:, None] if name == "means" else grad
            phases.observe(0.1)
            for name in order:
                adams[name].step()

        phases, adams, params = fresh()
        for i in range(300):
            step(i)
        saved = {name: copy.deepcopy(adam.state_dict()) for name, adam in adams.items()}
        values = {name: param.detach().clone() for name, param in params.items()}
        if same:
            step(999)
        else:
            phases, adams, params = fresh()
        for name, adam in adams.items():
            adam.load_state_dict(copy.deepcopy(saved[name]))
            with torch.no_grad():
                params[name].copy_(values[name])
        for i in range(300, 303):
            step(i)
        return params["scales"].flatten().tolist()

    assert trained(True) == trained(False)


# -- damage, and what only looks like it ---------------------------------------------------------


@pytest.mark.parametrize("value", [[1.0], None, 3.0, "text", torch.tensor(0.0)])
def test_damage_that_a_plain_adam_has_loaded_is_a_value_error(value: Any) -> None:
    saved = Training(Averaging()).run(0, 295).saved()
    saved["state"][0]["Averaging.mean"] = value
    training = Training(stock=True).load(saved)
    before = dict(training.state())
    with pytest.raises(ValueError, match=r"before the upgrade.*Averaging"):
        PhaseScheduler(TOTAL, 0.9, parts=[Averaging()]).upgrade(training.adam)
    assert type(training.adam) is Adam
    assert training.state().keys() == before.keys()


@pytest.mark.parametrize(
    "path",
    [
        ("optimizer", "records", 0, 0, "numbers", "Tally.p"),
        ("kept", "Tally.t"),
        ("kept",),
        ("windows",),
    ],
)
def test_a_number_that_is_missing_is_damage(path: tuple[Any, ...]) -> None:
    saved = Training(Tally()).run(0, 10).saved()
    store = saved["param_groups"][0]["opt3dgs"]
    for key in path[:-1]:
        store = store[key]
    del store[path[-1]]
    training = Training(Tally())
    with pytest.raises(ValueError, match=r"keys \['.*'\] are missing"):
        training.load(saved)
    assert training.phases.iteration == 0


def test_a_checkpoint_that_does_not_name_its_numbers_is_taken_as_it_is() -> None:
    saved = Training(Tally()).run(0, 10).saved()
    shared = saved["param_groups"][0]["opt3dgs"]
    shared["optimizer"]["kept"] = {}
    assert Training(Tally()).load(saved).phases.kept_numbers["Tally.t"] == 10
    del shared["kept"]["Tally.t"]
    assert Training(Tally()).load(saved).phases.kept_numbers == {}


class Count(Part):
    """Keeps whole numbers."""

    keeps = (Kept("n", shape=(), dtype=torch.int64), Kept("on", shape=(), dtype=torch.bool))

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        state["n"] += 1
        state["on"].logical_not_()
        return grad


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 2.5, 2.0**63])
@pytest.mark.parametrize("key", ["Count.n", "Count.on"])
def test_numbers_that_an_integer_cannot_hold_are_damage(key: str, value: float) -> None:
    saved = Training(Count()).run(0, 5).saved()
    saved["state"][0][key] = torch.full((ROWS,), value)
    training = Training(Count())
    with pytest.raises(ValueError, match=f"{key} has numbers that torch.* cannot hold"):
        training.load(saved)
    assert training.phases.iteration == 0


def test_whole_numbers_that_a_plain_adam_has_cast_are_taken() -> None:
    saved = Training(Count()).run(0, 5).saved()
    again = Training(Count()).load(Training(stock=True).load(saved).saved())
    assert again.state()["Count.n"].tolist() == [5] * ROWS
    assert again.state()["Count.on"].tolist() == [True] * ROWS


# -- the trainer's own names ---------------------------------------------------------------------


@pytest.mark.parametrize("part", [Averaging, Curvature])
@pytest.mark.parametrize("key", ["history", "mean_iterate", "num_averaged", "ema"])
def test_a_trainers_own_state_keeps_its_name(part: Any, key: str) -> None:
    training = Training(part()).run(0, 295)
    training.state()[key] = torch.ones(ROWS, 3)
    again = Training(part()).load(training.saved())
    assert torch.equal(again.state()[key], torch.ones(ROWS, 3))


def test_a_trainers_own_keys_of_a_group_stay() -> None:
    own = {"gaussian": "static", "faded": 3, "visible_share": "v", "fresh_since": 1}
    param = Parameter(torch.zeros(4, 3))
    adam = Adam([{"params": [param], "name": "xyz", **own}])
    PhaseScheduler(60).upgrade(adam)
    adam.load_state_dict(copy.deepcopy(adam.state_dict()))
    (group,) = adam.param_groups
    assert {key: group[key] for key in own} == {key: group.get(key) for key in own} == own


class lower(Part):  # noqa: N801 - a class of a user's
    """Keeps rows."""

    keeps = (Kept("r", shape=()),)

    def before(self, group: Any, param: Any, grad: Tensor, state: Any, course: Any) -> Tensor:
        state["r"] += 1
        return grad


class _Hidden(lower):
    pass


@pytest.mark.parametrize("part", [lower, _Hidden])
@pytest.mark.parametrize("upgraded_first", [True, False])
def test_a_part_that_is_gone_leaves_nothing_whatever_its_name(
    part: Any, upgraded_first: bool
) -> None:
    saved = Training(part()).run(0, 50).saved()
    if upgraded_first:
        without = Training(Annealing()).load(saved)
    else:
        without = Training(stock=True).load(saved)
        without.phases = PhaseScheduler(TOTAL, 0.9, parts=[Annealing()])
        without.phases.upgrade(without.adam)
    assert without.state().keys() == {"step", "exp_avg", "exp_avg_sq"}
    again = Training(part()).load(without.run(50, 60).saved())
    assert f"{part.__name__}.r" not in again.state()


@pytest.mark.parametrize("name", ["state_dict", "load_state_dict", "add_param_group"])
def test_a_method_that_somebody_has_replaced_is_refused(name: str) -> None:
    training = Training(stock=True)
    own = getattr(training.adam, name)
    setattr(training.adam, name, partial(own))
    with pytest.raises(TypeError, match=f"replaced {name} of the optimizer.*after the upgrade"):
        PhaseScheduler(TOTAL).upgrade(training.adam)
    assert type(training.adam) is Adam


class WithMethod(Adam):
    def reset_rows(self, mask: Any) -> str:
        return "the trainer's"


class WithClassAttribute(Adam):
    any_group = "the trainer's"


class WithAttribute(Adam):
    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.course = "intro"
        self._step = 0


class WithReduce(Adam):
    def __reduce__(self) -> Any:
        return object, ()


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (WithMethod, "has reset_rows, which is a name of the parts' own"),
        (WithClassAttribute, "has any_group, which"),
        (WithAttribute, "has _step, course, which"),
        (WithReduce, "whose __reduce__ a copy with parts could not keep"),
    ],
)
def test_a_class_whose_names_would_be_hidden_is_refused(kind: type[Adam], message: str) -> None:
    training = Training(stock=True, kind=kind)
    with pytest.raises(TypeError, match=message):
        PhaseScheduler(TOTAL).upgrade(training.adam)
    assert type(training.adam) is kind


def test_a_trainers_own_words_for_an_optimizer_stay() -> None:
    class Named(Adam):
        def __repr__(self) -> str:
            return "the trainer's"

    assert repr(Training(kind=Named).adam) == "the trainer's"


def test_a_parameter_takes_its_numbers_along_to_another_group() -> None:
    class Every(Tally):
        names = None

    params = [Parameter(torch.zeros(4, 3)) for _ in range(3)]
    groups = [{"params": params[:2], "name": "xyz"}, {"params": params[2:], "name": "scaling"}]
    adam: Any = Adam(groups)
    phases = PhaseScheduler(TOTAL, parts=[Every()])
    phases.upgrade(adam)

    def go() -> None:
        for _ in range(5):
            for param in params:
                param.grad = torch.ones(4, 3)
            phases.observe(0.1)
            adam.step()

    go()
    adam.param_groups[0]["params"] = [params[0]]
    adam.param_groups[1]["params"] = [params[2], params[1]]
    go()
    assert [adam.record_of(param).numbers["Every.p"].item() for param in params] == [10] * 3


def test_what_an_optimizer_says_of_a_part_that_is_off() -> None:
    training = Training(Averaging())
    training.phases.switched_off["Averaging"] = "for a test"
    for shown in (repr(training.phases), repr(training.adam)):
        assert "switched off, for a test" in shown


# -- a course by itself ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"total_steps": 0},
        {"total_steps": -5},
        {"total_steps": "x"},
        {"total_steps": 60, "switch_step": -3},
        {"total_steps": 60, "switch_step": 61},
        {"total_steps": 60, "switch_step": "x"},
        {"total_steps": 60, "adaptive": "no"},
    ],
)
def test_a_course_that_cannot_be(options: dict[str, Any]) -> None:
    name = [*options][-1]
    with pytest.raises(ValueError, match=f"Course: {name}="):
        Course([], **options)


def test_a_step_optimizer_without_a_course_says_how_it_comes_to_one() -> None:
    param = Parameter(torch.ones(4, 3))
    param.grad = torch.ones(4, 3)
    adam = StepAdam([{"params": [param], "name": "means"}])
    for act in (adam.step, adam.state_dict, lambda: repr(adam)):
        with pytest.raises(AttributeError, match=r"no parts yet: call follow\(Course"):
            act()
    adam.follow(Course([]))
    adam.step()
    with pytest.raises(AttributeError, match="has no attribute 'other'"):
        getattr(adam, "other")  # noqa: B009 - of which nothing is known


@pytest.mark.parametrize(("total", "said"), [(300, 1), (1, 0)])
def test_a_clock_that_stands_still_is_said_once(total: int, said: int) -> None:
    param = Parameter(torch.ones(4, 3))
    adam = StepAdam([{"params": [param], "name": "means"}])
    adam.follow(Course([Averaging()], total_steps=total))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(300):
            param.grad = torch.ones(4, 3)
            adam.step()
    assert sum("the clock stands still" in str(each.message) for each in caught) == said


def test_a_closed_log_is_told_before_the_clock_moves(tmp_path: Any) -> None:
    histogram, log = EnergyHistogram(warmup=4), RunLog(tmp_path / "a.jsonl")
    phases = PhaseScheduler(TOTAL, parts=[histogram], log=log)
    adam = Adam([{"params": [Parameter(torch.ones(4, 3))], "name": "means"}])
    phases.upgrade(adam)
    phases.observe(0.1)
    log.close()
    for _ in range(2):
        with pytest.raises(ValueError, match="its log is closed"):
            phases.observe(0.1)
    assert (phases.iteration, histogram.num_observed) == (1, 1)
    phases.log = None
    phases.observe(0.1)
    assert phases.iteration == 2


def ranks(monkeypatch: pytest.MonkeyPatch, *, on_gpus_only: bool) -> None:
    """`torch.distributed` of one rank."""

    def all_reduce(tensor: Tensor, group: Any = None) -> None:
        if on_gpus_only and not tensor.is_cuda:
            raise RuntimeError("No backend type associated with device type cpu")

    for name, value in {
        "is_initialized": lambda: True,
        "get_rank": lambda group=None: 0,
        "get_world_size": lambda group=None: 1,
        "all_reduce": all_reduce,
    }.items():
        monkeypatch.setattr(distributed, name, value)


def test_a_number_of_the_host_over_nccl(monkeypatch: pytest.MonkeyPatch) -> None:
    ranks(monkeypatch, on_gpus_only=True)
    with SimulatedDevice():
        param = Parameter(torch.ones(4, 3, device="cuda:0"))
        phases = PhaseScheduler(TOTAL, process_group=object())
        adam: Any = phases.upgrade(Adam([{"params": [param], "name": "means"}]))
        for _ in range(2):
            param.grad = torch.ones_like(param)
            phases.observe(0.1)
            adam.step()
        assert phases.iteration == 2


def test_a_group_that_takes_no_energy_is_told_before_the_clock_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ranks(monkeypatch, on_gpus_only=True)
    adam = Adam([{"params": [Parameter(torch.ones(4, 3))], "name": "means"}])
    phases = PhaseScheduler(TOTAL, process_group=object())
    phases.upgrade(adam)
    with pytest.raises(RuntimeError, match="No backend type"):
        phases.observe(0.1)
    assert phases.iteration == 0


def test_what_comes_out_of_a_pickle_has_no_process_group(monkeypatch: pytest.MonkeyPatch) -> None:
    ranks(monkeypatch, on_gpus_only=False)

    class Group:
        def __reduce__(self) -> Any:
            raise TypeError("cannot pickle 'ProcessGroup' object")

    phases = PhaseScheduler(TOTAL, process_group=Group())
    adam: Any = Adam([{"params": [Parameter(torch.ones(4, 3))], "name": "means"}])
    phases.upgrade(adam)
    again: Any = pickle.loads(pickle.dumps(adam))
    again.course.observe(0.1)
    assert again.course._over_ranks is None
    assert copy.deepcopy(adam).course._over_ranks is phases._over_ranks


@pytest.mark.parametrize("returned", [None, 0.5, torch.ones(2, 2), torch.ones(1)])
def test_what_a_parts_pixel_loss_returns_is_checked(returned: Any) -> None:
    class Says(Part):
        def pixel_loss(self, error: Tensor) -> Any:
            return returned

    phases = PhaseScheduler(TOTAL, parts=[Says()])
    with pytest.raises(ValueError, match=r"Says\.pixel_loss: returned .*, but a 0-d tensor"):
        phases.pixel_loss(torch.ones(2, 2), torch.zeros(2, 2))


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("files", [False, True])
@pytest.mark.parametrize("stepped", [False, True])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_numbers_take_torchs_distributed_checkpoints(
    flat: bool, files: bool, stepped: bool, tmp_path: Any
) -> None:
    """They come along, or begin anew where such files leave them out; nothing fails."""
    dcp_state = pytest.importorskip("torch.distributed.checkpoint.state_dict")
    options = dcp_state.StateDictOptions(flatten_optimizer_state_dict=flat)

    def model(training: Training) -> torch.nn.Module:
        module = torch.nn.Module()
        module.splats = torch.nn.ParameterDict(training.params)
        return module

    first = Training(Tally()).run(0, 10)
    second = Training(Tally()).run(0, 3 if stepped else 0)
    saved = dcp_state.get_optimizer_state_dict(model(first), first.adam, options=options)
    if files:
        checkpoint: Any = pytest.importorskip("torch.distributed.checkpoint")
        checkpoint.save({"optimizer": saved}, checkpoint_id=tmp_path, no_dist=True)
        mine = dcp_state.get_optimizer_state_dict(model(second), second.adam, options=options)
        checkpoint.load({"optimizer": mine}, checkpoint_id=tmp_path, no_dist=True)
        saved = mine
    for param in second.params.values():
        param.grad = None
    left_out = files and not stepped
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        dcp_state.set_optimizer_state_dict(
            model(second), second.adam, optim_state_dict=saved, options=options
        )
    assert any("Tally.t begin anew" in str(each.message) for each in said) is left_out or flat
    counted = second.run(10, 11).phases.kept_numbers["Tally.t"]
    assert (second.phases.iteration, counted) == (11, 1 if left_out else 11) or flat
