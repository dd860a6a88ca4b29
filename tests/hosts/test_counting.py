"""The number of iterations is that of the whole training, and the count begins where it does."""

from __future__ import annotations

from pathlib import Path

import pytest
from running_trainers import run
from trainer_files import lines_of, refusal_of, short

from opt3dgs_optim.hosts import diff

REST = {  # lines above the loop, and what it goes over
    "from one on": ("first = 3", "range(1, opt.iterations - first + 1)"),
    "subtracted later": ("left = 8\nif opt.accum:\n    left -= opt.accum", "range(left)"),
    "a name subtracted": ("first, left = 3, opt.iterations\nleft -= first", "range(left)"),
    "in a tuple": ("first, left = 3, opt.iterations - opt.accum", "range(left)"),
    "an attribute": ("opt.left = opt.iterations - opt.accum", "range(opt.left)"),
    "an attribute subtracted": ("opt.left = 8\nopt.left -= opt.accum", "range(1, opt.left + 1)"),
    "a bar that goes on": ("left = int(5)", "tqdm(range(left), initial=3)"),
    "a bar with a name": ("left = int(5)\nbar = tqdm(range(left), initial=3)", "bar"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REST)
def test_the_rest_of_a_training(tmp_path: Path, kind: str) -> None:
    above, over = REST[kind]
    text = short(above=above, over=over)
    assert run(text.encode()).clock
    assert "may be the rest of a training" in refusal_of(tmp_path, text)


def test_the_rest_in_an_attribute_of_another_method(tmp_path: Path) -> None:
    text = (
        "import torch\n\n\nclass Runner:\n    def __init__(self, first):\n"
        "        self.left = 8 - first\n\n    def train(self):\n"
        "        for i in range(self.left):\n            loss = loss_of()\n"
        "            loss.backward()\n            self.optimizer.step()\n"
    )
    assert "may be the rest of a training" in refusal_of(tmp_path, text)


@pytest.mark.parametrize("initial", ["initial=first", "initial=0"])
def test_a_bar_over_the_whole_range(tmp_path: Path, initial: str) -> None:
    over = "tqdm(range(first, opt.iterations), INITIAL)".replace("INITIAL", initial)
    lines = lines_of(tmp_path, short(above="first = int(3)", over=over))
    assert "phases.observe(loss, iteration=iteration)" in lines


CHANGED = {
    "shuffled": ("order = list(range(8))\nimport random\nrandom.shuffle(order)", "order"),
    "grown": ("order = list(range(4))\norder.extend(range(4))", "order"),
    "an item": ("order = list(range(8))\norder[0] = 7", "order"),
    "another name": ("order = list(range(8))\nother = order\nother.reverse()", "order"),
    "an option": ("bar = tqdm(range(opt.iterations))\nopt.iterations = 3", "bar"),
    "an item of options": ("cfg = dict(n=8)\nbar = tqdm(range(cfg['n']))\ncfg['n'] = 3", "bar"),
    "a size": ("rows = [0] * 8\nbar = tqdm(range(len(rows)))\nrows.pop()", "bar"),
    "a size by a function": ("rows = [0] * 8\nbar = tqdm(range(len(rows)))\nclear(rows)", "bar"),
    "by name": ("bar = tqdm(range(opt.iterations))\nsetattr(opt, 'iterations', 3)", "bar"),
}


@pytest.mark.parametrize("kind", CHANGED)
def test_a_range_that_changes_above_the_loop(tmp_path: Path, kind: str) -> None:
    above, over = CHANGED[kind]
    said = refusal_of(tmp_path, short(above=above, over=over))
    assert "may be changed here" in said or "changes here, between the range" in said


def test_a_bar_that_is_described(tmp_path: Path) -> None:
    above = "bar = tqdm(range(opt.iterations))\nbar.set_description('training')\nprint(len(bar))"
    assert "phases.observe(loss)" in lines_of(tmp_path, short(above=above, over="bar"))


BEGINS = {  # lines above the function, above the loop, the range, its first count and its end
    "a global": (
        "start = 0\n\n\ndef load():\n    global start\n    start = 3\n\n\nload()",
        "",
        "range(start, 8)",
    ),
    "of the function around": (
        "",
        "start = 0\ndef load():\n    nonlocal start\n    start = 3\nload()",
        "range(start, 8)",
    ),
    "below zero": ("", "last = -1", "range(last + 1, 8 + 1)"),
    "below zero, added": ("", "last = -1\nlast += 1", "range(last, 8 + 1)"),
    "added in another arm": (
        "",
        "first = 0\nif opt.accum == 3:\n    first += 1",
        "range(first, 8 + 1)",
    ),
}


@pytest.mark.parametrize("kind", BEGINS)
def test_the_first_iteration_is_counted_as_it_is(tmp_path: Path, kind: str) -> None:
    top, above, over = BEGINS[kind]
    text = short(top=top, above=above, over=over)
    assert "phases.observe(loss, iteration=iteration)" in lines_of(tmp_path, text)
    total = 9 if "+ 1)" in over else 8
    edited = run(diff(tmp_path / "train.py").new)
    counts = [count for count, _ in edited.clock]
    assert [said and said[1] - said[0] for said in edited.scheduled] == [total - n for n in counts]
