"""A part of a stranger's, fifteen lines: it keeps something, and not one line is about how.

It is run in two instances, through a resume into a longer run, in bfloat16, with masks, and with
steps that are dropped on a GPU (`simulated_device`); the package does the rest.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from placed_training import GPU, ROWS, VIEWS, Training, distance, some_of
from simulated_device import SimulatedDevice
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import Kept, Part, Phase, PhaseScheduler


class Cautious(Part):
    """Steps are shorter, the more often a point's gradient has turned."""

    names = ("means", "sh0")
    keeps = (
        Kept("turns", shape=()),
        Kept("before"),
        Kept("steps", per="parameter"),
        Kept("seen", per="training"),
    )

    def __init__(self, caution: float = 0.1) -> None:
        self.caution = caution

    def before(self, group: Any, param: Tensor, grad: Tensor, state: Any, course: Any) -> Tensor:
        state["turns"] += (grad * state["before"] < 0).reshape(len(param), -1).any(1)
        state["before"] = grad
        state["steps"] += 1
        state["seen"] += (grad != 0).any()
        slower = 1 / (1 + self.caution * state["turns"] / state["steps"])
        return grad * slower.reshape(-1, *[1] * (grad.dim() - 1)).to(grad.dtype)


TOTAL, SWITCH, LONGER = 40, 30, 100
FUSED = {"adam": {"fused": True}}


def one(training: Any) -> list[Part]:
    return [Cautious()]


def two(training: Any) -> list[Part]:
    return [Cautious(), Cautious(3.0)]


def begun(parts: Any, total: int = TOTAL, **options: Any) -> Training:
    return Training(parts, total=total, switch=SWITCH, **options)


def kept(training: Training, name: str) -> dict[str, Tensor]:
    """What all instances keep under a name, by "PARAMETER.PART.NAME"."""
    return {key: v for key, v in training.kept().items() if key.split(".")[-1] == name}


def test_it_keeps_a_number_for_each_point() -> None:
    training = begun(one).run()
    turns = kept(training, "turns")
    assert len(turns) == 2  # of the means and of the colours
    for each in turns.values():
        assert each.shape == (ROWS,)
        assert each.dtype == torch.float32
        assert 0 < float(each.max()) < TOTAL


def test_two_instances_do_not_share() -> None:
    """They act on one gradient, the second on what the first has made of it."""
    training = begun(two).run()
    assert len(kept(training, "turns")) == 4
    assert distance(training.values(), begun(one).run().values()) > 0.0


@pytest.mark.parametrize("parts", [one, two])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float64])
def test_it_is_resumed_into_a_longer_run(parts: Any, dtype: torch.dtype) -> None:
    """It has no phase, and so no window: what it keeps is of the training, however long."""
    options: dict[str, Any] = {"dtype": dtype, "adam": {"eps": 1e-4}}
    first = begun(parts, **options).run()
    resumed = begun(parts, LONGER, **options).resume(first)
    for name in ("turns", "before"):
        saved, loaded = kept(first, name), kept(resumed, name)
        assert set(saved) == set(loaded)
        assert all(torch.equal(saved[key], loaded[key]) for key in saved)
        assert all(saved[key].dtype == loaded[key].dtype for key in saved)
    whole = begun(parts, LONGER, **options).run()
    assert distance(resumed.run().values(), whole.values()) == 0.0


def test_rows_that_a_mask_holds_still_keep_theirs() -> None:
    training = begun(one, masked=True)
    for view in range(VIEWS):
        before = kept(training, "turns") | kept(training, "before")
        training.run(view + 1)
        seen = training.views[view]["means"][2]
        after = kept(training, "turns") | kept(training, "before")
        for key in before:
            assert torch.equal(after[key][~seen], before[key][~seen]), key


@pytest.mark.parametrize("parts", [one, two])
@pytest.mark.parametrize("masked", some_of([False, True], bool))
@pytest.mark.parametrize(
    "dropped", [{0}, {7, 8, 9}, {SWITCH}, {TOTAL - 1}, set(range(0, TOTAL, 3))]
)
def test_dropped_steps_leave_no_trace(parts: Any, masked: bool, dropped: set[int]) -> None:
    options: dict[str, Any] = {"dropped": dropped, "masked": masked}
    with SimulatedDevice():
        there = begun(parts, places=GPU, loss_on=GPU, **options).run()
    here = begun(parts, **FUSED, **options).run()
    left_out = begun(parts, **FUSED, **options, skips=True).run()
    assert there.waits == {}
    for other in (here, left_out):
        assert distance(there.values(), other.values()) == 0.0
        found, expected = there.kept(), other.kept()
        assert set(found) == set(expected)
        assert [key for key in found if not torch.equal(found[key], expected[key])] == []


class Total(Part):
    """Counts the steps of all parameters in the last phase, in tenths."""

    names, during, keeps = None, Phase.EXPLOITATION, (Kept("steps", per="training"),)

    def before(self, group, param, grad, state, course):
        state["steps"] += 0.1
        return grad


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("late", [(), ("scales",)])
@pytest.mark.parametrize("cut", [None, 55, 65])
def test_a_number_per_training_is_all_optimizers(
    dtype: torch.dtype, late: tuple[str, ...], cut: int | None
) -> None:
    """One that steps for the first time late in the window forgets nothing; nor does a resume."""
    expected = torch.zeros((), dtype=dtype)
    params = {k: Parameter(torch.ones(4, 3, dtype=dtype)) for k in ("means", "scales", "quats")}

    def begin() -> tuple[PhaseScheduler, Any]:
        phases = PhaseScheduler(100, 50, parts=[Total()])
        return phases, phases.upgrade({k: torch.optim.Adam([p]) for k, p in params.items()})

    phases, adams = begin()
    for i in range(70):
        if i == cut:
            saved = {k: adam.state_dict() for k, adam in adams.items()}
            phases, adams = begin()
            for k, adam in adams.items():
                adam.load_state_dict(saved[k])
        phases.observe(0.1)
        for k, adam in adams.items():
            if k not in late or i == 69:
                params[k].grad = torch.ones_like(params[k])
                adam.step()
                expected = expected + 0.1 if i >= 50 else expected
    found = phases.kept_numbers["Total.steps"]
    assert found.dtype == dtype
    assert found.item() == expected.item()


def test_an_exception_in_a_masked_step_leaves_nothing_to_undo() -> None:
    part = Stumbling()
    param = Parameter(torch.zeros(4, 3))
    phases = PhaseScheduler(300, parts=[part])
    adam: Any = phases.upgrade(torch.optim.Adam([{"params": [param], "name": "xyz"}]))

    def step(*mask: Tensor) -> None:
        param.grad = torch.ones_like(param)
        phases.observe(0.1)
        adam.step(*mask)

    mask = torch.tensor([True, True, False, False])
    step()
    part.stumbles = True
    with pytest.raises(KeyboardInterrupt):
        step(mask)
    part.stumbles = False
    for _ in range(5):
        step()
    before = adam.state[param]["Stumbling.visits"].clone()
    step(mask)
    assert (adam.state[param]["Stumbling.visits"] - before).tolist() == [1.0, 1.0, 0.0, 0.0]


class Stumbling(Part):
    """Is interrupted in the middle of a step, as in a notebook."""

    names, keeps, stumbles = ("means",), (Kept("visits", shape=()),), False

    def before(self, group, param, grad, state, course):
        state["visits"] += 1
        if self.stumbles:
            raise KeyboardInterrupt
        return grad


def test_its_numbers_per_parameter_count_the_steps_that_count() -> None:
    """And what is kept per training is saved with it, once."""
    dropped = {3, 4, 20}
    first = begun(one, dropped=dropped).run()
    second = begun(one).resume(first)
    slowed = []
    for training in (first, second):
        state: Any = training.optimizers["means"].state_dict()
        slowed.append(training.phases.iteration)
        assert state["state"][0]["Cautious.turns"].shape == (ROWS,)
    assert slowed == [TOTAL, TOTAL]
