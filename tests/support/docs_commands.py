"""Whether a command of a page exists, with the options that it is shown with."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import io
import os
import re
import runpy
import shlex
import sys

import pytest
from docs_blocks import ROOT, Block

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomllib", reason="to read pyproject.toml: Python 3.11 or newer")

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
SHELL = ("sh", "bash", "console")  # languages of fences


def commands(block: Block) -> list[list[str]]:
    """The words of every command of a shell block, of chains too."""
    found = []
    for line in block.text.replace("\\\n", " ").splitlines():
        for command in line.split("&&"):
            words = shlex.split(command, comments=True)
            if words:
                found.append(words)
    return found


@functools.cache
def help_of(*command: str) -> str:
    """What `python COMMAND --help` prints, "" if nothing. In this process: torch is there."""
    printed, kept = io.StringIO(), (sys.argv, sys.path[:])
    words = list(command)
    try:
        with contextlib.redirect_stdout(printed), contextlib.suppress(SystemExit):
            if words[0] == "-m":
                name = "opt3dgs_optim.__main__" if words[1] == "opt3dgs_optim" else words[1]
                importlib.import_module(name).main([*words[2:], "--help"])
            else:
                sys.argv = [*words, "--help"]
                runpy.run_path(str(ROOT / words[0]), run_name="__main__")
    finally:
        sys.argv, sys.path[:] = kept
    return printed.getvalue()


def check_python(words: list[str]) -> None:
    """`python ...`: a module or script that exists and has the options."""
    if words[0] == "-c":
        compile(words[1], "-c", "exec")
        return
    if words[0] == "-m":
        start, rest = words[:2], words[2:]
        assert importlib.util.find_spec(words[1]) is not None, words
        if not words[1].startswith("opt3dgs_optim"):  # pytest, venv, http.server: not ours
            return
    else:
        start, rest = words[:1], words[1:]
        assert (ROOT / words[0]).is_file(), words
    if not any(word.startswith("-") for word in rest):
        return
    while re.fullmatch(r"[a-z]+", rest[0]) and help_of(*start, rest[0]):
        start, rest = [*start, rest[0]], rest[1:]  # a subcommand with a help of its own
    known = set(re.findall(r"(?<![\w-])--?[\w-]+", help_of(*start)))
    for word in rest:
        if word.startswith("-"):
            assert word.partition("=")[0] in known, f"{words}: {word} is no option"


def check_install(words: list[str]) -> None:
    """`pip install ...`: this package with extras that it has, constraints that exist."""
    assert words[0] == "install", words
    for word in words[1:]:
        extras = re.fullmatch(r"(?:\.|opt3dgs_optim)(?:\[([\w,]+)\])?", word)
        if extras:
            extra = set(filter(None, (extras[1] or "").split(",")))
            assert extra <= set(PROJECT["optional-dependencies"]), word
        elif not word.startswith(("-", "git+")):
            assert (ROOT / word).is_file(), f"{words}: {word} is neither this package nor a file"


def check_command(words: list[str]) -> None:
    program, rest = words[0].removeprefix(".venv/bin/"), words[1:]
    if program in ("python", "python3"):
        check_python(rest)
    elif program in PROJECT["scripts"]:
        module = PROJECT["scripts"][program].partition(":")[0]
        check_python(["-m", module.removesuffix(".__main__"), *rest])
    elif program == "pip":
        check_install(rest)
    elif program == "ns-train":  # nerfstudio's, with our methods
        methods = PROJECT["entry-points"]["nerfstudio.method_configs"]
        assert rest[0] in methods, words
    elif program == "git":  # in a trainer's repository
        return
    elif program in ("ruff", "pyright", "mkdocs"):
        extras = PROJECT["optional-dependencies"]
        assert any(r.startswith(program) for r in extras["test"] + extras["dev"]), words
    else:
        path = ROOT / words[0]
        assert path.is_file() and os.access(path, os.X_OK), f"{words}: no such program"  # noqa: PT018
