"""One step for every loss: what may leave a step out is refused, whatever it is written as."""

from __future__ import annotations

from pathlib import Path

import pytest
from running_trainers import run
from trainer_files import STEP, indent, lines_of, refusal_of, short

from opt3dgs_optim.hosts import diff


def when(condition: str, more: str = "") -> str:
    return f"if {condition}:\n{indent(STEP, ' ' * 4)}\n{indent(more, ' ' * 4)}"


ACCUMULATED = {  # lines above the loop, the end of a turn, the condition that is named
    "counter": ("n = 0", "n += 1\n" + when("n >= 2", "n = 0"), "n >= 2"),
    "plain counter": ("n = 0", "n = n + 1\n" + when("n == 2", "n = 0"), "n == 2"),
    "match": ("", f"match iteration % 2:\n    case 1:\n{indent(STEP, ' ' * 8)}", "iteration % 2"),
    "guard": (
        "",
        f"match opt:\n    case _ if iteration % 2:\n{indent(STEP, ' ' * 8)}",
        "iteration % 2",
    ),
    "expression": ("", "gaussians.optimizer.step() if iteration % 2 else None", "iteration % 2"),
    "and": ("", "iteration % 2 == 1 and gaussians.optimizer.step()", "iteration % 2 == 1"),
    "list": ("got = []", "got.append(1)\n" + when("len(got) == 2", "got.clear()"), "len(got) == 2"),
    "next due": ("due = 1", when("iteration >= due", "due += 2"), "iteration >= due"),
    "last": ("last = -1", when("iteration - last >= 2", "last = iteration"), "iteration - last"),
    "flags": ("flags = [False, True] * 4", when("flags[iteration]"), "flags[iteration]"),
    "toggle": ("on = False", when("on") + "\non = not on", "on"),
    "set": ("steps = range(0, 99, 2)", when("(iteration + 1) in steps"), "iteration + 1 in steps"),
    "helper": (
        "turns = itertools.cycle([0, 1])\ndef due():\n    return next(turns)",
        when("due()"),
        "due()",
    ),
    "iterator": ("turns = itertools.cycle([0, 1])", when("next(turns)"), "next(turns)"),
    "flag in branches": (
        "",
        "if iteration % 2:\n    on = True\nelse:\n    on = False\n" + when("on"),
        "on",
    ),
    "gap": ("", when("iteration < 2 or iteration >= 5"), "iteration < 2 or iteration >= 5"),
    "gap, negated": (
        "",
        when("not (iteration >= 2 and iteration < 5)"),
        "not (iteration >= 2 and iteration < 5)",
    ),
    "gap in the other arm": (
        "",
        f"if 2 <= iteration < 5:\n    pass\nelse:\n{indent(STEP, ' ' * 4)}",
        "not 2 <= iteration < 5",
    ),
    "gap in an or": (
        "",
        "2 <= iteration < 5 or gaussians.optimizer.step()",
        "not 2 <= iteration < 5",
    ),
    "gap in a chain": ("", when("not 2 <= iteration < 5"), "not 2 <= iteration < 5"),
    "all but one": ("", when("iteration != 3"), "iteration != 3"),
    "by a helper": (
        "on = False\ndef turn():\n    nonlocal on\n    on = not on",
        "turn()\n" + when("on"),
        "on",
    ),
    "attribute": (
        "def turn():\n    opt.on = iteration % 2 == 1",
        "turn()\n" + when("opt.on"),
        "opt.on",
    ),
}


@pytest.mark.parametrize("kind", ACCUMULATED)
def test_accumulated_gradients(tmp_path: Path, kind: str) -> None:
    above, step, condition = ACCUMULATED[kind]
    text = short(above=above, step=step)
    assert 0 < len(run(text.encode()).clock) < 8  # several losses for one step, indeed
    assert f"steps only where {condition}" in refusal_of(tmp_path, text)


@pytest.mark.parametrize(
    "condition",
    [
        "iteration < opt.iterations",
        "iteration + 1 <= opt.iterations and not torch.isnan(loss)",
        "torch.isfinite(loss).all()",
        "0 <= iteration < opt.iterations",
        "opt.iterations % 2 == 0",
        "isinstance(opt, object)",
        "iteration < opt.iterations or opt.iterations == 0",
        "not (iteration < 0 or iteration >= opt.iterations)",
    ],
)
def test_a_condition_that_changes_once(tmp_path: Path, condition: str) -> None:
    text = short(step=when(condition))
    assert "phases.observe(loss)" in lines_of(tmp_path, text)
    assert len(run(diff(tmp_path / "train.py").new).clock) == 8


def test_a_condition_with_a_name(tmp_path: Path) -> None:
    text = short(step="more = iteration < opt.iterations\n" + when("more"))
    assert "phases.observe(loss)" in lines_of(tmp_path, text)


def test_a_condition_around_the_loss_too(tmp_path: Path) -> None:
    body = f"if iteration % 2:\n    loss.backward()\n{indent(STEP, ' ' * 4)}"
    lines = lines_of(tmp_path, short(backward=body, step=""))
    assert "phases.observe(loss, iteration=iteration)" in lines


def test_a_step_in_each_arm(tmp_path: Path) -> None:
    text = short(step=when("loss > 3") + f"\nelse:\n{indent(STEP, ' ' * 4)}")
    assert "phases.observe(loss)" in lines_of(tmp_path, text)


@pytest.mark.parametrize("manager", ["accelerator.accumulate(net)", "model.no_sync()"])
def test_a_manager_that_accumulates(tmp_path: Path, manager: str) -> None:
    body = f"with {manager}:\n    loss.backward()\n{indent(STEP, ' ' * 4)}"
    said = refusal_of(tmp_path, short(backward=body, step=""))
    assert f"steps only where {manager}" in said


def test_a_property_decides(tmp_path: Path) -> None:
    top = "class Due:\n    @property\n    def due(self):\n        return next(turns)\n\n\n"
    top += "turns = itertools.cycle([0, 1])"
    text = short(top=top, above="my = Due()", step=when("my.due"))
    assert len(run(text.encode()).clock) == 4
    assert "steps only where my.due" in refusal_of(tmp_path, text)


def test_an_error_after_the_loss(tmp_path: Path) -> None:
    body = "try:\n    loss.backward()\n    if iteration % 2 == 0:\n        raise KeyError\n"
    text = short(backward=f"{body}except KeyError:\n    continue")
    assert "`continue` between loss.backward()" in refusal_of(tmp_path, text)


def test_a_count_that_is_another_at_the_step(tmp_path: Path) -> None:
    step = f"for iteration in range(3, 10, 3):\n    pass\n{when('iteration < opt.iterations')}"
    assert "steps only where iteration < opt.iterations" in refusal_of(tmp_path, short(step=step))
