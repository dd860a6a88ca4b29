"""What is observed is the loss, once an iteration, and nothing else that has a `backward`."""

from __future__ import annotations

from pathlib import Path

import pytest
from running_trainers import run
from trainer_files import STEP, lines_of, refusal_of, short

from opt3dgs_optim.hosts import diff

METHODS = """\
import torch
from trainer import *


class Runner:
    def __init__(self):
        self.optimizer = adam()

{more}
    def train(self):
        scaler = torch.amp.GradScaler('cpu')
        for i in range(8):
            saw(i, 8)
            {loss}
            {step}
            self.optimizer.zero_grad()


Runner().train()
"""
PROPERTY = "    @property\n    def loss(self):\n        return loss_of()\n"
BACKWARD = "    def backward(self):\n        loss_of().backward()\n"
CLOSURE = "    def closure(self):\n        return loss_of()\n"
STEPS = "self.optimizer.step()"


@pytest.mark.parametrize(
    ("more", "loss", "reason"),
    [
        (BACKWARD, "self.backward()", "computes gradients too"),
        ("", "self.backward()", "it is not clear that it is a loss"),
        (PROPERTY, "self.loss.backward()", "self.loss is a property"),
        ("", "self.engine.backward()", "it is not clear that it is a loss"),
        ("", "engine.backward()", "it is not clear that it is a loss"),
        (
            "",
            "self.loss = scaler.scale(loss_of())\n            self.loss.backward()",
            "scaled by a factor that changes",
        ),
    ],
)
def test_what_is_no_plain_loss(tmp_path: Path, more: str, loss: str, reason: str) -> None:
    text = METHODS.format(more=more, loss=loss, step=STEPS)
    assert reason in refusal_of(tmp_path, text)


def test_a_loss_in_an_attribute(tmp_path: Path) -> None:
    loss = "self.loss = loss_of()\n            self.loss.backward()"
    lines = lines_of(tmp_path, METHODS.format(more="", loss=loss, step=STEPS))
    assert "phases.observe(self.loss)" in lines


@pytest.mark.parametrize(
    ("above", "more"),
    [
        ("def extra(l):\n    l.backward()", "extra(loss_of())"),
        ("def extra():\n    loss_of().backward()", "extra()"),
        ("def extra(l):\n    l.backward()\ndef other():\n    extra(loss_of())", "other()"),
        ("", "extra = lambda: loss_of().backward()\nextra()"),
    ],
)
def test_gradients_of_another_loss(tmp_path: Path, above: str, more: str) -> None:
    text = short(above=above, step=f"{more}\n{STEP}")
    assert run(text.encode()).clock
    said = refusal_of(tmp_path, text)
    assert "computes gradients too" in said or "in a function inside the loop" in said


def test_scores_for_pruning_are_no_loss(tmp_path: Path) -> None:
    """A function of a function computes gradients of an image, and the Gaussians are new then."""
    top = "def score(image):\n    image.sum().backward()\n\n\ndef prune(image):\n    score(image)"
    lines = lines_of(tmp_path, short(top=top, step=f"prune(render()[0])\n{STEP}"))
    assert "phases.observe(loss)" in lines


@pytest.mark.parametrize(
    "argument",
    [
        "lambda: loss",
        "self.closure",
        "functools.partial(self.closure)",
        "self.make_closure()",
        "again",
    ],
)
def test_a_closure(tmp_path: Path, argument: str) -> None:
    step = f"again = functools.partial(self.closure)\n            self.optimizer.step({argument})"
    loss = "loss = loss_of()\n            loss.backward()"
    said = refusal_of(tmp_path, METHODS.format(more=CLOSURE, loss=loss, step=step))
    assert "is no step of an Adam" in said


def test_a_mask_is_no_closure(tmp_path: Path) -> None:
    step = "mask = torch.ones(3)\n            self.optimizer.step(mask)"
    loss = "loss = loss_of()\n            loss.backward()"
    lines = lines_of(tmp_path, METHODS.format(more=CLOSURE, loss=loss, step=step))
    assert "phases.observe(loss)" in lines


def test_an_error_that_is_suppressed_skips_a_loss(tmp_path: Path) -> None:
    body = "with contextlib.suppress(KeyError):\n    if iteration == 2:\n        raise KeyError\n"
    body += "    loss.backward()\n" + "".join(f"    {line}\n" for line in STEP.splitlines())
    text = short(top="import contextlib", backward=body, step="")
    assert "phases.observe(loss, iteration=iteration)" in lines_of(tmp_path, text)
    edited = run(diff(tmp_path / "train.py").new)
    left = [said and said[1] - said[0] for said in edited.scheduled]
    assert left == [total - count for count, total in edited.clock]
