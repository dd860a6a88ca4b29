"""The advice from pilots: arithmetic, command line on a tiny scene, committed output."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import advise
import pytest
from advising.pilots import Pilot, PilotOptions, finished, steps_of, train
from advising.verdicts import (
    DOES_NOT,
    PAYS,
    UNDECIDED,
    Row,
    as_json,
    as_row,
    best_peak,
    caveats,
    compare,
    settings,
    table,
    verdict,
)

from opt3dgs_optim import PhaseScheduler

ROOT = Path(__file__).resolve().parents[1]
TINY = ["--iterations", "12", "--points", "30", "--seeds", "2", "--jobs", "1"]
COMMITTED = sorted((ROOT / "docs" / "results" / "advise").glob("*.json"))


@pytest.mark.parametrize(
    ("gain", "spread", "expected"),
    [
        (1.0, 0.4, PAYS),
        (1.0, 0.5, UNDECIDED),  # exactly twice is not more than twice
        (1.0, None, UNDECIDED),
        (0.0, 0.0, DOES_NOT),
        (0.02, 0.01, DOES_NOT),  # certainly less than 0.05 dB
        (0.02, 0.001, DOES_NOT),
        (0.06, 0.02, PAYS),
        (-0.5, 0.2, DOES_NOT),
        (-0.5, 0.4, UNDECIDED),
        (0.02, 0.02, UNDECIDED),
    ],
)
def test_a_gain_must_exceed_twice_its_spread(
    gain: float, spread: float | None, expected: str
) -> None:
    assert verdict(gain, spread) == expected


def result(psnr: float, ms: float = 10.0, held: float = 100.0) -> dict[str, Any]:
    return {
        "psnr": psnr,
        "ms_before_switch": ms,
        "ms_after_switch": 2 * ms,
        "state_bytes_per_point": held,
    }


def test_a_row_is_paired_by_seed() -> None:
    runs = [result(20.5, 11, 260), result(25.7, 13, 260), result(30.6, 90, 260)]
    controls = [result(20.0), result(25.0), result(30.0)]
    row = compare("part", "control", runs, controls, last_phase=True)
    assert row.gain == pytest.approx(0.6)
    assert row.spread == pytest.approx(0.1)  # not the five dB between the seeds
    assert row.milliseconds == pytest.approx(6.0)  # 2 * 13 - 2 * 10, the median, in the last phase
    assert row.bytes_per_point == 160
    assert row.verdict == PAYS
    whole = compare("part", "control", runs, controls)
    assert whole.milliseconds == pytest.approx((3 + 6) / 2)
    assert compare("part", "control", runs[:1], controls[:1]).verdict == UNDECIDED


def row(part: str, verdict: str, gain: float = 1.0) -> Row:
    return Row(part, "control", gain, 0.1, (gain,), 0.0, 0.0, verdict)


def test_the_best_peak_must_pay() -> None:
    rows = {2.0: row("a", PAYS, 0.5), 4.0: row("b", PAYS, 0.9), 8.0: row("c", UNDECIDED, 3.0)}
    assert best_peak(rows) == 4.0
    assert best_peak({2.0: row("a", UNDECIDED)}) == 0.0


@pytest.mark.parametrize("peak", [0.0, 4.0])
@pytest.mark.parametrize(
    "paying",
    [(), ("fading",), ("pooling",), ("multiplier", "reset"), ("curvature",), ("squared loss",)],
)
def test_the_settings_can_be_pasted(paying: tuple[str, ...], peak: float) -> None:
    rows = [row(part, PAYS) for part in paying] + [row("noise", DOES_NOT)]
    scope: dict[str, Any] = {}
    exec(settings(peak, rows, 6000), scope)
    phases: PhaseScheduler = scope["phases"]
    assert (phases.annealing is not None) == (peak > 0)
    assert (phases.fading is not None) == ("fading" in paying)
    assert (phases.pooling is not None) == ("pooling" in paying)
    assert (phases.multiplier is not None) == ("multiplier" in paying)
    assert phases.curvature == ("curvature" in paying)
    assert phases.squared_loss == ("squared loss" in paying)
    last = {"reset", "curvature", "squared loss"} & set(paying)
    assert phases.reset_moments == bool(last)  # their control had fresh moments
    assert (phases.switch_step < 6000) == bool(last)


def test_a_pilot_that_is_too_short_chooses_no_peak() -> None:
    assert "Annealing()," in settings(16.0, [row("annealing, peak 16", PAYS, 2.1)])
    assert "peak=16" in settings(16.0, [row("annealing, peak 16", PAYS, 1.9)])
    assert "peak=4" in settings(4.0, [row("annealing, peak 16", UNDECIDED, 2.1)])


def test_the_caveats_are_those_of_this_pilot() -> None:
    advice: dict[str, Any] = {
        "options": {"iterations": 400},
        "seeds": 3,
        "views": 2,
        "peaks": [2.0, 16.0],
        "peak": 16.0,
        "rows": as_json([row("noise", UNDECIDED)]),
    }
    text = "\n".join(caveats(advice))
    for words in ("400 iterations", "30,000", "3 seeds", "2 held-out", "largest peak", "noise"):
        assert words in text
    advice["rows"] = as_json([row("annealing, peak 16", PAYS, 2.5)])
    text = "\n".join(caveats(advice))
    assert "largest peak" not in text
    assert "the pilot was short" in text
    advice |= {"peak": 0.0, "rows": []}
    text = "\n".join(caveats(advice))
    assert "largest peak" not in text
    assert "stock learning rates" in text


# -- a pilot ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pilots")


OPTIONS = PilotOptions("embedded", iterations=12, points=30)


def test_last_phases_branch_off_their_base(folder: Path) -> None:
    base = train(Pilot("base", 4.0, 0), OPTIONS, folder)
    counted: list[int] = []
    for kind in ("reset", "curvature"):
        branch = Pilot(kind, 4.0, 0)
        assert steps_of(branch, OPTIONS) == 3
        its = train(branch, OPTIONS, folder, count=counted.append)
        assert its["psnr"] != base["psnr"]
        assert its["psnr"] == pytest.approx(base["psnr"], abs=3)  # three steps apart
        assert finished(folder, branch, OPTIONS) == its
    assert sum(counted) == 6
    # 5 pairs of 32 bytes per point, in the positions' state.
    assert its["state_bytes_per_point"] - base["state_bytes_per_point"] == 160


def test_results_of_other_options_are_refused(folder: Path) -> None:
    train(Pilot("base", 4.0, 0), OPTIONS, folder)
    with pytest.raises(ValueError, match="use another -o"):
        finished(folder, Pilot("base", 4.0, 0), PilotOptions("embedded", iterations=12, points=31))


# -- the command line --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("advice") / "tiny"
    assert advise.main([*TINY, "-o", str(out)]) == 0
    return out


def test_it_prints_table_settings_and_caveats(out: Path) -> None:
    text = (out / "advice.md").read_text()
    advice = json.loads((out / "advice.json").read_text())
    assert advise.page(advice) == text
    parts = [each["part"] for each in advice["rows"]]
    others = ["fading", "pooling", "multiplier", "noise", "reset", "squared loss", "curvature"]
    assert parts[4:] == others
    assert [part.split()[-1] for part in parts[:4]] == ["2", "4", "8", "16"]
    assert "PhaseScheduler(" in text
    assert text.count("\n| ") == 12
    assert str(out.parent) not in text + json.dumps(advice)


def test_a_second_start_trains_nothing(out: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.stat().st_mtime_ns for path in (out / "pilots").iterdir()}
    assert advise.main([*TINY, "--json", "-o", str(out)]) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "pilots").iterdir()} == before
    assert json.loads(capsys.readouterr().out)["seeds"] == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--scene", "nowhere"], "nowhere"),
        (["--seeds", "1"], "--seeds 1: must be at least 2"),
        (["--iterations", "3"], "--iterations 3"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert advise.main([*TINY, "-o", str(tmp_path), *words]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_ctrl_c_stops_all_and_keeps_what_is_finished(tmp_path: Path) -> None:
    words = [*TINY[:-4], "--seeds", "3", "--jobs", "2", "--iterations", "4000"]
    words += ["-o", str(tmp_path)]
    process = subprocess.Popen(
        [sys.executable, str(ROOT / "examples" / "advise.py"), *words],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    deadline = time.monotonic() + 120
    while not (tmp_path / "pilots").is_dir() and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(1)
    os.killpg(process.pid, signal.SIGINT)  # what a terminal does
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert error.rstrip().endswith("goes on with what is missing")


# -- what is committed -------------------------------------------------------------------------


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: path.stem)
def test_the_page_shows_the_committed_advice(path: Path) -> None:
    text = (ROOT / "docs" / "adaptive.md").read_text(encoding="utf-8")
    advice = json.loads(path.read_text(encoding="utf-8"))
    rows = [as_row(each) for each in advice["rows"]]
    assert table(rows) in text
    assert advice["command"] in text
    assert advice["settings"] in text
    for each in rows:  # and the verdicts follow from the figures
        assert each.verdict == verdict(each.gain, each.spread)
