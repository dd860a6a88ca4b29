"""Whatever shape a training loop has: `hosts diff` makes the right edit, or refuses with a line."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from random_trainers import (
    AROUND,
    BODIES,
    FIRSTS,
    LASTS,
    OTHER_LOOPS,
    OTHER_WHILES,
    OVER,
    STEPS,
    WHERE,
    Shape,
    run,
)

from opt3dgs_optim.hosts import diff

# With these a refusal is the only right answer: no edit would give the trainer's own clock.
IMPOSSIBLE = {
    "body": {"micro", "retries", "sometimes", "one arm", "two losses", "closure"},
    "step": {"every second", "named", "continues", "twice", "inner", "counted", "leaves"},
    "around": {"epochs", "while"},
    "where": {"repeated method", "called twice", "called in a loop"},
}


def must_refuse(shape: Shape) -> bool:
    """Whether no edit can be right, by the options of a shape alone."""
    wrong = {option for option, values in IMPOSSIBLE.items() if getattr(shape, option) in values}
    if shape.set_up:  # every call makes optimizers of its own
        wrong.discard("where")
    return bool(wrong) or shape.other != ""


def check(shape: Shape, folder: Path) -> bool:
    """Edit and run; whether it was edited. AssertionError where the edit is wrong."""
    path = folder / "train.py"
    path.write_text(shape.script())
    new, refused = None, ""
    try:
        new = diff(path).new
    except ValueError as error:
        refused = str(error)
    if new is None:
        assert re.match(r"line \d+: .{20,}", refused)
        return False
    assert not must_refuse(shape), new.decode()
    stock, edited = run(path.read_bytes()), run(new)
    trained = [event for event in edited.events if event[0] not in ("observe", "total")]
    assert trained == stock.events
    check_clock(edited.events, shape.end)
    return True


def check_clock(events: list[tuple[str, int]], end: int) -> None:
    """The scheduler is as far from its end as the trainer is from its own, in every iteration."""
    total, count, observed = 0, 0, None
    for kind, value in events:
        if kind == "total":
            total = value
        elif kind == "saw":
            count, observed = value, None
        elif kind == "observe":
            observed = value
            assert 0 <= value < total
        elif kind == "step":
            assert observed is not None, "a step without a loss of its own"
            assert total - observed == end - count
            observed = None


def chosen(options: dict[str, str], name: str) -> st.SearchStrategy[str]:
    """An option: each of the possible ones, more often than one that must be refused."""
    wrong = IMPOSSIBLE.get(name, set())
    return st.sampled_from([k for k in options if k not in wrong] * 3 + [*options])


@st.composite
def shapes(draw: st.DrawFn) -> Shape:
    """Any shape."""
    start = draw(st.integers(0, 5))
    first = draw(st.sampled_from([*FIRSTS]))
    if first in ("incremented", "sum"):
        start = max(start, 1)
    other = draw(st.sampled_from(["", "", "", *OTHER_LOOPS, *OTHER_WHILES]))
    return Shape(
        first=first,
        last=draw(st.sampled_from([*LASTS])),
        over=draw(st.sampled_from([*OVER])),
        body=draw(chosen(BODIES, "body")),
        step=draw(chosen(STEPS, "step")),
        around=draw(chosen(AROUND, "around")),
        where=draw(chosen(WHERE, "where")),
        start=start,
        end=start + draw(st.integers(4, 9)),
        stride=draw(st.sampled_from([1, 1, 2, 3])),
        other=other,
        name=draw(st.sampled_from(["iteration", "step", "phases", "i"])),
        set_up=draw(st.booleans()),
    )


@pytest.mark.thorough
@settings(
    max_examples=400,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(shape=shapes())
def test_the_clock_is_the_trainers_own(tmp_path: Path, shape: Shape) -> None:
    check(shape, tmp_path)


@pytest.mark.parametrize("option", ["first", "last", "over", "body", "step", "around", "where"])
def test_each_shape_alone_is_edited_unless_it_cannot_be(tmp_path: Path, option: str) -> None:
    """A reader that refuses everything would pass the property above."""
    values = {
        "first": FIRSTS,
        "last": LASTS,
        "over": OVER,
        "body": BODIES,
        "step": STEPS,
        "around": AROUND,
        "where": WHERE,
    }[option]
    for value in values:
        for start, stride in ((0, 1), (3, 1), (1, 3)):
            shape = replace(Shape(start=start, end=start + 8, stride=stride), **{option: value})
            if value in ("incremented", "sum") and start == 0:
                continue
            if value == "recounts" and start == 0:
                continue  # counted by the calls, which is as right as a refusal
            edited = check(shape, tmp_path)
            if value == "recounts":
                assert not edited
                continue
            assert edited != must_refuse(shape), f"{shape}\n{shape.script()}"


@pytest.mark.parametrize("loop", [*OTHER_LOOPS, *OTHER_WHILES])
def test_what_no_number_can_be_read_from_is_refused(tmp_path: Path, loop: str) -> None:
    assert not check(Shape(other=loop), tmp_path)
