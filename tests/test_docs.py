"""What README and docs/ say holds: code runs, commands exist, links lead somewhere."""

from __future__ import annotations

import contextlib
import doctest
import importlib
import importlib.util
import io
import pkgutil
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from docs_blocks import DOCS, ROOT, anchors, blocks, name, pages, unfenced
from docs_commands import SHELL, check_command, commands

import opt3dgs_optim

PAGES = pages()
README = ROOT / "README.md"
MODULES = [each.name for each in pkgutil.walk_packages(opt3dgs_optim.__path__, "opt3dgs_optim.")]
OF_OTHERS = ("hosts.nerfstudio", "hosts.lightning", "__main__")  # import what only their users have


def of_pages(*languages: str) -> list[Any]:
    """The pages that have blocks of these languages, as test parameters."""
    return [pytest.param(p, id=name(p)) for p in PAGES if blocks(p, *languages)]


# -- code ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", of_pages("python"))
def test_python_blocks_run_and_print_what_is_shown(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The blocks of a page run one after the other, in one namespace and an empty folder."""
    monkeypatch.chdir(tmp_path)
    means = torch.nn.Parameter(torch.ones(4, 3))
    optimizers = {"means": torch.optim.Adam([means])}  # README's first block is of a trainer
    namespace: dict[str, Any] = {"__name__": "docs", "total_steps": 9, "optimizers": optimizers}
    printed = io.StringIO()
    try:
        for block in blocks(page):
            if block.language == "python":
                assert printed.getvalue() == "", f"line {block.line}: not shown what is printed"
                code = compile("\n" * block.line + block.text, name(page), "exec")
                with contextlib.redirect_stdout(printed):
                    exec(code, namespace)
            elif block.title == "prints":
                assert printed.getvalue() == block.text, f"line {block.line}"
                printed = io.StringIO()
        assert printed.getvalue() == ""
    finally:
        if "log" in namespace:
            namespace["log"].close()


@pytest.mark.parametrize("module", [m for m in MODULES if not m.endswith(OF_OTHERS)])
def test_examples_of_docstrings_run(module: str) -> None:
    assert doctest.testmod(importlib.import_module(module)).failed == 0


# -- commands --------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", of_pages(*SHELL))
def test_commands_exist_with_their_options(page: Path) -> None:
    for block in blocks(page, *SHELL):
        for words in commands(block):
            check_command(words)


# -- links -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", [pytest.param(p, id=name(p)) for p in PAGES])
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!\w+:)([^)\s]+)\)", unfenced(text)):
        file, _, anchor = target.partition("#")
        found = page.parent / file if file else page
        assert found.exists(), f"{name(page)}: {target}"
        is_object = anchor.startswith("opt3dgs_optim.")  # mkdocstrings'; the strict build looks
        if anchor and found.suffix == ".md" and not is_object:
            assert anchor in anchors(found), f"{name(page)}: {target}"
        # mkdocs knows docs/ only: a page there names other files and does not link them.
        assert DOCS not in page.parents or DOCS in found.resolve().parents, target
    for path in re.findall(r'^--8<-- "(.+)"$', text, re.M):
        assert (ROOT / path).is_file(), f"{name(page)}: {path}"


def test_tests_that_pages_name_exist() -> None:
    """Files, and functions in one of the files that the section names."""
    for page in PAGES:
        for section in page.read_text(encoding="utf-8").split("\n## "):
            files = [ROOT / path for path in re.findall(r"`(tests/[\w/.]+\.py)`", section)]
            code = "".join(path.read_text(encoding="utf-8") for path in files)
            for test in re.findall(r"`(test_\w+)`", section):
                assert f"\ndef {test}(" in code, f"{name(page)}: {test}"


def test_every_public_name_is_in_the_reference() -> None:
    shown = set(re.findall(r"^::: (\S+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.M))
    # By its long name: the short one is a module's, too, all of whose helpers would be shown.
    shown |= {each.replace("lbfgs.two_loop.", "") for each in shown}
    names = {f"opt3dgs_optim.{public}" for public in opt3dgs_optim.__all__}
    assert names - shown == {"opt3dgs_optim.__version__"}


# -- what the build does besides Markdown ----------------------------------------------------------


def build_hooks() -> Any:
    """docs/hooks.py, which is no package's."""
    spec = importlib.util.spec_from_file_location("docs_hooks", DOCS / "hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_formulas_become_mathml() -> None:
    pytest.importorskip("latex2mathml", reason="latex2mathml is not installed: the extra dev")
    made = build_hooks().on_page_content('<p><span class="arithmatex">\\(a &lt; b\\)</span></p>')
    assert made.startswith("<p><math")
