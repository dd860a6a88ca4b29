"""The stability study's page says what its measurements say, and they say enough."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mutants import TARGETS, reasons_of_the_committed_run, survivor_key
from studies import pages
from studies.stability import stability, stability_page

DOCS = Path(__file__).resolve().parents[3] / "docs"
FOLDER = DOCS / "results/stability"


def result(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.json").read_text())


def test_tables_are_those_of_the_measurements() -> None:
    assert stability.report(result("stability")) in (FOLDER / "stability.md").read_text()


def filled(page: str) -> str:
    texts = stability_page.texts(FOLDER, stability.report(result("stability")))
    return pages.filled(page, texts, stability_page.MARK)


def test_page_is_that_of_the_measurements() -> None:
    page = (FOLDER / "stability.md").read_text()
    assert filled(page) == page


def test_a_changed_figure_shows() -> None:
    page = (FOLDER / "stability.md").read_text()
    coverage = stability_page.coverage_block(result("coverage"))
    assert coverage in page
    assert filled(page.replace(coverage, "99.9 %")) == page
    with pytest.raises(ValueError, match="0 places for 'tables'"):
        filled("an empty page")


def test_every_arm_is_measured_over_iterations_and_seconds() -> None:
    measured = result("stability")
    kinds = [measured[kind].values() for kind in ("problems", "valleys", "quadratics")]
    for courses in itertools.chain(*kinds):
        assert set(courses) == set(stability.ARMS)
        for course in courses.values():
            iterations, seconds, errors = zip(*course, strict=True)
            assert list(iterations) == sorted(iterations)
            assert list(seconds) == sorted(seconds)
            assert min(errors) > 0


@pytest.mark.processes
def test_the_command_finds_the_tests_problems() -> None:
    """Started by itself: pytest has more folders on its path."""
    words = [sys.executable, stability.__file__, "--help"]
    assert "--tables" in subprocess.run(words, capture_output=True, text=True, check=True).stdout


def test_what_failed_and_gaps_are_listed() -> None:
    slow, mutants = result("slow"), result("mutants")
    slow["tests"][0]["outcome"] = "failure"
    assert f"| `{slow['tests'][0]['test']}` | failure |" in stability_page.slow_block(slow)
    name, entry = next((n, e) for n, e in mutants["modules"].items() if e["survivors"])
    entry["survivors"][0] |= {"before": "x < nowhere", "after": "x > nowhere", "why": ""}
    text = stability_page.mutants_block(mutants)
    assert "1 are gaps" in text
    assert f"| `{name}` " in text
    assert "| `x < nowhere` | `x > nowhere` |" in text


@pytest.mark.parametrize(
    ("dates", "said"),
    [("3", "run 3 ("), ("33", "run 3 ("), ("42", "run 2 to 4 ("), ("243", "run 2 to 4 (")],
)
def test_modules_may_be_of_several_days(dates: str, said: str) -> None:
    entry = {"mutants": 5, "killed": 5, "survivors": []}
    modules = {f"{i}.py": {**entry, "date": date} for i, date in enumerate(dates)}
    assert said in stability_page.mutants_block({"about": {"machine": "M"}, "modules": modules})


def test_long_tests_passed() -> None:
    tests = result("slow")["tests"]
    assert {test["outcome"] for test in tests} == {"passed"}
    for wanted in ("million", "long", "ManyRowEdits", "ten thousand", "inductor", "millions"):
        assert any(wanted in test["test"] for test in tests), wanted


def test_coverage_is_enough() -> None:
    whole = stability_page.total(result("coverage")["modules"])
    for kind in ("branches", "statements"):
        assert stability_page.share(whole, kind) >= stability_page.LEAST_COVERAGE


def test_mutants_are_noticed_and_survivors_explained() -> None:
    modules = result("mutants")["modules"]
    if set(modules) != set(TARGETS):
        pytest.skip("mutants.json is of other modules than today's: run python tests/mutants.py")
    many = sum(entry["mutants"] for entry in modules.values())
    assert sum(entry["killed"] for entry in modules.values()) >= 0.9 * many
    for name, entry in modules.items():
        assert entry["mutants"] - entry["killed"] == len(entry["survivors"])
        for one in entry["survivors"]:
            assert reasons_of_the_committed_run()[(name, *survivor_key(one))], one
