"""docs/hosts/survey.md: every trial has a row, and the long list is folded away."""

from __future__ import annotations

import json

from hosts.survey import PAGE, Script, page
from hosts.trials import TRIALS

TRIED = json.loads(PAGE.with_suffix(".json").read_text(encoding="utf-8"))


def test_every_trial_was_run() -> None:
    assert [row["name"] for row in TRIED["rows"]] == [trial.name for trial in TRIALS]
    assert all(row["commit"] and row["date"] and row["torch"] for row in TRIED["rows"])


def test_the_table_comes_first_and_the_scripts_are_folded() -> None:
    rows = [
        Script("3dgs-mcmc", "train.py", "7b4fc9f", True, "", 5),
        Script("other", "train.py", "1234567", False, "no <loop> | none", 0),
    ]
    text = page(rows, TRIED)
    tried, folded = text.split("<details")
    for column in ("commit", "lines of `diff`", "stock", "edited", "saved", "resumed"):
        assert f"| {column} |" in tried
    (mcmc,) = [line for line in tried.splitlines() if line.startswith("| 3dgs-mcmc")]
    assert "| 7b4fc9f (2025-01-01) | 5 |" in mcmc
    assert " dB" not in tried.split("## What ran")[1]  # a hundred iterations say nothing of quality
    assert "| none needed |" in tried  # nerfstudio
    assert "| `3dgs-mcmc/train.py@7b4fc9f` | nothing |" in folded
    assert "| `other/train.py@1234567` | **refused**: no &lt;loop> \\| none |" in folded
    assert folded.count("</details>") == 1


def test_the_committed_page_shows_the_committed_trainings() -> None:
    written = PAGE.read_text(encoding="utf-8").splitlines()
    for line in page([], TRIED).partition("<details")[0].splitlines():
        if line.startswith("| "):
            name, commit, _, *rest = line.strip("| ").split(" | ")
            assert any(
                other.startswith(f"| {name} | {commit} |")
                and other.endswith(" | ".join(rest) + " |")
                for other in written
            ), line
