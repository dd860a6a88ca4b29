"""What the repository says about itself is true."""

from __future__ import annotations

import importlib.metadata
import json
import re
from pathlib import Path

import pytest

import opt3dgs_optim

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_last_release_is_the_same_everywhere() -> None:
    """Of the changelog, the citation, and what a build without git's tags counts from."""
    releases = re.findall(r"^## (\d\S+) - \d{4}-", (ROOT / "CHANGELOG.md").read_text(), re.M)
    version = re.escape(releases[0])
    assert re.search(rf"^version: {version}$", (ROOT / "CITATION.cff").read_text(), re.M)
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert re.search(rf'^fallback-version = "{version}"', project, re.M)


def test_version_is_what_is_installed() -> None:
    """No file of the package says a version: it comes from git's tags by way of the build."""
    assert opt3dgs_optim.__version__ == importlib.metadata.version("opt3dgs_optim")
    for path in (ROOT / "src").rglob("*.py"):
        found = re.search(r'__version__ = "(\d.*)"', path.read_text(encoding="utf-8"))
        assert found is None or found[1] == "0+unknown", path.name


def test_citation_is_complete() -> None:
    """The keys that Citation File Format 1.2.0 asks for, and the paper."""
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    top = dict(re.findall(r"^([a-z-]+):[ ]?(.*)$", "\n".join(lines), re.M))
    assert top["cff-version"] == "1.2.0"
    assert top["type"] == "software"
    for key in ("message", "title", "abstract"):
        assert top[key].strip("\"'"), key
    assert re.fullmatch(r"\d{4}-\d{2}-\d{2}", top["date-released"])
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert f'license = "{top["license"]}"' in project
    assert f'name = "{top["title"]}"' in project
    authors = re.findall(r"^  - name: (.+)$", "\n".join(lines), re.M)
    assert authors
    assert all(f'name = "{author}"' in project for author in authors)
    assert any("2511.13571" in line for line in lines)
    # Every line is a key, a list item or a comment, and no plain value holds ": ", so that any
    # YAML reader takes it for what it is meant to be.
    for line in lines:
        found = re.fullmatch(r"[ ]*(?:- )?[a-z-]+:(?: (.*))?", line)
        assert found, line
        value = found[1] or ""
        assert value[:1] in ("'", '"') or ": " not in value, line


def test_citation_parses_as_yaml() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert str(cited["version"]) in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert cited["authors"]
    (paper,) = cited["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Huang", "Chen", "Liu", "Ji"]


def test_the_declared_torch_is_the_oldest_that_the_command_tries() -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    command = (ROOT / "examples" / "check_torch_versions.py").read_text(encoding="utf-8")
    declared = re.search(r'"torch>=(\d+\.\d+)"', project)
    tried = re.search(r'^OLDEST, NEWEST = "([\d.]+)", "([\d.]+)"$', command, re.M)
    assert declared is not None
    assert tried is not None
    assert tried[1].rpartition(".")[0] == declared[1]
    assert f"PyTorch {declared[1]} or newer" in README


# -- what it is, in every place where that stands --------------------------------------------------

WORDS_OF_PARTS = {  # how the identity names each part of the defaults
    "Fading": "fading of Adam's moments",
    "OutOfView": "a hold on points out of view",
    "Averaging": "the average of the last iterates",
    "OwnFrame": "steps in each Gaussian's own frame",
}


def plain(text: str) -> str:
    """Without Markdown's marks, on one line."""
    return " ".join(text.replace("`", "").split())


def identities() -> dict[str, str]:
    """What the project says that it is, by the file."""
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    found = {
        "pyproject.toml": re.search(r'^description = "(.+)"$', project, re.M),
        "mkdocs.yml": re.search(r'^site_description: "(.+)"$', site, re.M),
        "CITATION.cff": re.search(r'^abstract: "(.+)"$', citation, re.M),
        "README.md": re.match(r"# opt3dgs_optim\n\n(.+?)\n\n!\[", README, re.S),
        "docs/index.md": re.match(r"# opt3dgs_optim\n\n(.+?)\n\n!\[", index, re.S),
    }
    texts = {name: plain(match[1]) if match else "" for name, match in found.items()}
    return {**texts, "__init__": plain(opt3dgs_optim.__doc__ or "")}


@pytest.mark.parametrize("name", identities())
def test_the_identity_is_the_same_everywhere(name: str) -> None:
    assert identities()[name] == plain(opt3dgs_optim.__doc__ or "")


def test_the_identity_names_the_defaults_and_nothing_else() -> None:
    said = plain(opt3dgs_optim.__doc__ or "")
    on = {type(part).__name__ for part in opt3dgs_optim.DEFAULTS}
    named = {part for part, words in WORDS_OF_PARTS.items() if words in said}
    assert named == on
    for name in ("Opt3DGS (AAAI 2026", "AWSGLD", "LQNAdam", "PhaseScheduler"):
        assert name in said
    assert len(said) < 512  # what a package index takes


def test_the_titles_are_the_name() -> None:
    for page in ("README.md", "docs/index.md"):
        assert (ROOT / page).read_text(encoding="utf-8").startswith("# opt3dgs_optim\n")
    assert "site_name: opt3dgs_optim\n" in (ROOT / "mkdocs.yml").read_text(encoding="utf-8")


# -- the README ------------------------------------------------------------------------------------


def test_readme_has_the_two_commands() -> None:
    setup = "python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e "
    assert f'{setup}".[examples]" && .venv/bin/python examples/error_vs_time.py\n' in README
    assert f'{setup}".[test]" && .venv/bin/python -m pytest\n' in README


def test_readme_says_first_what_a_reader_asks_first() -> None:
    """Its tables are compared with the records in the study's own tests."""
    order = [
        *("PyTorch optimizers for", "](docs/results/front.png)", "run on a GPU yet"),
        *("pip install .", "opt3dgs hosts diff train.py", "## Use the optimizers directly"),
        *("<!-- study:headline -->", "### What it does not buy", "Tuned learning rates"),
        *("<!-- study:paper-brief -->", "examples/error_vs_time.py\n", "-m pytest\n"),
        *("docs/index.md", "@inproceedings", "@software"),
    ]
    places = [README.index(words) for words in order]
    assert places == sorted(places)


PRIVATE = ("melt", "lent", "less the same", "of its seconds", "REPOSITORY_URL", " arm ", " arms ")


def test_readme_needs_no_inside_knowledge() -> None:
    """Between the markers the study's own command writes; its words are tested there."""
    text = re.sub(r"<!-- study:.*?<!-- end -->|```.*?```", "", README, flags=re.S)
    assert [word for word in PRIVATE if word in text] == []
    assert re.findall(r"(?<![\d\w.])\.\d+", text) == []  # 0.5, not .5


def test_readme_lines_fit_a_phone() -> None:
    """Of code that people copy: the lines for trainers and the optimizers' own."""
    for block in re.findall(r"^```python\n(.*?)^```", README, re.M | re.S):
        assert [line for line in block.splitlines() if len(line) > 62] == []


def test_the_bibtex_is_that_of_the_citation_file() -> None:
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    version = re.search(r"^version: (.+)$", cited, re.M)
    assert version is not None
    assert f"version = {{{version[1]}}}" in README
    for family in re.findall(r"family-names: (.+)", cited):
        assert f"{family}, " in README
    title = re.search(r'title: "(.+)"', cited)
    assert title is not None
    assert title[1] in plain(README)
    assert "arXiv:2511.13571" in README


def test_readme_picture_is_that_of_its_record() -> None:
    record = json.loads((ROOT / "docs" / "results" / "front.json").read_text(encoding="utf-8"))
    assert record["command"] in README
    stock, ours = record["curves"].values()
    assert max(stock["psnr"]) < max(ours["psnr"])
    assert 0 < record["seconds_to_stock_psnr"] < stock["seconds"][-1]


def test_relative_links_of_the_readme_exist() -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
