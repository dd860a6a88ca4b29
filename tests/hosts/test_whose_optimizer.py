"""Whose optimizer a loop steps: the model's own files say so, and poses are no Gaussians."""

from __future__ import annotations

from pathlib import Path

import pytest
from trainer_files import INRIA, added, lines_of, refusal_of

from opt3dgs_optim.hosts import diff

UPGRADED = "gaussians.optimizer = phases.upgrade(gaussians.optimizer)"
MODEL = """\
class {name}{base}:
    def training_setup(self, opt):
        self.optimizer = {made}

    def {method}(self):
        {body}
"""


def model(
    folder: Path,
    file: str = "gaussian_model.py",
    *,
    name: str = "GaussianModel",
    base: str = "",
    made: str = "torch.optim.Adam(groups)",
    method: str = "step",
    body: str = "self.optimizer.step()",
) -> None:
    (folder / "scene").mkdir(exist_ok=True)
    text = MODEL.format(name=name, base=base, made=made, method=method, body=body)
    (folder / "scene" / file).write_text(text)


def stepped(call: str) -> str:
    text = INRIA.replace("                gaussians.exposure_optimizer.step()\n", "")
    return text.replace("gaussians.optimizer.step()", call)


@pytest.mark.parametrize("method", ["step", "optimizer_step"])
def test_a_method_of_the_model_that_steps_its_optimizer(tmp_path: Path, method: str) -> None:
    """Relightable3DGaussian's `gaussians.step()`, FastGS's `optimizer_step()`."""
    model(tmp_path, method=method)
    assert UPGRADED in lines_of(tmp_path, stepped(f"gaussians.{method}()"))


@pytest.mark.parametrize(
    ("call", "body"),
    [
        ("gaussians.step()", "self.count += 1"),
        ("gaussians.optimizer_step()", "for each in self.levels: each.optimizer.step()"),
    ],
)
def test_a_method_that_steps_something_else(tmp_path: Path, call: str, body: str) -> None:
    model(tmp_path, method=call.split(".")[1][:-2], body=body)
    assert "the optimizer of the Gaussians is not clear" in refusal_of(tmp_path, stepped(call))


def test_a_scene_has_no_optimizer(tmp_path: Path) -> None:
    """LOD-3DGS's scene steps those of its models."""
    text = stepped("scene.optimizer_step()")
    assert "the optimizer of the Gaussians is not clear" in refusal_of(tmp_path, text)
    # Without any file of the model the name says it.
    assert UPGRADED in lines_of(tmp_path, stepped("gaussians.optimizer_step()"))


@pytest.mark.parametrize("made", ["torch.optim.RAdam(l)", "NAdam(l)", "bnb.optim.Adam8bit(l)"])
def test_what_is_called_adam_and_is_none(tmp_path: Path, made: str) -> None:
    text = stepped("gaussians.optimizer.step()")
    model(tmp_path, made=made)
    assert "but torch.optim.Adam is needed" in refusal_of(tmp_path, text)
    # Ex4DGS: the class that is used is not the one of that name that lies there, too.
    model(tmp_path)
    model(tmp_path, "c_gaussian_model.py", name="CGaussianModel", made=made)
    assert UPGRADED in lines_of(tmp_path, text)
    chosen = text.replace("import Scene, GaussianModel", "import Scene, CGaussianModel")
    chosen = chosen.replace("GaussianModel(dataset", "CGaussianModel(dataset")
    assert "but torch.optim.Adam is needed" in refusal_of(tmp_path, chosen)
    by_another = text.replace("import Scene, GaussianModel", "import Scene, model_of")
    by_another = by_another.replace(
        "    gaussians = GaussianModel(",
        "    GaussianModel = model_of(dataset)\n    gaussians = GaussianModel(",
    )
    assert UPGRADED in lines_of(tmp_path, by_another)
    (tmp_path / "scene" / "__init__.py").write_text(
        "from scene.c_gaussian_model import CGaussianModel"
    )
    assert "but torch.optim.Adam is needed" in refusal_of(tmp_path, by_another)


def test_the_bases_of_a_model_count(tmp_path: Path) -> None:
    model(tmp_path, name="Base", made="torch.optim.SGD(groups)")
    model(tmp_path, "other_model.py", name="Other")
    (tmp_path / "scene" / "sub_model.py").write_text("class GaussianModel(Base):\n    pass\n")
    text = stepped("gaussians.optimizer.step()")
    assert "but torch.optim.Adam is needed" in refusal_of(tmp_path, text)


ALONE = """\
import torch


def fit(self, view):
    {above}
    optimizer = torch.optim.Adam({groups})
    for step in range(self.count):
        loss = self.loss(view)
        loss.backward()
        optimizer.step()
"""
POSES = '{"params": [view.rot], "name": "rot_{}".format(view.uid)}'


@pytest.mark.parametrize(
    ("above", "groups", "names"),
    [
        ("pass", f"[{POSES}]", "rot_{}"),
        (f"groups = []\n    groups.append({POSES})", "groups", "rot_{}"),
        ("pass", "[embedding]", "none"),
        ("pass", '[{"params": [view.rot], "name": "rot"}], lr=0.1', "rot"),
    ],
)
def test_an_adam_of_something_else(tmp_path: Path, above: str, groups: str, names: str) -> None:
    """MonoGS's poses, wild-gaussians' embedding of a photo."""
    said = refusal_of(tmp_path, ALONE.format(above=above, groups=groups))
    assert (
        f"no group of optimizer has the name of a Gaussian parameter (its names: {names})" in said
    )


@pytest.mark.parametrize(
    ("above", "groups"),
    [
        ("pass", '[{"params": [self.xyz], "name": "xyz"}]'),
        ("pass", "[{'params': p, 'name': n} for n, p in self.splats.items()]"),
        ("pass", "self.groups()"),
        ("groups = self.groups()", "groups"),
    ],
)
def test_an_adam_that_may_be_the_gaussians(tmp_path: Path, above: str, groups: str) -> None:
    upgraded = "optimizer = phases.upgrade(optimizer)"
    assert upgraded in lines_of(tmp_path, ALONE.format(above=above, groups=groups))


SOME = """\
import torch


class Runner:
    def train(self, max_steps):
        for step in range(max_steps):
            loss = self.loss()
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
            {another}
            another.step()
"""


def test_an_item_of_what_is_upgraded_is_not_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "train.py"
    for another, alone in (("another = torch.optim.Adam(poses)", True), ("pass", False)):
        path.write_text(SOME.format(another=another))
        assert any("left alone: another" in note for note in diff(path).notes) == alone
    path.write_text(
        SOME.format(another='optimizer = self.optimizers["means"]').replace(
            "another.", "optimizer."
        )
    )
    assert not [note for note in diff(path).notes if "left alone" in note]
    assert "self.optimizers = phases.upgrade(self.optimizers)" in added(diff(path).diff)


@pytest.mark.parametrize(
    ("groups", "refused"),
    [
        ('[{"params": [self._obj], "name": "obj_dc"}]', True),
        ("list(self.net.parameters())", True),
        ('[{"params": [self._xyz], "name": "xyz"}]', False),
        ("[{'params': p, 'name': n} for n, p in self.all()]", False),
        ("self.groups()", False),
    ],
)
@pytest.mark.parametrize("method", ["training_setup", "training_seg_only_setup"])
def test_the_method_that_is_called_makes_the_groups(
    tmp_path: Path, method: str, groups: str, refused: bool
) -> None:
    """Gaga and SegAnyGAussians train features of frozen Gaussians, by a method of the model."""
    made = f"self.optimizer = torch.optim.Adam({groups}, lr=0.1)"
    own = f"    def {method}(self, opt):\n        {made}\n"
    other = "training_setup" if "seg" in method else "another"
    text = f"class GaussianModel:\n{own}\n"
    made = "[dict(params=[self._xyz], name='xyz')]" if refused else "[self.pose]"
    text += f"    def {other}(self, opt):\n        self.optimizer = torch.optim.Adam({made})\n"
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "gaussian_model.py").write_text(text)
    script = stepped("gaussians.optimizer.step()").replace(".training_setup(", f".{method}(")
    if refused:
        assert "no group of gaussians.optimizer has the name" in refusal_of(tmp_path, script)
    else:
        assert UPGRADED in lines_of(tmp_path, script)


NET = """\
import torch


class Net:
    def __init__(self, net, iters):
        self.net, self.iters = net, iters
        self.optimizer = torch.optim.Adam({groups}, lr=1e-3)

    def train(self, data):
        for i in range(self.iters):
            loss = (self.net(data) ** 2).mean()
            loss.backward()
            self.optimizer.step()
"""


def test_an_optimizer_of_the_files_own_class(tmp_path: Path) -> None:
    text = NET.format(groups='[{"params": net.parameters()}]')
    assert "no group of self.optimizer has the name" in refusal_of(tmp_path, text)
    text = NET.format(groups='[{"params": net.xyz, "name": "xyz"}]')
    assert "self.optimizer = phases.upgrade(self.optimizer)" in lines_of(tmp_path, text)


def test_a_class_that_is_called_otherwise_is_no_adam(tmp_path: Path) -> None:
    text = stepped("gaussians.optimizer.step()")
    model(tmp_path, made="Lion(groups)")
    assert "gaussians.optimizer is Lion(...), but" in refusal_of(tmp_path, text)
    model(tmp_path, made="make_optimizer(groups)")
    assert UPGRADED in lines_of(tmp_path, text)
