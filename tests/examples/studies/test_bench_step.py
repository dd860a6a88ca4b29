"""The benchmark of a step: every subject runs, and the page shows rows that it writes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from studies.bench import bench_step
from studies.bench.bench_step import CPU, GOALS, MAKES, TOGETHER, goals_line, main, rounds_at
from studies.bench.steps import BASELINE, COMPARED, measure_all
from studies.figures import ROWS, goal_table

DOCS = Path(__file__).resolve().parents[3] / "docs"


@pytest.mark.thorough
def test_every_subject_is_timed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--points", "64", "--repeats", "1", "--out", str(tmp_path)]) == 0
    made = json.loads((tmp_path / "step_cpu.json").read_text(encoding="utf-8"))
    rows = made["results"]["64"]
    assert list(rows) == [BASELINE, *COMPARED]
    assert rows[BASELINE]["per_adam"] == 1.0
    assert rows["defaults, fused"]["baseline"] == "six fused Adams"
    assert all(row["ns_per_point"] > 0 for row in rows.values())
    table = (tmp_path / "step_cpu.md").read_text(encoding="utf-8")
    assert all(f"| {name} |" in table for name in rows)
    assert table in capsys.readouterr().out


def test_what_the_defaults_may_cost_stands_beside_what_they_do() -> None:
    rows = {n: {"defaults": {"per_adam": ratio}} for n, ratio in ((1_000, 1.41), (10_000, 1.15))}
    said = goals_line({**rows, 64: {"defaults": {"per_adam": 9.0}}})
    assert "1,000 points x1.41 of x1.40 (missed), 10,000 points x1.15 of x1.15." in said
    assert "64" not in said
    assert goals_line({64: {"defaults": {"per_adam": 9.0}}}) == ""


def test_more_points_are_measured_by_twos_in_fewer_rounds() -> None:
    assert rounds_at(TOGETHER, 50) == 50
    assert rounds_at(TOGETHER + 1, 50) == 10
    assert rounds_at(TOGETHER + 1, 6) == MAKES  # each of those that are made anew has one
    assert rounds_at(TOGETHER + 1, 1) == 1


def test_what_was_measured_is_written_before_the_next_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(points: int, *_: Any, **__: Any) -> Any:
        if points > 64:
            raise KeyboardInterrupt
        return measure_all(points, CPU, ["six Adams again"], 1)

    monkeypatch.setattr(bench_step, "measure_all", measured)
    monkeypatch.setattr(bench_step, "goals_line", lambda _: "")
    assert main(["--points", "64", "128", "--repeats", "1", "--out", str(tmp_path)]) != 0
    made = json.loads((tmp_path / "step_cpu.json").read_text(encoding="utf-8"))
    assert list(made["results"]) == ["64"]
    assert made["goals"] == {str(points): goal for points, goal in GOALS.items()}


def test_the_committed_figures_have_the_rows_that_the_page_shows() -> None:
    made = json.loads((DOCS / "benchmarks" / "step_cpu.json").read_text(encoding="utf-8"))
    page = (DOCS / "performance.md").read_text(encoding="utf-8")
    prose = re.sub(r"```.*?```|`[^`]*`", "", page, flags=re.S)
    named = set(re.findall(r'"([^"]+)"', prose))
    assert "defaults, steps of a tenth" in named
    for rows in made["results"].values():
        assert set(ROWS) | named <= set(rows)


def test_the_page_says_which_goals_are_reached() -> None:
    rows = {n: {"defaults": {"per_adam": ratio}} for n, ratio in (("1000", 1.41), ("10000", 1.15))}
    made = {"goals": {"1000": 1.4, "10000": 1.15}, "results": rows}
    assert goal_table(made).splitlines()[2:5] == [
        "| goal | 1.40 | 1.15 |",
        "| measured | 1.41 | 1.15 |",
        "|  | missed | reached |",
    ]
