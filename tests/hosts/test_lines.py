"""`opt3dgs lines`: every trainer's lines and notes are read from its page as they stand there."""

from __future__ import annotations

import ast
import copy
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from gaussians import adams_of, parameters, steps

from opt3dgs_optim import PhaseScheduler
from opt3dgs_optim.hosts import lines
from opt3dgs_optim.hosts.diff import ANY
from opt3dgs_optim.hosts.pages import OPEN_END, places_in, section
from opt3dgs_optim.hosts.trainers import TRAINERS

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs" / "hosts"
PYTHON = [name for name, trainer in TRAINERS.items() if trainer.places]
FLAT = ("gsplat-2dgs",)  # flat Gaussians, with a third scale that nothing trains


def test_the_list_has_every_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert lines.main([]) == 0
    printed = capsys.readouterr().out
    listed = [re.split(r"  +", line) for line in printed.splitlines()[: len(TRAINERS)]]
    assert listed == [[name, trainer.title] for name, trainer in TRAINERS.items()]
    assert ANY in printed


@pytest.mark.parametrize("name", TRAINERS)
def test_what_is_printed_stands_on_the_page(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Every group of lines and every note of its own section; a link is for a page."""
    trainer = TRAINERS[name]
    assert lines.main([name]) == 0
    printed = capsys.readouterr().out
    own = section(trainer.sections[-1])
    fenced, *of_open_end = re.findall(r"^```(?:py|yaml|sh)\n(# .+?)```$", own, re.M | re.S)
    assert fenced in printed
    assert len(of_open_end) == (OPEN_END in own)
    assert "](" not in printed
    pages = "".join(section(place) for place in trainer.sections)
    for topic in set(re.findall(r"^\*\*(.+?)\.\*\* ", pages, re.M)) | {"Density control"}:
        assert len(re.findall(rf"^{topic}: ", printed, re.M)) == (topic != OPEN_END)
    for said in re.findall(rf"^\*\*(?!{OPEN_END}).+?\.\*\*(?: .+\n)+", own, re.M):
        wanted = set(re.findall("`.+?`", " ".join(said.split())))
        assert wanted <= set(re.findall("`.+?`", " ".join(printed.split())))


@pytest.mark.parametrize("name", TRAINERS)
def test_a_place_is_one_of_a_file(name: str) -> None:
    """Every comment above lines says a place, or none does: a plugin, a command."""
    trainer = TRAINERS[name]
    groups = trainer.block.split("\n\n")
    assert len(trainer.places) in (0, len(groups))
    assert all(group.startswith("# ") for group in groups)
    assert re.fullmatch(r"File: .+ of .+ \(github\.com/\S+/\S+\)\. Read at .+\.", trainer.head)
    if trainer.signs:
        assert trainer.places


@pytest.mark.parametrize("name", PYTHON)
def test_the_lines_are_three_statements(name: str) -> None:
    """An import, a scheduler, an upgrade; nothing else."""
    trainer = TRAINERS[name]
    tree = ast.parse(trainer.block)
    scheduler = next(
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "PhaseScheduler"
    )
    parts = {k.arg: ast.unparse(k.value) for k in scheduler.keywords}.get("parts", "None")
    assert parts == ("DEFAULTS[1:]" if name in FLAT else "None")
    imported = {"PhaseScheduler"} | ({"DEFAULTS"} if parts != "None" else set())
    first = tree.body[0]
    assert isinstance(first, ast.ImportFrom)
    assert {alias.name for alias in first.names} == imported
    text = ast.unparse(tree)
    assert "observe" not in text
    assert "pixel_loss" not in text
    assert text.count(".upgrade(") == sum(
        place.times for place in trainer.places if any("upgrade" in each for each in place.lines)
    ) - (name == "mini-splatting")  # one of its lines goes to two places


@pytest.mark.parametrize("name", PYTHON)
def test_a_trainer_that_relocates_is_told_of_the_harmonics(name: str) -> None:
    """With the number of iterations of its own lines."""
    trainer = TRAINERS[name]
    notes = " ".join(trainer.notes.values())
    told = re.findall(r"PhaseScheduler\((.+?), parts=.+?Harmonics", notes)
    own = re.findall(r"PhaseScheduler\(([^,()]+)", trainer.block)
    assert told == (own if "relocates" in trainer.notes["Density control"] else [])


@pytest.mark.parametrize("name", ["3dgs-mcmc", "gsplat", "taming-3dgs"])
def test_the_lines_without_a_planned_end(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert lines.main([name, "--open-end"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("= PhaseScheduler(") == 1
    assert "phases = PhaseScheduler()\n" in printed
    assert "Open end: " in printed
    assert printed.count("    if phases.ended:\n") + printed.count(" > opt.iterations:\n") == 1


def ending(name: str, first: int, kept: int, optimizers: dict[str, Any]) -> tuple[Any, ...]:
    """What a loop with the lines of no planned end, enough at 50, leaves of the trainer's numbers.

    It begins with `first`; `kept` is the iteration whose state it returns, too.
    """
    (place,) = (p for p in places_in(TRAINERS[name].open_end) if "for " in p.anchor and not p.above)
    body = "\n".join(place.lines).replace("10_000", "50")
    code = compile(f"ends = True\nfor _ in '1':\n{body}\nelse:\n    ends = False", name, "exec")
    phases, state = PhaseScheduler(), {}
    phases.upgrade(optimizers)
    numbers: dict[str, Any] = {
        "opt": SimpleNamespace(iterations=90, densify_until_iter=90),
        "cfg": SimpleNamespace(strategy=SimpleNamespace(refine_stop_iter=90), eval_steps=[]),
        "max_steps": 90, "saving_iterations": [], "testing_iterations": [],
    }  # fmt: skip
    params = {k: each.param_groups[0]["params"][0] for k, each in optimizers.items()}
    for i in range(first, 90):
        numbers |= {"phases": phases, "iteration": i, "step": i}
        exec(code, numbers)
        if numbers["ends"]:
            break
        if i < numbers["opt"].iterations:  # INRIA's makes no step in its last
            steps(optimizers, params, 1)
        if i == kept:
            state = {k: copy.deepcopy(each.state_dict()) for k, each in optimizers.items()}
    left = [numbers[key] for key in ("opt", "cfg", "max_steps", "saving_iterations", "iteration")]
    return state, left


@pytest.mark.parametrize("kept", [49, 50, 55])
@pytest.mark.parametrize(("name", "first"), [("inria", 1), ("gsplat", 0)])
def test_a_resumed_training_keeps_its_end(name: str, first: int, kept: int) -> None:
    """Also where the checkpoint is of the iteration that was good enough, or of the fall."""
    state, left = ending(name, first, kept, adams_of(parameters(4)))
    resumed = adams_of(parameters(4))
    for key, optimizer in resumed.items():
        optimizer.load_state_dict(state[key])
    _, again = ending(name, kept + 1, 0, resumed)
    assert again == left
    assert left[-1] < 65


def test_the_page_names_those_with_an_open_end() -> None:
    page = " ".join((DOCS / "index.md").read_text(encoding="utf-8").split())
    named = re.findall(r"`--open-end` is for (.+?)\.", page)[0]
    assert re.findall("`(.+?)`", named) == [
        name for name, each in TRAINERS.items() if each.open_end
    ]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nerfstudio"], "nerfstudio plans its length"),
        (["gsplat-2dgs"], "gsplat-2dgs plans its length"),
        (["train.py"], "need the name of a trainer"),
        ([], "need the name of a trainer"),
        (["inria", "--iterations", "300"], "give one of them"),
    ],
)
def test_where_there_is_no_open_end(
    words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        lines.main([*words, "--open-end"])
    assert said in capsys.readouterr().err


def test_a_name_is_no_folder_that_bears_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As in a folder of clones, and in gsplat's own, which holds its package."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "gsplat").mkdir()
    assert lines.main(["gsplat", "--iterations", "10000"]) == 0
    assert "# 10,000 iterations" in capsys.readouterr().out


def test_a_repository_s_name_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    for word, name in (("gaussian-splatting", "inria"), ("3DGS-MCMC", "3dgs-mcmc")):
        assert lines.main([word]) == 2
        assert re.search(rf"did you mean .*\b{name}\b", capsys.readouterr().err)


@pytest.mark.parametrize("word", ["gsplt", "gsplat-mcmc", "3dgs_mcmc"])
def test_an_unknown_trainer(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert lines.main([word]) == 2
    said = capsys.readouterr().err
    assert "did you mean" in said
    assert ANY in said
    assert lines.main([word, "--open-end"]) == 2
    assert capsys.readouterr().err == said
