"""`opt3dgs hosts diff`: lines that fit the file, or a refusal that says why."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from running_trainers import run
from trainer_files import (
    GSPLAT,
    INRIA,
    MCMC,
    MINI_SPLATTING,
    SYNTHETIC,
    TAMING,
    added,
    lines_of,
    refusal_of,
    short,
)

from opt3dgs_optim.hosts import diff, write
from opt3dgs_optim.hosts.edits import main

IMPORT = "from opt3dgs_optim import PhaseScheduler"
OURS = [
    "phases = PhaseScheduler(opt.iterations)",
    "gaussians.optimizer = phases.upgrade(gaussians.optimizer)",
    "Ll1 = phases.pixel_loss(image, gt_image)",
    "phases.observe(loss, iteration=iteration - 1)",
]


def saved(folder: Path, text: str, name: str = "train.py") -> Path:
    path = folder / name
    path.write_bytes(text.encode())
    return path


def lines_for(folder: Path, text: str) -> list[str]:
    return added(diff(saved(folder, text)).diff)


@pytest.mark.parametrize("kind", SYNTHETIC)
def test_what_is_written_is_what_was_shown(tmp_path: Path, kind: str) -> None:
    path = saved(tmp_path, SYNTHETIC[kind])
    lines = added(diff(path).diff)
    assert lines[0] == IMPORT
    backup = write(path)
    assert backup.name == "train.py.orig"
    assert backup.read_text() == SYNTHETIC[kind]
    after = path.read_text()
    compile(after, str(path), "exec")
    old = SYNTHETIC[kind].splitlines()
    assert [line.strip() for line in after.splitlines() if line not in old] == lines


def test_the_lines_of_inria(tmp_path: Path) -> None:
    path = saved(tmp_path, INRIA)
    assert added(diff(path).diff) == [IMPORT, *OURS]
    assert diff(path).notes == ["left alone: gaussians.exposure_optimizer"]
    write(path)
    text = path.read_text()
    # after restore(), which makes a new optimizer
    assert text.index("restore(") < text.index(OURS[0]) < text.index("for iteration")
    assert "l1_test += l1_loss(" in text


def test_the_lines_of_gsplat(tmp_path: Path) -> None:
    path = saved(tmp_path, GSPLAT)
    ranks = ", process_group=torch.distributed.group.WORLD if world_size > 1 else None"
    lines = [
        IMPORT,
        f"phases = PhaseScheduler(max_steps{ranks})",
        "self.optimizers = phases.upgrade(self.optimizers)",
        "l1loss = phases.pixel_loss(colors, pixels)",
        "phases.observe(loss, iteration=step)",
    ]
    assert added(diff(path).diff) == lines
    assert diff(path).notes == ["left alone: self.pose_optimizers"]
    write(path)
    text = path.read_text()  # below all that may make the optimizers anew
    assert text.index("schedulers = [") < text.index(lines[1]) < text.index("for step in pbar")


@pytest.mark.parametrize("call", ["relocate_gs", "densify", "prune_and_densify"])
def test_one_set_of_lines_for_both_density_controls(tmp_path: Path, call: str) -> None:
    """Which it is, the scheduler sees in the training."""
    assert lines_for(tmp_path, MCMC.replace("relocate_gs", call)) == [IMPORT, *OURS]


def test_world_size_only_where_it_is_defined(tmp_path: Path) -> None:
    assert "phases = PhaseScheduler(max_steps)" in lines_for(tmp_path, SYNTHETIC["gsplat 2DGS"])


@pytest.mark.parametrize("name", ["convexes", "student_gaussians"])
def test_the_models_name_is_the_files(tmp_path: Path, name: str) -> None:
    lines = lines_for(tmp_path, INRIA.replace("gaussians", name))
    assert f"{name}.optimizer = phases.upgrade({name}.optimizer)" in lines


def test_other_names_of_loss_options_and_ours(tmp_path: Path) -> None:
    text = INRIA.replace("        loss.b", "        total_loss = loss\n        total_loss.b")
    assert "phases.observe(total_loss, iteration=iteration - 1)" in lines_for(tmp_path, text)
    text = INRIA.replace("opt.iterations", "final_iter").replace("opt, pipe", "final_iter, opt")
    assert "phases = PhaseScheduler(final_iter)" in lines_for(tmp_path, text)
    text = INRIA.replace("first_iter = 0\n", "phases = first_iter = 0\n")
    assert "opt3dgs_phases = PhaseScheduler(opt.iterations)" in lines_for(tmp_path, text)


def test_names_of_a_function_around_it(tmp_path: Path) -> None:
    head, body = INRIA.split("def training(dataset, opt, pipe, checkpoint):\n")
    inner = "".join(f"    {line}\n" for line in body.split("\n\n\ndef")[0].splitlines())
    text = f"{head}def main(opt):\n    def training(dataset, pipe, checkpoint):\n{inner}"
    assert lines_for(tmp_path, text) == [IMPORT, *OURS]
    with pytest.raises(ValueError, match="the name opt is not defined"):
        diff(saved(tmp_path, text.replace("main(opt)", "main(options)")))


@pytest.mark.parametrize(
    ("loop", "observe"),
    [
        ("range(1, opt.iterations + 1)", "phases.observe(loss, iteration=iteration - 1)"),
        ("range(first_iter, opt.iterations)", "phases.observe(loss, iteration=iteration)"),
        ("range(opt.iterations)", "phases.observe(loss)"),
    ],
)
def test_the_trainers_own_count(tmp_path: Path, loop: str, observe: str) -> None:
    text = INRIA.replace("range(first_iter, opt.iterations + 1)", loop)
    assert observe in lines_for(tmp_path, text)


def test_a_new_set_up_in_the_loop_is_upgraded_too(tmp_path: Path) -> None:
    path = saved(tmp_path, MINI_SPLATTING)
    write(path)
    text = path.read_text()
    assert text.count(OURS[1]) == 2
    assert re.search(
        rf"simp_iteration1:\n +gaussians\.training_setup\(opt\)\n +{re.escape(OURS[1])}", text
    )


def test_a_second_optimizer_is_taken_along(tmp_path: Path) -> None:
    second = "gaussians.shoptimizer = phases.upgrade(gaussians.shoptimizer)"
    assert second in lines_for(tmp_path, TAMING)
    # Stepped in a method of the model: read from the model's file.
    text = INRIA.replace("gaussians.optimizer.step()", "gaussians.optimizer_step(iteration)")
    assert second not in lines_for(tmp_path, text)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "gaussian_model.py").write_text("self.shoptimizer = torch.optim.Adam([])")
    assert second in lines_for(tmp_path, text)


def test_groups_without_positions_are_noted(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    model = "groups = [{'params': [a], 'name': 'anchor'}, {'params': [b], 'name': 'opacity'}]\n"
    (tmp_path / "scene" / "gaussian_model.py").write_text(model)
    (note, _) = diff(saved(tmp_path, INRIA)).notes
    assert "named xyz or means" in note
    assert "anchor, opacity" in note


def test_branches_of_an_if(tmp_path: Path) -> None:
    text = INRIA.replace(
        "        loss.backward()\n",
        """\
        if amp:
            scaler.scale(loss).backward()
        else:
            loss.backward()
""",
    )
    assert lines_for(tmp_path, text).count(OURS[3]) == 2


def test_an_l1_term_of_another_kind_is_noted(tmp_path: Path) -> None:
    path = saved(tmp_path, INRIA.replace("= l1_loss(image", "= l1_loss_mask(image"))
    assert added(diff(path).diff) == [IMPORT, *OURS[:2], OURS[3]]
    assert "no L1 = l1_loss" in diff(path).notes[1]


@pytest.mark.parametrize("end", ["\r\n", "\r", "\n"])
def test_line_ends_are_kept(tmp_path: Path, end: str) -> None:
    path = saved(tmp_path, INRIA.replace("\n", end))
    write(path)
    data = path.read_bytes().decode()
    assert data.count(end) == INRIA.count("\n") + 4
    assert data.replace(end, "").count("\n") == data.replace(end, "").count("\r") == 0


def test_one_odd_line_end_stays_the_only_one(tmp_path: Path) -> None:
    path = saved(tmp_path, INRIA.replace("import torch\n", "import torch\r\n", 1))
    write(path)
    assert path.read_bytes().count(b"\r\n") == 1


REFUSED = {
    "print('hello')\n": "with a loss.backward",
    INRIA.replace("range(first_iter, opt.iterations + 1)", "loader"): "cannot be read from it",
    INRIA.replace(
        "        loss.backward()\n", 2 * "        loss.backward()\n"
    ): "one loss.backward",
    INRIA.replace("gaussians.optimizer.step()", "adam.minimise()"): "is not clear",
    INRIA.replace("optimizer.step()", "optimizer.step(sig=1)"): "no step of an Adam",
    INRIA.replace("dataset, opt, pipe", "dataset, pipe"): "the name opt is not defined",
    INRIA.replace("import torch\n", "import torch;").replace("\n\n\ndef", ";x = 1\n\n\ndef"): (
        "several statements"
    ),
    INRIA + "def f(:\n": "cannot be read as Python",
    "from opt3dgs_optim import AWSGLD\n" + INRIA: "imports opt3dgs_optim already",
}


@pytest.mark.parametrize("text", REFUSED, ids=REFUSED.values())
def test_what_is_not_certain_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture, text: str
) -> None:
    path = saved(tmp_path, text)
    assert main(["diff", str(path), "--write"]) == 1
    said = capsys.readouterr().err
    assert REFUSED[text] in said
    # The lines to add by hand, where they would help.
    useless = REFUSED[text] in ("no step of an Adam", "imports opt3dgs_optim already")
    assert ("phases = PhaseScheduler(TOTAL_STEPS)" in said) != useless
    assert path.read_text() == text
    assert not (tmp_path / "train.py.orig").exists()


@pytest.mark.parametrize(
    ("module", "page"),
    [
        ("nerfstudio.engine", "nerfstudio"),
        ("threedgrut.utils", "3dgrut"),
        ("fvdb", "fvdb"),
        ("fvdb.utils", "fvdb"),
    ],
)
def test_a_trainer_with_a_page_of_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture, module: str, page: str
) -> None:
    """The general lines would be wrong there: one is named that exists, and has the right ones."""
    text = INRIA.replace("range(first_iter, opt.iterations + 1)", "loader")
    path = saved(tmp_path, text.replace("import torch", f"import {module}\nimport torch"))
    assert main(["diff", str(path)]) == 1
    said = capsys.readouterr().err
    assert f"docs/hosts/{page}.md" in said
    assert "by hand" not in said
    pages = Path(__file__).resolve().parents[2] / "docs" / "hosts"
    assert (pages / f"{page}.md").is_file()


def test_what_the_module_internal_is_decides_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Other projects have a package of that name too, and need the general lines."""
    text = INRIA.replace("range(first_iter, opt.iterations + 1)", "loader")
    text = text.replace("import torch", "import internal.models\nimport torch")
    path = saved(tmp_path, text)
    assert main(["diff", str(path)]) == 1
    assert "lines to add by hand" in capsys.readouterr().err
    (tmp_path / "internal").mkdir()
    (tmp_path / "internal" / "gaussian_splatting.py").touch()
    assert main(["diff", str(path)]) == 1
    said = capsys.readouterr().err
    assert "docs/hosts/lightning.md" in said
    assert "by hand" not in said


@pytest.mark.parametrize(
    ("given", "added_line"),
    [
        ("scene=self.scene", "self.optimizers = phases.upgrade(self.optimizers, scene=self.scene)"),
        ("scene=scenes[0]", "self.optimizers = phases.upgrade(self.optimizers)"),  # no such name
        ("scene=self.scene()", "self.optimizers = phases.upgrade(self.optimizers)"),
        ("scene=None", "self.optimizers = phases.upgrade(self.optimizers)"),
    ],
)
def test_a_scene_that_is_told_of_row_edits_is_given(
    tmp_path: Path, given: str, added_line: str
) -> None:
    """As gsplat's main branch has one; only where it is certain what that is."""
    edit = "self.cfg.strategy.step_post_backward("
    assert GSPLAT.count(edit) == 1
    text = GSPLAT.replace(edit, f"{edit}{given}, ")
    assert added_line in lines_for(tmp_path, text)


def test_two_scenes_are_one_too_many(tmp_path: Path) -> None:
    edit = "self.cfg.strategy.step_post_backward("
    (line,) = [line for line in GSPLAT.splitlines() if edit in line]
    both = [line.replace(edit, f"{edit}scene=self.{name}, ") for name in ("left", "right")]
    lines = lines_for(tmp_path, GSPLAT.replace(line, "\n".join(both)))
    assert "self.optimizers = phases.upgrade(self.optimizers)" in lines


def test_other_files_and_folders(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Where there is no script there are no lines to add by hand either."""
    saved(tmp_path, INRIA)
    saved(tmp_path, "", "trainer.cpp")
    saved(tmp_path, "", "train.rs")
    for name, said in {
        "trainer.cpp": "LichtFeld Studio (C++) and Brush (Rust)",
        "train.rs": "LichtFeld Studio (C++) and Brush (Rust)",
        ".": "name the training script (train.py)",
        "none.py": "cannot be read",
    }.items():
        assert main(["diff", str(tmp_path / name)]) == 1
        errors = capsys.readouterr().err
        assert said in errors
        assert "by hand" not in errors


def test_a_second_time_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = saved(tmp_path, INRIA)
    assert main(["diff", str(path), "--write"]) == 0
    assert "train.py.orig" in capsys.readouterr().out
    once = path.read_text()
    assert main(["diff", str(path)]) == 1
    assert "imports opt3dgs_optim already" in capsys.readouterr().err
    path.write_text(INRIA)  # the user's own file again, the backup still there
    assert main(["diff", str(path), "--write"]) == 1
    assert "exists already" in capsys.readouterr().err
    assert path.read_text() == INRIA != once


@pytest.mark.parametrize("fails", ["target", "backup"])
def test_a_file_that_cannot_be_written_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    """No backup stays behind that would block the next try."""
    path = saved(tmp_path, INRIA)

    def refuse(self: Path, *args: Any, **kwargs: Any) -> Any:
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open" if fails == "target" else "write_bytes", refuse)
        if fails == "target":
            patch.setattr(Path, "read_bytes", lambda self: INRIA.encode())
        with pytest.raises(ValueError, match="cannot be written"):
            write(path)
    assert path.read_text() == INRIA
    assert list(tmp_path.iterdir()) == [path]
    write(path)


def test_a_backup_for_which_there_is_no_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file itself is not touched, not even by what would put it back."""
    path, written = saved(tmp_path, INRIA), list[Path]()

    def half(self: Path, data: bytes) -> int:
        written.append(self)
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", half)
        with pytest.raises(ValueError, match="cannot be written"):
            write(path)
    assert [each.name for each in written] == ["train.py.orig"]
    assert path.read_text() == INRIA
    assert list(tmp_path.iterdir()) == [path]


def test_as_a_module_it_prints_the_lines(tmp_path: Path) -> None:
    path = saved(tmp_path, INRIA)
    command = [sys.executable, "-m", "opt3dgs_optim", "hosts", "diff", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert added(done.stdout) == [IMPORT, *OURS]
    assert path.read_text() == INRIA


GLOBAL = """\
import torch
from trainer import *

optimizers = make_optimizers()


def training(opt):
{more}    for iteration in range(opt.iterations):
        saw(iteration, opt.iterations)
        loss = loss_of()
        loss.backward()
        for o in optimizers.values():
            o.step(), o.zero_grad()


training(opt)
"""
HELD = """\
import torch
from dataclasses import dataclass
from typing import NamedTuple
from trainer import *


{model}


def training(model):
    for iteration in range(8):
        saw(iteration, 8)
        loss = loss_of()
        loss.backward()
        model.optimizer.step()
        model.optimizer.zero_grad()


training(Model(adam()))
"""
MODELS = {
    "property": (
        "class Model:\n    def __init__(self, adam):\n        self.adam = adam\n\n"
        "    @property\n    def optimizer(self):\n        return self.adam\n"
    ),
    "frozen": "@dataclass(frozen=True)\nclass Model:\n    optimizer: object",
    "tuple": "class Model(NamedTuple):\n    optimizer: object",
}


def clocks_agree(path: Path) -> bool:
    """Whether every step of the edited script has the parts, at the trainer's own time."""
    edited = run(diff(path).new)
    left = [said and said[1] - said[0] for said in edited.scheduled]
    return left == [total - count for count, total in edited.clock] and left != []


@pytest.mark.parametrize(
    ("more", "upgrade"),
    [
        ("", "phases.upgrade(optimizers)"),
        ("    global optimizers\n", "optimizers = phases.upgrade(optimizers)"),
    ],
)
def test_a_name_of_another_scope_is_not_made_local(tmp_path: Path, more: str, upgrade: str) -> None:
    path = saved(tmp_path, GLOBAL.format(more=more))
    assert added(diff(path).diff)[2] == upgrade
    assert clocks_agree(path)


@pytest.mark.parametrize("kind", MODELS)
def test_an_attribute_that_cannot_be_set(tmp_path: Path, kind: str) -> None:
    path = saved(tmp_path, HELD.format(model=MODELS[kind]))
    assert added(diff(path).diff)[2] == "phases.upgrade(model.optimizer)"
    assert clocks_agree(path)


@pytest.mark.parametrize(
    ("top", "above"),
    [
        ("", "if opt.accum == 3:\n    world_size = 2"),
        ("", "for world_size in ():\n    pass"),
        ("if __name__ == 'main':\n    world_size = 2", ""),
    ],
)
def test_a_number_of_processes_that_need_not_be_there(tmp_path: Path, top: str, above: str) -> None:
    said = refusal_of(tmp_path, short(top=top, above=above))
    assert "world_size has a value in some cases alone" in said


@pytest.mark.parametrize(
    ("top", "above", "given"),
    [
        ("", "sizes = [world_size for world_size in (1, 2)]", False),
        ("", "world_size = (10.0, 4.0)", False),
        ("world_size = [10.0, 4.0]", "", False),
        ("", "if opt:\n    world_size = 1\nelse:\n    world_size = 2", True),
        ("", "with torch.no_grad():\n    world_size = 1", True),
        ("world_size = 1", "", True),
        ("from trainer import opt as world_size", "", True),
    ],
)
def test_a_number_of_processes(tmp_path: Path, top: str, above: str, given: bool) -> None:
    lines = lines_of(tmp_path, short(top=top, above=above))
    assert ("process_group" in lines[0]) is given


@pytest.mark.parametrize(
    "own",
    [
        "try:\n    raise KeyError\nexcept KeyError as phases:\n    pass",
        "match opt:\n    case phases:\n        pass",
        "match [1]:\n    case [*phases]:\n        pass",
        "match {}:\n    case {**phases}:\n        pass",
        "global phases",
    ],
)
def test_a_name_that_the_file_has_in_some_way(tmp_path: Path, own: str) -> None:
    path = saved(tmp_path, short(above=own))
    assert "opt3dgs_phases = PhaseScheduler(opt.iterations)" in added(diff(path).diff)
    assert clocks_agree(path)


def test_a_number_is_no_scene(tmp_path: Path) -> None:
    edit = "self.cfg.strategy.step_post_backward("
    lines = lines_for(tmp_path, GSPLAT.replace(edit, f"{edit}scene=self.scene_scale, "))
    assert "self.optimizers = phases.upgrade(self.optimizers)" in lines


def test_a_loss_in_the_last_line_of_the_loop(tmp_path: Path) -> None:
    text = MINI_SPLATTING.replace("                gaussians.training_setup(opt)\n", "")
    text = text.replace("            if iteration == simp_iteration1:\n", "")
    again = "gaussians.optimizer.step()\n        if iteration == 3:\n            "
    text = text.replace("gaussians.optimizer.step()\n", f"{again}gaussians.training_setup(opt)\n")
    assert lines_for(tmp_path, text).count(OURS[1]) == 2


@pytest.mark.parametrize("end", ["\r", "\n"])
@pytest.mark.parametrize("line", ["import torch, opt3dgs_optim", "import opt3dgs_optim.runs as r"])
def test_any_import_of_ours_is_seen(tmp_path: Path, line: str, end: str) -> None:
    text = INRIA.replace("import torch\n", f"{line}\n").replace("\n", end)
    with pytest.raises(ValueError, match="imports opt3dgs_optim already"):
        diff(saved(tmp_path, text))


def test_a_comment_is_no_import(tmp_path: Path) -> None:
    text = INRIA.replace("import torch\n", 'import torch\nTEXT = """\nimport opt3dgs_optim\n"""\n')
    assert lines_for(tmp_path, text) == [IMPORT, *OURS]


@pytest.mark.parametrize("deep", [" + ".join(["a"] * 990), " + ".join(["'a'"] * 9000)])
def test_what_is_nested_too_deeply(
    tmp_path: Path, deep: str, capsys: pytest.CaptureFixture
) -> None:
    path = saved(tmp_path, f"{INRIA}\nX = {deep}\n")
    assert main(["diff", str(path)]) == 1
    assert "nested too deeply" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("first", "encoding", "line", "reason"),
    [
        ("# coding: cp1252", "cp1252", 1, "cp1252; only UTF-8 is read"),
        ("# coding: latin-1", "utf-8", 1, "iso-8859-1; only UTF-8 is read"),
        ("#\n# é", "cp1252", 2, "not written in UTF-8"),
    ],
)
def test_other_encodings(tmp_path: Path, first: str, encoding: str, line: int, reason: str) -> None:
    path = tmp_path / "train.py"
    path.write_bytes(f"{first}\n{INRIA}# é\n".encode(encoding))
    with pytest.raises(ValueError, match=rf"(?s)^line {line}: .*{reason}"):
        diff(path)


def test_no_imports(tmp_path: Path) -> None:
    text = INRIA.replace("import torch\nfrom scene import Scene, GaussianModel\n", "")
    assert "there are no imports at the top" in refusal_of(tmp_path, text)


def test_lines_that_do_not_fit(tmp_path: Path) -> None:
    body = (
        "        if opt: \\\n        loss.backward()\n        else:\n            loss.backward()\n"
    )
    said = refusal_of(tmp_path, INRIA.replace("        loss.backward()\n", body))
    assert "the lines do not fit around this loop" in said
    assert "<edited>" not in said


def test_a_pipe_is_no_script(tmp_path: Path) -> None:
    path = tmp_path / "train.py"
    os.mkfifo(path)
    with pytest.raises(ValueError, match="no regular file"):
        write(path)


def test_a_link_is_followed(tmp_path: Path) -> None:
    """The file that it names is changed, and has the backup beside it."""
    (tmp_path / "trainers").mkdir()
    path, link = saved(tmp_path / "trainers", INRIA), tmp_path / "link.py"
    link.symlink_to(path)
    backup = write(link)
    assert backup == path.with_name("train.py.orig").resolve()
    assert link.is_symlink()
    assert OURS[0] in path.read_text()
    assert backup.read_text() == INRIA


def test_a_file_that_cannot_be_read_is_said_in_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    path = saved(tmp_path, INRIA)

    def refuse(self: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    assert main(["diff", str(path)]) == 1
    said = capsys.readouterr().err
    assert "Permission denied" in said
    assert "Traceback" not in said
