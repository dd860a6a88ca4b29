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


def test_the_declared_torch_is_the_oldest_tested() -> None:
    """`docs/torch_versions.json` is what examples/check_torch_versions.py last found."""
    path = ROOT / "docs" / "torch_versions.json"
    if not path.exists():
        pytest.skip(f"no {path.name} yet: python examples/check_torch_versions.py")
    record = json.loads(path.read_text(encoding="utf-8"))
    results = record["results"]
    assert all(result["failed"] == result["error"] == 0 for result in results)
    assert all(result["passed"] > 1000 for result in results)
    tested = [tuple(map(int, r["torch"].split("+")[0].split(".")))[:2] for r in results]
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    declared = re.search(r'"torch>=(\d+)\.(\d+)"', project)
    assert declared is not None
    assert min(tested) == (int(declared[1]), int(declared[2]))
    assert max(tested) > min(tested)


def test_the_install_line_has_the_address_of_the_project() -> None:
    """REPOSITORY_URL, as long as there is no public one."""
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    source = re.search(r'^Source = "(.+)"', project, re.M)
    address = source[1] if source else "REPOSITORY_URL"
    assert f"\npip install git+{address}\n" in README


def test_readme_has_the_two_commands() -> None:
    setup = "python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e "
    assert f'{setup}".[examples]" && .venv/bin/python examples/error_vs_time.py\n' in README
    assert f'{setup}".[test]" && .venv/bin/python -m pytest\n' in README


def test_readme_is_short() -> None:
    assert len(README.split()) <= 600


def test_readme_says_the_limits_before_the_install_line() -> None:
    """Its table is compared with the records in the study's own tests."""
    assert "<!-- study:headline -->" in README
    assert README.index("run on a GPU yet") < README.index("pip install")


def test_readme_picture_is_that_of_its_record() -> None:
    record = json.loads((ROOT / "docs" / "results" / "front.json").read_text(encoding="utf-8"))
    assert record["command"] in README
    stock, ours = record["curves"].values()
    assert max(stock["psnr"]) < max(ours["psnr"])
    assert record["seconds_to_stock_psnr"] < stock["seconds"][-1]


def test_relative_links_of_the_readme_exist() -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
