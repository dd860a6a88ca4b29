"""A loop that is left before its range is over has no number of iterations to read."""

from __future__ import annotations

from pathlib import Path

import pytest
from running_trainers import run
from trainer_files import STEP, indent, lines_of, refusal_of, short

LEFT = {  # lines above the loop, the end of a turn, the condition that is named
    "flag": (
        "done = False",
        "if iteration >= 7:\n    done = True\nif done:\n    break",
        "done",
    ),
    "flag of a flag": (
        "near = done = False",
        "if near:\n    done = True\nnear = iteration >= 6\nif done:\n    break",
        "done",
    ),
    "length": ("seen = []", "seen.append(1)\nif len(seen) >= 8:\n    break", "len(seen) >= 8"),
    "match": ("", "match iteration:\n    case 7:\n        break", "iteration"),
    "plain counter": ("n = 0", "n = n + 1\nif n >= 8:\n    break", "n >= 8"),
    "walrus": ("n = 0", "if (n := n + 1) >= 8:\n    break", "(n := (n + 1)) >= 8"),
    "data": (
        "views = iter(loader)\nnext(views)",
        "try:\n    next(views)\nexcept StopIteration:\n    break",
        "the data are over",
    ),
    "no more data": (
        "views = iter(loader)\nnext(views)",
        "view = next(views, None)\nif view is None:\n    break",
        "view is None",
    ),
    "stack": ("left = list(range(8))", "left.pop()\nif not left:\n    break", "not left"),
    "time": (
        "import time\nstart = time.time()",
        "if time.time() - start > 60 or iteration == 7:\n    break",
        "time.time() - start > 60",
    ),
    "item": (
        "state = {}",
        "state['done'] = False\nif iteration >= 7:\n    state['done'] = True\n"
        "if state['done']:\n    break",
        "state['done']",
    ),
    "helper": (
        "def over():\n    return iteration == 7",
        "if over():\n    break",
        "over()",
    ),
}


@pytest.mark.parametrize("kind", LEFT)
def test_a_break_before_the_end_of_the_range(tmp_path: Path, kind: str) -> None:
    above, end, condition = LEFT[kind]
    text = short(above=above, over="range(100)", step=f"{STEP}\n{end}")
    assert len(run(text.encode()).clock) == 8
    assert f"the loop over range(100) is left where {condition}" in refusal_of(tmp_path, text)


@pytest.mark.parametrize(
    ("top", "leave"),
    [
        ("", "raise SystemExit"),
        ("", "sys.exit()"),
        ("class Done(Exception):\n    pass", "raise Done()"),
        ("from elsewhere import Done", "raise Done"),
    ],
)
def test_an_exception_that_ends_the_training(tmp_path: Path, top: str, leave: str) -> None:
    text = short(top=top, over="range(100)", step=f"{STEP}\nif iteration == 7:\n    {leave}")
    text = text.replace("\n\n\ntraining(opt)", "\n\n\ntry:\n    training(opt)\nexcept Done: pass")
    assert "is left where iteration == 7" in refusal_of(tmp_path, text)


@pytest.mark.parametrize(
    "end",
    [
        "if not torch.isfinite(loss):\n    break",
        "loss += 0\nif loss.isnan().any():\n    break",
        "for view in loader:\n    if iteration == view:\n        break",
        "try:\n    pass\nexcept ValueError:\n    raise",
    ],
)
def test_what_ends_no_training(tmp_path: Path, end: str) -> None:
    """A loss that is not finite, and the end of another loop."""
    lines = lines_of(tmp_path, short(step=f"{STEP}\n{end}"))
    assert lines[0] == "phases = PhaseScheduler(opt.iterations)"


def test_a_handler_in_the_loop_ends_nothing(tmp_path: Path) -> None:
    step = f"try:\n{indent(STEP, ' ' * 4)}\nexcept ValueError:\n    pass"
    more = "\nif iteration == 99:\n    raise ValueError"
    assert "phases = PhaseScheduler(opt.iterations)" in lines_of(tmp_path, short(step=step + more))


def test_an_end_in_every_turn(tmp_path: Path) -> None:
    said = refusal_of(
        tmp_path, short(step=f"{STEP}\nfor view in loader:\n    pass\nelse:\n    break")
    )
    assert "is left where nothing is asked" in said


def test_an_exception_of_a_helper(tmp_path: Path) -> None:
    top = "class Done(Exception):\n    pass\n\n\ndef check(i):\n    if i == 7:\n        raise Done"
    said = refusal_of(tmp_path, short(top=top, step=f"{STEP}\ncheck(iteration)"))
    assert "is left where check raises this" in said
