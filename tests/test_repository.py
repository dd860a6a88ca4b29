"""What the repository says about itself is true."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

import opt3dgs_optim

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_version_is_the_same_everywhere() -> None:
    version = re.escape(opt3dgs_optim.__version__)
    assert re.search(rf"^version: {version}$", (ROOT / "CITATION.cff").read_text(), re.M)
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)
    assert newest is not None
    assert newest[1] == opt3dgs_optim.__version__


def test_public_names() -> None:
    for name in (
        "AWSGLD",
        "LQNAdam",
        "PhaseScheduler",
        "Phase",
        "EnergyHistogram",
        "two_loop",
        "__version__",
    ):
        assert name in opt3dgs_optim.__all__
        assert hasattr(opt3dgs_optim, name)


def test_readme_has_the_two_commands() -> None:
    setup = "python3 -m venv .venv && .venv/bin/pip install -c constraints.txt -e "
    assert f'{setup}".[examples]" && .venv/bin/python examples/error_vs_time.py\n' in README
    assert f'{setup}".[test]" && .venv/bin/python -m pytest\n' in README


@pytest.mark.parametrize("study", ["embedded", "banana"])
def test_readme_figures_are_those_of_the_committed_results(study: str) -> None:
    """Every row of README's table, against the report that its command wrote."""
    report = json.loads((ROOT / "docs" / "results" / study / "report.json").read_text())
    arms = {arm["arm"]: arm for arm in report["scenes"][0]["arms"]}
    section = README.split(f"<!-- {study} -->")[1].split("<!-- end -->")[0]
    rows = re.findall(r"^\| `([^`]+)` \|[^|]*\| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", section, re.M)
    assert len(rows) >= 4
    for name, psnr, seconds, gain in rows:
        arm = arms[name]
        assert psnr.strip() == spread(arm["final"]["psnr"])
        assert seconds.strip() == f"{arm['seconds']['mean']:.1f}"
        found = arm["gain_at_equal_seconds"]
        assert gain.strip() == ("baseline" if found is None else spread(found, sign=True))


def spread(figure: dict, *, sign: bool = False) -> str:
    """A mean with its deviation, as the README prints it."""
    mean = f"{figure['mean']:+.2f}" if sign else f"{figure['mean']:.2f}"
    return f"{mean} ± {figure['std']:.2f}"


def test_relative_links_of_the_readme_exist() -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
