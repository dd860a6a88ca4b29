"""What the repository says about itself agrees."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def test_last_release_is_the_same_everywhere() -> None:
    """Of the changelog, the citation, the BibTeX, and what a build without tags counts from."""
    version = re.escape(re.findall(r"^## (\d\S+) - \d{4}-", text_of("CHANGELOG.md"), re.M)[0])
    assert re.search(rf"^version: {version}$", text_of("CITATION.cff"), re.M)
    assert re.search(rf'^fallback-version = "{version}"', text_of("pyproject.toml"), re.M)
    assert re.search(rf"version = \{{{version}\}}", README)


def test_citation_parses_as_yaml() -> None:
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed: the extra dev")
    cited = yaml.safe_load(text_of("CITATION.cff"))
    for key in ("cff-version", "message", "title", "authors", "date-released", "license"):
        assert cited[key]
    (paper,) = cited["references"]
    assert [author["family-names"] for author in paper["authors"]] == ["Huang", "Chen", "Liu", "Ji"]


def test_ci_runs_the_test_command_of_the_readme() -> None:
    (command,) = re.findall(r"^.* -m pytest.*$", README, re.M)
    assert command in text_of(".ci/run").splitlines()


def test_constraints_name_what_the_project_names() -> None:
    """One line for a Python version, and nothing that another package chooses."""
    project = text_of("pyproject.toml").lower()
    lines = [line for line in text_of("constraints.txt").splitlines() if line[:1] not in ("#", "")]
    for line in lines:
        pin = re.fullmatch(r'([\w-]+)==[\w.]+(; python_version (?:>=|<) "3\.11")?', line)
        assert pin, line
        assert pin[1] in (*re.findall(r'"([\w-]+)', project), "mkdocs"), line
    for name in {line.split("==")[0] for line in lines}:
        own = sorted(
            line.partition("; python_version ")[2] for line in lines if line.startswith(f"{name}==")
        )
        assert own in ([""], ['< "3.11"', '>= "3.11"']), name
