"""`opt3dgs lines`: every trainer has its lines, and the pages of docs/hosts/ say the same."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from opt3dgs_optim.hosts import lines
from opt3dgs_optim.hosts.trainers import ANY, TRAINERS

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs" / "hosts"
PATCHES = ROOT / "examples" / "hosts"
NAMES = list(lines.known())
PYTHON = [name for name in NAMES if name not in ("lightning", "nerfstudio")]


def words(text: str) -> str:
    """Without line breaks, which pages and terminals set differently."""
    return " ".join(text.split())


def test_the_list_has_every_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert lines.main([]) == 0
    printed = capsys.readouterr().out
    assert [line.split()[0] for line in printed.splitlines()[: len(NAMES)]] == NAMES
    assert ANY in printed


@pytest.mark.parametrize("name", NAMES)
def test_a_trainers_page_has_what_is_printed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Its lines stand in one block of a page, and each of its notes in that page's text."""
    assert lines.main([name]) == 0
    printed = capsys.readouterr().out
    trainer, relocates = lines.known()[name]
    block = lines.block(trainer, relocates)
    assert block in printed
    assert "](" not in printed  # a link is for a page
    for said in (said for topic, said in trainer.notes.items() if topic != "Density control"):
        assert set(re.findall("`.+?`", said)) <= set(re.findall("`.+?`", words(printed))), said
    pages = [page.read_text(encoding="utf-8") for page in sorted(DOCS.glob("*.md"))]
    found = [page for page in pages if f"\n{block}\n```" in page]
    assert len(found) == 1
    for topic, said in trainer.notes.items():
        assert words(f"**{topic}.** {said}") in words(found[0]), topic
    for commit in trainer.read:
        assert commit in words(found[0])


@pytest.mark.parametrize("name", PYTHON)
def test_the_lines_are_three_statements(name: str) -> None:
    """An import, a scheduler with the preset of the density control, an upgrade; nothing else."""
    trainer, relocates = lines.known()[name]
    tree = ast.parse(lines.block(trainer, relocates))
    scheduler = next(
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "PhaseScheduler"
    )
    parts = {k.arg: ast.unparse(k.value) for k in scheduler.keywords}.get("parts", "None")
    expected = {True: "None", False: "DEFAULTS_ADC"}
    if isinstance(relocates, bool):
        assert parts == expected[relocates]
    else:
        assert re.fullmatch(r"None if .+ else DEFAULTS_ADC", parts)
    imported = {"PhaseScheduler"} | ({"DEFAULTS_ADC"} if parts != "None" else set())
    first = tree.body[0]
    assert isinstance(first, ast.ImportFrom)
    assert {alias.name for alias in first.names} == imported
    text = ast.unparse(tree)
    assert "observe" not in text
    assert "pixel_loss" not in text
    assert text.count(".upgrade(") == sum(
        place.times for place in trainer.places if any("upgrade" in each for each in place.lines)
    ) - (name == "mini-splatting")  # one of its lines goes to two places


@pytest.mark.parametrize("word", ["gsplt", "3dgs_mcmc"])
def test_an_unknown_trainer(word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert lines.main([word]) == 2
    said = capsys.readouterr().err
    assert "did you mean" in said
    assert ANY in said


@pytest.mark.parametrize("patch", sorted(PATCHES.glob("*.patch")), ids=lambda path: path.stem)
def test_a_patch_adds_the_lines(patch: Path) -> None:
    trainer = TRAINERS[patch.stem]
    text = patch.read_text(encoding="utf-8")
    changed = [line for line in text.splitlines() if re.match(r"[+-](?!\+\+|--)", line)]
    added = [line[1:].strip() for line in changed if line.startswith("+")]
    expected = [line for place in trainer.places for line in trainer.lines_at(place) * place.times]
    assert added == expected
    assert len(added) == len(changed)  # nothing is taken away
    assert trainer.read[0].split(" (")[0].split()[-1] in text  # the commit


def test_every_edited_trainer_has_a_patch() -> None:
    assert {path.stem for path in PATCHES.glob("*.patch")} == {
        name for name, trainer in TRAINERS.items() if trainer.inserted
    }
