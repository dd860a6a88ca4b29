"""`opt3dgs lines FILE`: the lines in the right places, or none.

The files here are made of the lines that `trainers` asks for, and of nothing of the real ones;
`test_trainers.py` has those.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from opt3dgs_optim.hosts import diff, lines
from opt3dgs_optim.hosts.diff import ANY
from opt3dgs_optim.hosts.pages import Trainer
from opt3dgs_optim.hosts.trainers import TRAINERS

EDITED = [name for name, trainer in TRAINERS.items() if trainer.signs]


def statement(text: str) -> list[str]:
    """Whole lines, made a statement at the depth at which they stand."""
    depth = (len(text) - len(text.lstrip())) // 4
    opened = [f"{' ' * 4 * level}if True:" for level in range(depth)]
    rest = text.split("\n")
    closed = [f"{' ' * 4 * depth})"] if rest[-1].count("(") > rest[-1].count(")") else []
    ends_open = rest[-1].endswith(":")
    return [*opened, *rest, *closed, *([f"{' ' * 4 * (depth + 1)}pass"] if ends_open else [])]


def example(trainer: Trainer) -> str:
    """The shortest file that is the trainer's."""
    lines: list[str] = []
    for place in trainer.places:
        lines += statement(place.anchor) * place.times
    for sign in trainer.signs:
        text = sign if isinstance(sign, str) else sign[0]
        if text not in "\n".join(lines):
            lines += statement(text)
    for said, number in sorted(trainer.counts.items(), key=lambda each: -len(each[0])):
        least = number if isinstance(number, int) else min(number)
        lines += [repr(said)] * (least - sum(said in line for line in lines))
    return "\n".join([*lines, ""])


def changes(trainer: Trainer) -> Iterator[str]:
    """Files that are the trainer's but for one thing."""
    text = example(trainer)
    wanted = [place.anchor for place in trainer.places]
    wanted += [sign if isinstance(sign, str) else sign[0] for sign in trainer.signs]
    for each in wanted:
        first = each.split("\n")[0]
        yield text.replace(f"{first}\n", f"{first} + 1\n", 1)
        yield text.replace(f"{first}\n", f"# {first}\n", 1)
        yield text.replace(f"{first}\n", f" {first}\n", 1)
        yield text + "\n".join(statement(each)) + "\n"
    for said, number in trainer.counts.items():
        most = number if isinstance(number, int) else max(number)
        yield text + f"{said!r}\n" * (most + 1)


@pytest.mark.parametrize("name", EDITED)
def test_the_lines_go_to_their_places(name: str) -> None:
    trainer = TRAINERS[name]
    text = example(trainer)
    found, new = diff.edited(text)
    assert found is trainer
    ast.parse(new)
    old, made = text.split("\n"), new.split("\n")
    rest = iter(made)
    assert all(line in rest for line in old)  # in their order
    assert len(made) - len(old) == sum(len(p.lines) * p.times for p in trainer.places)
    for place in trainer.places:
        indent = place.anchor[: len(place.anchor) - len(place.anchor.lstrip())]
        expected = [f"{indent}{line}" for line in place.lines]
        places = [at for at, line in enumerate(made) if line == place.anchor]
        assert len(places) == place.times
        for at in places:
            size = len(expected)
            start = at - size if place.above else at + 1
            assert made[start : start + size] == expected


@pytest.mark.parametrize("name", EDITED)
def test_a_file_that_differs_is_left_alone(name: str) -> None:
    """A line missing, commented out, elsewhere or twice; a word once more."""
    for text in changes(TRAINERS[name]):
        if name == "mini-splatting-d" and not diff.misses(TRAINERS["mini-splatting"], text):
            continue  # one more new optimizer: that is the other script's form
        with pytest.raises(ValueError, match="PhaseScheduler") as refused:
            diff.edited(text)
        assert "upgrade(" in str(refused.value)  # the lines to write by hand


def test_a_place_that_is_known_is_said() -> None:
    text = example(TRAINERS["inria"]).replace("first_iter += 1", "first_iter += 2")
    with pytest.raises(ValueError, match=r"is like INRIA.*`first_iter \+= 1` is not there") as no:
        diff.edited(text)
    at = text.split("\n").index("    for iteration in range(first_iter, opt.iterations + 1):") + 1
    assert f"line {at}: `for iteration" in str(no.value)


@pytest.mark.parametrize("text", ["", "x = 1\n", "import torch\n\nfor i in range(10):\n    pass\n"])
def test_no_trainer(text: str) -> None:
    with pytest.raises(ValueError, match="no trainer that is known") as refused:
        diff.edited(text)
    assert ANY in str(refused.value)


def test_lines_in_a_string_are_no_place() -> None:
    """The syntax tree tells: the new text would be in the string."""
    text = example(TRAINERS["3dgs-mcmc"])
    quoted = f"'''\n{text}'''\n"
    with pytest.raises(ValueError, match="would not be statements of their own"):
        diff.edited(quoted)


@pytest.mark.parametrize("word", ["phases = 1", "import opt3dgs_optim"])
def test_names_that_are_taken(word: str) -> None:
    with pytest.raises(ValueError, match=r"line 1 has `\w+` already") as refused:
        diff.edited(f"{word}\n{example(TRAINERS['gsplat'])}")
    assert (ANY in str(refused.value)) is word.startswith("phases")  # which is the trainer's own


@pytest.mark.parametrize("broken", ["def f(:\n", "x = 'never closed\n"])
def test_what_is_not_python(broken: str) -> None:
    with pytest.raises(ValueError, match="would not be statements"):
        diff.edited(example(TRAINERS["gsplat"]) + broken)


@pytest.mark.parametrize(("end", "start"), [("\n", b""), ("\r\n", b""), ("\n", b"\xef\xbb\xbf")])
def test_written_and_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], end: str, start: bytes
) -> None:
    """Line ends and a byte order mark stay; a second time nothing is written."""
    path = tmp_path / "train.py"
    old = start + b"#\n" + example(TRAINERS["3dgs-mcmc"]).rstrip("\n").replace("\n", end).encode()
    old = old.replace(b"#\n", f"#{end}".encode())
    path.write_bytes(old)
    assert lines.main([str(path)]) == 0
    assert path.read_bytes() == old
    assert "+    phases = PhaseScheduler(opt.iterations - 1)" in capsys.readouterr().out
    assert lines.main([str(path), "--write"]) == 0
    assert path.with_name("train.py.orig").read_bytes() == old
    new = path.read_bytes()
    assert new.count(b"\n") == old.count(b"\n") + 3
    assert new.count(b"\r\n") == (new.count(b"\n") if end == "\r\n" else 0)
    capsys.readouterr()
    assert lines.main([str(path), "--write"]) == 1
    assert "already, so that nothing is inserted" in capsys.readouterr().err
    assert path.read_bytes() == new


def test_an_old_copy_is_never_written_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, kept = tmp_path / "train.py", tmp_path / "train.py.orig"
    path.write_text(example(TRAINERS["gsplat"]))
    kept.write_text("mine")
    assert lines.main([str(path), "--write"]) == 1
    assert "move it away" in capsys.readouterr().err
    assert (kept.read_text(), path.read_text()) == ("mine", example(TRAINERS["gsplat"]))


@pytest.mark.parametrize("content", [None, b"\xff\xfe", "folder"])
def test_what_cannot_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | str | None
) -> None:
    path = tmp_path / "train.py"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        path.mkdir()
    assert lines.main([str(path), "--write"]) == 1
    said = capsys.readouterr().err
    assert str(path) in said
    assert ("that is no file" in said) == (not path.is_file())


@pytest.mark.parametrize(
    "words", [["--write"], ["gsplat", "--write"], ["gsplt", "--write"], ["a", "b"], ["--no-such"]]
)
def test_a_wrong_command(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        lines.main(words)
    assert "usage: opt3dgs lines" in capsys.readouterr().err
