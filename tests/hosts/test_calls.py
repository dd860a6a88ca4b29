"""A function that trains with optimizers of others runs once, whoever calls it."""

from __future__ import annotations

from pathlib import Path

import pytest
from trainer_files import lines_of, refusal_of

TRAINS = """\
import torch
from trainer import *


def training(gaussians, stage=0):
{setup}    for iteration in range(8):
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()


gaussians = GaussianModel()
gaussians.training_setup(opt)
{call}
"""
SET_UP = "    gaussians.training_setup(opt)\n"
STAGES = "for stage in range(2):\n    training(gaussians, stage)"


@pytest.mark.parametrize(
    "call",
    [
        "again = training\nagain(gaussians)\nagain(gaussians)",
        "list(map(training, [gaussians] * 2))",
        "stage = functools.partial(training, gaussians)\nstage()\nstage()",
        "for stage in [training, training]:\n    stage(gaussians)",
        "pool.starmap(training, stages)",
    ],
)
def test_a_function_with_another_name(tmp_path: Path, call: str) -> None:
    said = refusal_of(tmp_path, TRAINS.format(setup="", call=call))
    assert "training trains, and may be called several times by way of" in said


@pytest.mark.parametrize(
    "call", ["launch(training)", "spawn(target=training)", "training(gaussians)", SET_UP.strip()]
)
def test_a_function_that_is_called_once(tmp_path: Path, call: str) -> None:
    lines = lines_of(tmp_path, TRAINS.format(setup="", call=call))
    assert "phases = PhaseScheduler(8)" in lines


@pytest.mark.parametrize(
    "setup",
    ["    if stage == 0:\n        gaussians.training_setup(opt)\n", ""],
)
def test_stages_with_the_same_optimizers(tmp_path: Path, setup: str) -> None:
    said = refusal_of(tmp_path, TRAINS.format(setup=setup, call=STAGES))
    assert "is called in a loop" in said


@pytest.mark.parametrize(
    "setup",
    [
        SET_UP,
        "    if stage:\n        gaussians.training_setup(1)\n    else:\n"
        "        gaussians.training_setup(2)\n",
    ],
)
def test_stages_that_begin_anew(tmp_path: Path, setup: str) -> None:
    lines = lines_of(tmp_path, TRAINS.format(setup=setup, call=STAGES))
    assert "phases = PhaseScheduler(8)" in lines


METHOD = """\
import torch
from trainer import *


class Runner:
    def __init__(self):
        self.optimizers = make_optimizers()

    def {name}(self):
        for i in range(8):
            loss = loss_of()
            loss.backward()
            for o in self.optimizers.values():
                o.step()


class App:
    def __init__(self):
        self.runner = {made}

    def main(self):
        for stage in range(2):
            self.runner.{name}()
"""


@pytest.mark.parametrize(
    ("name", "made", "reason"),
    [
        ("stage", "Runner()", "is called in a loop"),
        ("stage", "load()", "is called in a loop"),
        ("train", "Runner()", "is called in a loop"),
        ("train", "Network()", ""),  # which has a method of this name too
    ],
)
def test_a_trainer_in_an_attribute(tmp_path: Path, name: str, made: str, reason: str) -> None:
    text = METHOD.format(name=name, made=made)
    if reason:
        assert reason in refusal_of(tmp_path, text)
    else:
        assert "phases = PhaseScheduler(8)" in lines_of(tmp_path, text)


def test_a_method_with_another_name(tmp_path: Path) -> None:
    text = METHOD.format(name="stage", made="None").replace(
        "            self.runner.stage()", "            pass"
    )
    text = text.replace(
        "class App", "    def all(self):\n        f = self.stage\n        f()\n\n\nclass App"
    )
    assert "may be called several times by way of" in refusal_of(tmp_path, text)
