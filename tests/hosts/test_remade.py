"""Optimizers that the loop makes anew, by whatever way, are upgraded again; or it is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from running_trainers import run
from trainer_files import indent, lines_of, refusal_of, short

from opt3dgs_optim.hosts import diff

HEAD = """\
import torch
from trainer import *

parameters.append(torch.nn.Parameter(torch.ones(3, 3)))


def anew(adam):
    return watch(torch.optim.Adam([dict(adam.param_groups[0])]))


"""
NEW = "optimizer = torch.optim.Adam([dict(params=parameters[:1], name='xyz')])\n"
LOOP = """\
for i in range(8):
    saw(i, 8)
    loss = loss_of()
    loss.backward()
    {step}
    if i == 3:
        {again}
"""
STEPS = "for o in {optimizers}.values(): o.step(), o.zero_grad()"
METHODS = """\
def renew(adams, name):
    adams[name] = anew(adams[name])


class Runner:
    def __init__(self):
        self.optimizers = make_optimizers()

    def item(self):
        self.optimizers['means'] = anew(self.optimizers['means'])

    def of_another(self):
        self.item()

    def several(self):
        self.optimizers.update(means=anew(self.optimizers['means']))

    def by_name(self):
        setattr(self, 'optimizers', make_optimizers())

    def train(self):
        others = self.optimizers
"""
IN_METHODS = (
    "self.item()",
    "self.of_another()",
    "self.several()",
    "self.by_name()",
    "renew(self.optimizers, 'means')",
    "renew(adams=self.optimizers, name='means')",
    "renew(others, 'means')",
    "others['means'] = anew(others['means'])",
    "self.optimizers.update(make_optimizers())",
    "self.optimizers['means'] = anew(self.optimizers['means'])",
)


def by(again: str, optimizers: str = "self.optimizers") -> str:
    """A loop over a dict of optimizers with this in a turn."""
    return LOOP.format(step=STEPS.format(optimizers=optimizers), again=again)


def again(declared: str) -> str:
    return f"def again():\n    {declared} optimizer\n    {NEW}    watch(optimizer)\n\n\n"


ONE = LOOP.format(step="optimizer.step(), optimizer.zero_grad()", again="again()")
REMADE = {
    again: METHODS + indent(by(again), " " * 8) + "\nRunner().train()" for again in IN_METHODS
}
REMADE["a global name"] = again("global") + NEW + "watch(optimizer)\n" + ONE
REMADE["a name of the function around"] = (
    "def training():\n"
    + indent(NEW + "watch(optimizer)\n" + again("nonlocal") + ONE, " " * 4)
    + "training()\n"
)
REMADE["an argument"] = (
    "def renew(optimizers):\n    optimizers['means'] = anew(optimizers['means'])\n\n\n"
    "def training():\n    optimizers = make_optimizers()\n"
    + indent(by("renew(optimizers)", "optimizers"), " " * 4)
    + "training()\n"
)


@pytest.mark.parametrize("kind", REMADE)
def test_every_step_has_the_parts(tmp_path: Path, kind: str) -> None:
    text = HEAD + REMADE[kind]
    lines = lines_of(tmp_path, text)
    assert sum(".upgrade(" in line for line in lines) == 2
    stock, edited = run(text.encode()), run(diff(tmp_path / "train.py").new)
    assert edited.clock == stock.clock
    left = [None if said is None else said[1] - said[0] for said in edited.scheduled]
    assert left == [total - count for count, total in stock.clock]


def test_an_owner_that_a_method_exchanges(tmp_path: Path) -> None:
    text = HEAD + METHODS.replace("self.optimizers", "self.model.optimizers")
    text += indent(by("self.load()", "self.model.optimizers"), " " * 8)
    text += "\n    def load(self):\n        self.model = torch.load('best')\n"
    said = refusal_of(tmp_path, text)
    assert "self.model, which has the optimizers, gets another value here" in said


def test_optimizers_that_the_loop_alone_makes(tmp_path: Path) -> None:
    text = short(loss="if iteration == 0:\n    gaussians.training_setup(opt)\nloss = loss_of()")
    text = text.replace("    gaussians.training_setup(opt)\n", "", 1)
    assert "gets its optimizers in the loop alone" in refusal_of(tmp_path, text)


def test_lists_that_are_no_optimizers(tmp_path: Path) -> None:
    top = "def note(rows, row):\n    rows.append(row)\n    rows[0] = row"
    lines = lines_of(
        tmp_path, short(top=top, above="rows = []", backward="loss.backward()\nnote(rows, loss)")
    )
    assert sum(".upgrade(" in line for line in lines) == 1


POSES = """\
def training(gaussians, opt):
    poses = Poses()
    poses.training_setup(opt)
    for iteration in range(opt.iterations):
        loss = loss_of()
        loss.backward()
        gaussians.optimizer.step()
        poses.optimizer.step()
"""


def test_of_two_models_that_of_the_gaussians(tmp_path: Path) -> None:
    lines = lines_of(tmp_path, f"import torch\n\n\n{POSES}")
    assert "gaussians.optimizer = phases.upgrade(gaussians.optimizer)" in lines
    said = refusal_of(tmp_path, f"import torch\n\n\n{POSES}".replace("gaussians", "model"))
    assert "the optimizer of the Gaussians is not clear" in said


def test_of_two_dicts_it_is_not_clear(tmp_path: Path) -> None:
    networks = f"    {STEPS.format(optimizers='self.splat_optimizers')}\n"
    text = HEAD + METHODS + indent(by("pass") + networks, " " * 8)
    assert "the optimizer of the Gaussians is not clear" in refusal_of(tmp_path, text)


def test_another_optimizer_of_torch(tmp_path: Path) -> None:
    made = "        self.optimizer = torch.optim.SGD([])"
    top = f"class Model:\n    def training_setup(self, opt):\n{made}"
    said = refusal_of(tmp_path, short(top=top).replace("GaussianModel()", "Model()"))
    assert "gaussians.optimizer is torch.optim.SGD(...), but torch.optim.Adam is needed" in said
