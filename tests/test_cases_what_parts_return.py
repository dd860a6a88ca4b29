"""What a stranger's part returns is looked at before it is used, and the hook is named."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from trainers import (
    assert_same,
    begun,
    gsplat_optimizers,
    make_splats,
    only,
    train,
    upgraded,
    values_of,
)

from opt3dgs_optim import DEFAULTS, Fading, Kept, Part, PhaseScheduler, RunLog
from opt3dgs_optim.course import Course
from opt3dgs_optim.runs import read_run

TOTAL = 100


class Fed(Part):
    """Adam is fed what the test says."""

    def __init__(self, made: Any) -> None:
        self.made = made

    def before(self, group: Any, param: Tensor, grad: Tensor, state: Any, course: Any) -> Any:
        return self.made(grad)


class Moved(Fed):
    before = Part.before

    def displacement(self, group: Any, param: Tensor, step: Tensor, state: Any, course: Any) -> Any:
        return self.made(step)


class Multiplied(Fed):
    before = Part.before

    def factor(self, group: Any, course: Any) -> Any:
        return self.made(None)


@pytest.mark.parametrize("others", [(), DEFAULTS], ids=["alone", "before others"])
@pytest.mark.parametrize("kind", [Fed, Moved])
@pytest.mark.parametrize(
    ("made", "got"),
    [
        (lambda x: x.to_sparse(), "a tensor of torch.float32 and torch.sparse"),
        (lambda x: x * 1j, "a tensor of torch.complex64"),
        (lambda _: None, "None"),
        (lambda x: x[:4], "a tensor of shape (4"),
        (lambda _: 1.0, "1.0"),
    ],
    ids=["sparse", "complex", "nothing", "other rows", "a number"],
)
def test_a_hook_that_returns_no_tensor_of_its_shape(
    kind: Any, made: Any, got: str, others: tuple[Part, ...]
) -> None:
    splats, phases, optimizers = upgraded(TOTAL, kind(made), *others)
    before = values_of(splats)
    phases.observe(0.1)
    splats["means"].grad = torch.ones_like(splats["means"])
    hook = "before" if kind is Fed else "displacement"
    with pytest.raises(ValueError, match=re.escape(f"{kind.__name__}.{hook}: returned {got}")):
        optimizers["means"].step()
    assert_same(splats, before)


@pytest.mark.parametrize(
    "made",
    [
        *(float("nan"), float("inf"), "1", torch.ones(2), [1.0]),
        *(torch.tensor(float("nan")), torch.tensor(-float("inf")), torch.tensor(1j)),
    ],
)
def test_a_factor_that_is_no_number(made: Any) -> None:
    splats, phases, optimizers = upgraded(TOTAL, Multiplied(lambda _: made))
    before, rate = values_of(splats), optimizers["means"].param_groups[0]["lr"]
    phases.observe(0.1)
    splats["means"].grad = torch.ones_like(splats["means"])
    with pytest.raises(ValueError, match=r"Multiplied\.factor: .* a finite number is needed"):
        optimizers["means"].step()
    assert_same(splats, before)
    assert optimizers["means"].param_groups[0]["lr"] == rate


@pytest.mark.parametrize("made", [2, 0.5, np.float32(0.5), torch.tensor(0.5), torch.ones(1), None])
def test_a_factor_may_be_any_number(made: Any) -> None:
    splats, phases, optimizers = upgraded(TOTAL, Multiplied(lambda _: made))
    phases.observe(0.1)
    splats["means"].grad = torch.ones_like(splats["means"])
    optimizers["means"].step()


class Windowed(Part):
    """Counts its steps of a window, in all that a part can keep."""

    keeps = (
        Kept("rows", shape=()),
        Kept("steps", per="parameter"),
        Kept("all", per="training"),
    )

    def __init__(self, window: Any) -> None:
        self.given = window

    def window(self, course: Any) -> Any:
        return self.given

    def after(self, group: Any, param: Tensor, state: Any, course: Any) -> None:
        for name in ("rows", "steps", "all"):
            state[name] += 1


def steps(splats: Any, phases: Any, optimizers: Any, count: int) -> list[float]:
    means = splats["means"]
    for _ in range(count):
        means.grad = torch.ones_like(means)
        phases.observe(0.1)
        optimizers["means"].step()
    state, record = optimizers["means"].state[means], optimizers["means"]._records[0][0]
    rows, kept = state["Windowed.rows"], record.numbers["Windowed.steps"]
    return [float(rows[0]), float(kept), float(phases.kept_numbers["Windowed.all"])]


@pytest.mark.parametrize(
    "window",
    [(10, 90), [10, 90], (0.1 * TOTAL, 90), (np.int64(10), np.int32(90)), (10, np.float64(90.0))],
    ids=str,
)
def test_a_window_of_any_whole_numbers_is_resumed(window: Any, tmp_path: Any) -> None:
    splats, phases, optimizers = upgraded(TOTAL, Windowed(window))
    assert steps(splats, phases, optimizers, 30) == [20.0] * 3
    torch.save(optimizers["means"].state_dict(), tmp_path / "saved.pt")
    again = only(TOTAL, Windowed(window))
    copied = {name: torch.nn.Parameter(value) for name, value in values_of(splats).items()}
    resumed = again.upgrade(gsplat_optimizers(copied))
    resumed["means"].load_state_dict(torch.load(tmp_path / "saved.pt", weights_only=True))
    assert steps(copied, again, resumed, 1) == [21.0] * 3


@pytest.mark.parametrize(
    "window",
    [5, (10,), (10, None), (90, 10), (0.5, 10), (1, 2, 3), "ab", (float("nan"), 1)],
    ids=str,
)
def test_a_window_that_is_none_is_refused_at_once(window: Any) -> None:
    with pytest.raises(ValueError, match=r"Windowed\.window: .* two iterations"):
        PhaseScheduler(TOTAL, parts=[Windowed(window)])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"initial": 1.0}, "rows begin as zeros"),
        ({"shape": 3}, "a tuple of the dimensions"),
    ],
)
def test_what_cannot_be_kept_is_refused_where_it_is_declared(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        Kept("mine", **options)


class Undeclared(Part):
    def after(self, group: Any, param: Tensor, state: Any, course: Any) -> None:
        state["mine"] = 1


class ReadsUndeclared(Part):
    def after(self, group: Any, param: Tensor, state: Any, course: Any) -> None:
        state["mine"].add_(1)


@pytest.mark.parametrize("kind", [Undeclared, ReadsUndeclared])
def test_what_is_not_declared_is_called_so(kind: Any) -> None:
    splats, phases, optimizers = upgraded(TOTAL, kind())
    phases.observe(0.1)
    splats["means"].grad = torch.ones_like(splats["means"])
    with pytest.raises(KeyError, match=rf"{kind.__name__} does not declare 'mine' in keeps"):
        optimizers["means"].step()


class Says(Part):
    def __init__(self, said: Any) -> None:
        self.said = said

    def numbers(self, course: Any) -> Any:
        return self.said


@pytest.mark.parametrize(
    "said", [{"a": torch.ones(2)}, {"a": "1"}, {"a": None}, {"metadata": 1.0}, ["a"]], ids=str
)
def test_numbers_that_are_none_name_their_part(said: Any) -> None:
    phases = PhaseScheduler(TOTAL, parts=[Says(said)])
    phases.upgrade(gsplat_optimizers(make_splats()))
    with pytest.raises(ValueError, match=r"Says\.numbers: "):
        phases.numbers()


def test_two_parts_of_one_class_have_columns_of_their_own(tmp_path: Any) -> None:
    parts = [Fading(events=25, start=0.0, stop=0.1), Fading(events=25, start=0.5, stop=0.6)]
    with RunLog(tmp_path / "log.jsonl") as log:
        phases = PhaseScheduler(TOTAL, parts=parts, log=log)
        splats, optimizers = begun(phases)
        train(splats, optimizers, phases, 0, TOTAL)
    columns = read_run(tmp_path / "log.jsonl").steps
    assert columns["faded"][:10].any()
    assert not columns["faded"][20:].any()
    assert columns["faded#2"][50:60].any()
    assert not columns["faded#2"][:40].any()


class FailsOnce(Windowed):
    failing = True

    def after(self, group: Any, param: Tensor, state: Any, course: Any) -> None:
        super().after(group, param, state, course)
        if self.failing:
            self.failing = False
            raise RuntimeError("a stranger's")


def test_columns_of_one_name_of_parts_of_two_classes() -> None:
    class Speed(Part):
        def numbers(self, course: Course) -> dict[str, float]:
            return {"pace": 1.0}

    class Motion(Part):
        def numbers(self, course: Course) -> dict[str, float]:
            return {"pace": 2.0}

    assert Course([Speed(), Motion()]).numbers() == {"pace": 1.0, "Motion.pace": 2.0}


def test_a_step_that_a_part_has_ended_leaves_nothing_saved() -> None:
    splats, phases, optimizers = upgraded(TOTAL, part := FailsOnce(None))
    means, rows = splats["means"], torch.arange(len(splats["means"])) < 5
    means.grad = torch.ones_like(means)
    phases.observe(0.1)
    with pytest.raises(RuntimeError, match="a stranger's"):
        optimizers["means"].step(visible=rows)
    phases.observe(0.1)
    optimizers["means"].step()
    view = optimizers["means"]._records[0][0]._view
    assert not part.failing
    assert not view._guarded
    assert view._saved == []
