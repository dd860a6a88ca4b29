"""The benchmark of a step: every subject runs, and the page shows rows that it writes."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import pytest
from studies.bench.bench_step import goals_line, main
from studies.bench.steps import BASELINE, COMPARED

DOCS = Path(__file__).resolve().parents[3] / "docs"


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


def test_the_committed_figures_have_the_rows_that_the_page_shows() -> None:
    spec = importlib.util.spec_from_file_location("docs_hooks", DOCS / "hooks.py")
    assert spec is not None
    assert spec.loader is not None
    hooks = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = hooks
    spec.loader.exec_module(hooks)
    made = json.loads((DOCS / "benchmarks" / "step_cpu.json").read_text(encoding="utf-8"))
    for rows in made["results"].values():
        assert set(hooks.STEPS) <= set(rows)
