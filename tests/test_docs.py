"""What README and docs/ say is true: code runs, commands exist, pictures have makers, links."""

from __future__ import annotations

import ast
import contextlib
import functools
import html
import importlib.util
import io
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from docs_blocks import DOCS, ROOT, Block, blocks, name, pages, trainer_names, unfenced
from docs_commands import SHELL, check_command, commands
from docs_links import anchors, makes
from trainer_files import SYNTHETIC, added

import opt3dgs_optim
from opt3dgs_optim import hosts

PAGES = pages()
README = ROOT / "README.md"


def of_pages(*languages: str) -> list[Any]:
    """The pages that have blocks of these languages, as test parameters."""
    return [pytest.param(p, id=name(p)) for p in PAGES if blocks(p, *languages)]


def is_excerpt(block: Block) -> bool:
    """Whether a block quotes a file instead of being a program."""
    return "/" in block.title


# -- code ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", of_pages("python"))
def test_python_blocks_run_and_print_what_is_shown(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The blocks of a page run one after the other, in one namespace and an empty folder."""
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {**trainer_names(), "__name__": "docs"}
    printed = None
    try:
        for block in blocks(page):
            if block.language == "python" and not is_excerpt(block):
                printed = io.StringIO()
                if page == README:  # each block is for another trainer
                    namespace |= trainer_names()
                code = compile("\n" * block.line + block.text, name(page), "exec")
                with contextlib.redirect_stdout(printed):
                    exec(code, namespace)
            elif block.title == "prints":
                assert printed is not None, f"line {block.line}: no program before what it prints"
                assert printed.getvalue() == block.text, f"line {block.line}"
                printed = None
    finally:
        if "log" in namespace:
            namespace["log"].close()


@pytest.mark.parametrize("page", of_pages("python"))
def test_what_a_program_prints_is_shown(page: Path) -> None:
    """A block with a bare print() at its margin is followed by what it prints."""
    found = blocks(page)
    for block, following in zip(found, [*found[1:], None], strict=True):
        prints = block.language == "python" and re.search(r"^print\(", block.text, re.M)
        if prints:
            assert following is not None
            assert following.title == "prints", f"{name(page)}, line {block.line}"


@pytest.mark.parametrize("page", of_pages("python"))
def test_excerpts_stand_in_the_source(page: Path) -> None:
    for block in filter(is_excerpt, blocks(page, "python")):
        source = [line.strip() for line in (ROOT / block.title).read_text().splitlines()]
        for part in re.split(r"^\.\.\.\n", block.text, flags=re.M):
            lines = [line.strip() for line in part.strip().splitlines()]
            starts = range(len(source) - len(lines) + 1)
            assert any(source[i : i + len(lines)] == lines for i in starts), (
                f"{name(page)}, line {block.line}: not in {block.title}:\n{part}"
            )


def test_the_algorithm_pages_quote_the_source() -> None:
    for page in ("awsgld", "lqnadam", "two-loop", "phases"):
        assert any(map(is_excerpt, blocks(DOCS / "algorithms" / f"{page}.md", "python"))), page


HOST_PAGES = {kind: "gsplat" if "gsplat" in kind else "inria" for kind in SYNTHETIC}


def statements(page: Path, *, whole: bool = True) -> set[str]:
    """The lines of a page's Python blocks, without comments.

    Not whole: of those above its first section, without Grendel-GS's, which no test has.
    """
    end = len(page.read_text(encoding="utf-8").partition("\n## ")[0].splitlines())
    found = [
        block
        for block in blocks(page, "python")
        if whole or (block.line <= end and "opt_args" not in block.text)
    ]
    lines = "\n".join(block.text for block in found).splitlines()
    return {re.sub(r"\s*#.*", "", line).strip() for line in lines} - {""}


@pytest.mark.parametrize("kind", SYNTHETIC)
def test_host_pages_show_the_lines_that_the_command_writes(kind: str, tmp_path: Path) -> None:
    trainer = tmp_path / "trainer.py"
    trainer.write_text(SYNTHETIC[kind])
    lines = added(hosts.diff(trainer).diff)
    assert set(lines) <= statements(DOCS / "hosts" / f"{HOST_PAGES[kind]}.md")


def test_host_pages_show_no_other_lines(tmp_path: Path) -> None:
    written: dict[str, set[str]] = {}
    for kind, text in SYNTHETIC.items():
        trainer = tmp_path / "trainer.py"
        trainer.write_text(text)
        written.setdefault(HOST_PAGES[kind], set()).update(added(hosts.diff(trainer).diff))
    for page, lines in written.items():
        assert statements(DOCS / "hosts" / f"{page}.md", whole=False) == lines


def test_the_readme_shows_what_the_command_prints(tmp_path: Path) -> None:
    """The lines that change; the lines around them are those of the real file."""
    (shown,) = blocks(README, "diff")
    trainer = tmp_path / "train.py"
    trainer.write_text(SYNTHETIC["3dgs-mcmc"])
    printed = hosts.diff(trainer).diff

    def changed(diff: str) -> list[str]:
        lines = [line for line in diff.splitlines() if re.match(r"[+-](?![+-])", line)]
        return [line.rstrip() for line in lines]

    assert changed(shown.text) == changed(printed)


@pytest.mark.parametrize(
    ("title", "kind"),
    [
        ("**3dgs-mcmc** and", "3dgs-mcmc"),
        ("**INRIA's gaussian-splatting**", "inria"),
        ("**gsplat**, `simple_trainer.py`", "gsplat"),
    ],
)
def test_the_readme_has_the_lines_of_each_trainer(title: str, kind: str, tmp_path: Path) -> None:
    """The calls that the command writes there, and no parts, which the scheduler chooses."""
    text = README.read_text(encoding="utf-8")
    block = re.search(re.escape(title) + r".*?^```python\n(.*?)^```", text, re.M | re.S)
    assert block is not None
    tree = ast.parse(block[1])
    calls = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    trainer = tmp_path / "train.py"
    trainer.write_text(SYNTHETIC[kind])
    written = " ".join(added(hosts.diff(trainer).diff))
    for call in calls:
        if not call.startswith("PhaseScheduler"):
            assert call in written, f"{call} is not in {written}"
    (made,) = [call for call in calls if call.startswith("PhaseScheduler")]
    assert "parts" not in made
    total = re.search(r"PhaseScheduler\((?:total_steps=)?([\w.]+)", made)
    assert total is not None
    assert f"PhaseScheduler({total[1]}" in written
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    imported = {a.name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names}
    assert names & set(opt3dgs_optim.__all__) <= imported


# -- commands --------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", of_pages(*SHELL))
def test_commands_exist_with_their_options(page: Path) -> None:
    for block in blocks(page, *SHELL):
        for words in commands(block):
            check_command(words)


@pytest.mark.parametrize(
    "line",
    [
        "python -m opt3dgs_optim.no_such_module",
        "opt3dgs hosts diff PATH --no-such-option",
        "opt3dgs report runs --no-such-option",
        "python examples/no_such_file.py",
        "python examples/train.py --no-such-option",
        "pip install .[no_such_extra]",
        "pip install another_package",
        "ns-train no-such-method",
        "no-such-program",
    ],
)
def test_wrong_commands_are_noticed(line: str) -> None:
    with pytest.raises((AssertionError, ModuleNotFoundError)):
        check_command(shlex.split(line))


def test_every_block_is_checked_by_something() -> None:
    for page in PAGES:
        for block in blocks(page):
            known = block.language in ("python", *SHELL) or block.title == "prints"
            known |= page == README and block.language in ("diff", "bibtex")
            known |= block.language in ("yaml", "text") and "lightning" in page.name
            assert known, f"{name(page)}, line {block.line}: nothing checks a {block.language!r}"


@pytest.mark.parametrize("page", of_pages("yaml"))
def test_configurations_name_classes_that_exist(page: Path) -> None:
    for block in blocks(page, "yaml"):
        (path,) = re.findall(r"class_path: (\S+)", block.text)
        module, _, wanted = path.rpartition(".")
        spec = importlib.util.find_spec(module)
        assert spec is not None
        assert spec.origin is not None
        assert f"class {wanted}" in Path(spec.origin).read_text(encoding="utf-8")


# -- pictures and links ----------------------------------------------------------------------------

NEAR = 60  # lines between a picture and the command that makes it


@pytest.mark.parametrize("page", [pytest.param(p, id=name(p)) for p in PAGES])
def test_pictures_exist_and_their_command_is_named(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    lines = text.splitlines()
    for match in re.finditer(r"!\[[^\]]*\]\(([^)\s]+)\)", unfenced(text)):
        picture = page.parent / match[1]
        assert picture.is_file(), match[1]
        at = unfenced(text).count("\n", 0, match.start())
        near = "\n".join(lines[max(0, at - NEAR) : at + NEAR])
        named = re.findall(r"\bexamples/[\w/]+\.py\b", near)
        makers = [maker for maker in named if (ROOT / maker).is_file()]  # or a trainer's own
        assert makers, f"{match[1]}: no command of examples/ within {NEAR} lines"
        assert any(makes(maker, picture) for maker in makers), f"{match[1]}: not by {makers}"


@pytest.mark.parametrize("page", [pytest.param(p, id=name(p)) for p in PAGES])
def test_relative_links_lead_somewhere(page: Path) -> None:
    text = unfenced(page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\((?!\w+:)([^)\s]+)\)", text):
        file, _, anchor = target.partition("#")
        found = page.parent / file if file else page
        assert found.exists(), f"{name(page)}: {target}"
        is_object = anchor.startswith("opt3dgs_optim.")  # mkdocstrings'; the strict build looks
        if anchor and found.suffix == ".md" and not is_object:
            assert anchor in anchors(found), f"{name(page)}: {target}"


def test_pages_of_the_site_link_within_docs() -> None:
    """mkdocs knows docs/ only: other files are named, not linked."""
    for page in PAGES:
        if DOCS in page.parents:
            for target in re.findall(r"\]\((?!\w+:)([^)#\s]+)", unfenced(page.read_text())):
                assert DOCS in (page.parent / target).resolve().parents, f"{name(page)}: {target}"


def test_every_public_name_is_in_the_reference() -> None:
    shown = set(re.findall(r"^::: (\S+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.M))
    # By its long name: the short one is a module's, too, all of whose helpers would be shown.
    assert "opt3dgs_optim.two_loop" not in shown
    shown |= {name.replace("lbfgs.two_loop.", "") for name in shown}
    names = {f"opt3dgs_optim.{public}" for public in opt3dgs_optim.__all__}
    assert names - shown == {"opt3dgs_optim.__version__"}


# -- what the build does besides Markdown ----------------------------------------------------------


@functools.cache
def build_hooks() -> Any:
    """docs/hooks.py, which is no package's."""
    spec = importlib.util.spec_from_file_location("docs_hooks", DOCS / "hooks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_the_pages_ask_the_build_for_is_there() -> None:
    included = []
    for page in PAGES:
        included += re.findall(r'^--8<-- "(.+)"$', page.read_text(encoding="utf-8"), re.M)
    assert len(included) >= 2
    assert all((ROOT / path).is_file() for path in included)


@pytest.mark.parametrize(
    ("text", "bad"),
    [
        ('<script src="https://cdn.example/x.js"></script>', True),
        ('<link rel="stylesheet" href="//fonts.example/css">', True),
        ("<link href=https://fonts.example rel=preconnect>", True),
        ("@import 'https://x.example/a.css';", True),
        ("a { background: url(//x.example/a.png) }", True),
        ('<img src="https://x.example/a.png">', True),
        ('<a href="https://arxiv.org/abs/2511.13571">', False),
        ('<link rel="canonical" href="https://x.example/">', False),
        ('<img src="results/a.png"><script src="assets/a.js"></script>', False),
    ],
)
def test_what_would_come_from_the_net_is_found(text: str, bad: bool) -> None:
    assert bool(build_hooks().fetched(text)) is bad


def test_formulas_become_mathml() -> None:
    pytest.importorskip("latex2mathml", reason="latex2mathml is not installed: the extra docs")
    made = build_hooks().on_page_content('<p><span class="arithmatex">\\(a &lt; b\\)</span></p>')
    assert made.startswith("<p><math")
    assert "<mo><</mo>" in html.unescape(made)


@pytest.mark.parametrize(("columns", "narrow"), [(2, False), (10, False), (11, True)])
def test_a_table_of_many_columns_has_narrow_ones(columns: int, narrow: bool) -> None:
    heads = "".join(f"<th style='x'>{i}</th>\n" for i in range(columns))
    table = f"<table>\n<thead>\n<tr>\n{heads}</tr>\n</thead>\n<tbody></tbody>\n</table>"
    assert ("<table data-wide>" in build_hooks().on_page_content(table)) is narrow
