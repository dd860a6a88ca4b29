"""The report: its numbers against hand-computed ones, its files against each other."""

from __future__ import annotations

import csv
import importlib.util
import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from opt3dgs_optim import report
from opt3dgs_optim.report_stats import compare, higher_is_better
from opt3dgs_optim.runread import read_run

NAN = "nan"


def write_run(path, arm, seed, points, *, steps=(), metric="psnr", **metadata):
    """A log with evaluations at (iteration, seconds, value) and steps at (iteration, nu, phase)."""
    lines = [
        {
            "kind": "start",
            "iteration": 0,
            "seconds": 0.0,
            "time": "2026-11-21T00:00:00+00:00",
            "command": "train.py --arm x",
            "machine": {"platform": "Testix-1", "cpus": 3},
            "metadata": {"arm": arm, "seed": seed, **metadata},
        }
    ]
    for i, nu, phase in steps:
        line = {"kind": "step", "iteration": i, "seconds": float(i), "phase": phase, "nu": nu}
        lines.append(line | {"accepted": 0.25})
    for i, seconds, value in points:
        line = {"kind": "evaluation", "iteration": i, "seconds": seconds, metric: value}
        lines.append(line | {"peak_host_bytes": 2**30})
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return read_run(path)


def two_arms(folder):
    """Baseline: 20 -> 24 dB in 100 s (both seeds +-1); other: 20 -> 28 dB in 200 s (+-0.5)."""
    return [
        write_run(folder / "m0.jsonl", "mcmc", 0, [(0, 0.0, 19.0), (50, 100.0, 23.0)]),
        write_run(folder / "m1.jsonl", "mcmc", 1, [(0, 0.0, 21.0), (50, 100.0, 25.0)]),
        write_run(folder / "f0.jsonl", "faded", 0, [(0, 0.0, 19.5), (100, 200.0, 27.5)]),
        write_run(folder / "f1.jsonl", "faded", 1, [(0, 0.0, 20.5), (100, 200.0, 28.5)]),
    ]


def arms_of(runs, metric="psnr", baseline=None) -> tuple[Any, dict[str, Any]]:
    (comparison,) = compare(runs, metric, baseline)
    return comparison, {arm.name: arm for arm in comparison.arms}


def test_numbers_match_hand_computed_ones(tmp_path):
    comparison, arms = arms_of(two_arms(tmp_path))
    assert comparison.baseline == "mcmc"
    assert comparison.target == 24.0
    faded = arms["faded"]
    final = faded.finals["psnr"]
    assert (final.mean, final.n) == (28.0, 2)
    assert final.std == pytest.approx(np.sqrt(0.5))
    # 24 dB: seed 0 after 4.5/8 of 200 s = 112.5 s, seed 1 after 3.5/8 = 87.5 s.
    assert faded.to_baseline.mean == pytest.approx(100.0)
    assert faded.to_baseline.std == pytest.approx(25 / np.sqrt(2))
    # The baseline's seed 0 ends at 23 dB, below 24; seed 1 passes it at 3/4 of 100 s.
    assert (arms["mcmc"].to_baseline.mean, arms["mcmc"].to_baseline.n) == (75.0, 1)
    # At 100 s: 23.5 - 23 and 24.5 - 25, paired by seed.
    assert faded.paired
    assert faded.gain.mean == pytest.approx(0.0)
    assert faded.gain.std == pytest.approx(np.sqrt(0.5))
    assert faded.numbers["iterations_per_second"].mean == 0.5
    assert faded.numbers["seconds"].mean == 200.0
    assert arms["mcmc"].gain is None


def test_gain_without_common_seeds_compares_means_at_the_last_shared_second(tmp_path):
    runs = two_arms(tmp_path)
    runs += [write_run(tmp_path / "x.jsonl", "x", 7, [(0, 0.0, 20.0), (10, 50.0, 26.0)])]
    runs += [write_run(tmp_path / "y.jsonl", "x", 8, [(0, 0.0, 20.0), (10, 50.0, 28.0)])]
    x = arms_of(runs)[1]["x"]
    assert not x.paired
    assert x.gain.mean == pytest.approx(27.0 - 22.0)  # at 50 s
    assert x.gain.std == pytest.approx(np.hypot(np.sqrt(2), np.sqrt(2)))


def test_another_baseline_and_lower_is_better(tmp_path):
    def run(arm, end):
        points = [(0, 0.0, 0.5), (10, 100.0, end)]
        return write_run(tmp_path / f"{arm}.jsonl", arm, 0, points, metric="lpips")

    runs = [run("mcmc", 0.3), run("b", 0.1)]
    b = arms_of(runs, "lpips")[1]["b"]
    assert b.to_baseline.mean == pytest.approx(50.0)
    assert b.gain.mean == pytest.approx(0.2)
    assert b.gain.std is None
    comparison, arms = arms_of(runs, "lpips", "b")
    assert comparison.baseline == "b"
    assert arms["mcmc"].to_baseline is None
    assert arms["mcmc"].gain.mean == pytest.approx(-0.2)
    assert [higher_is_better(m) for m in ("psnr", "train_ssim", "loss", "LPIPS")] == [1, 1, 0, 0]


def test_means_of_nu_and_accepted_share(tmp_path):
    steps = [(1, 1.0, "exploration"), (2, 2.0, "exploration"), (3, NAN, "exploitation")]
    run = write_run(tmp_path / "a.jsonl", "a", 0, [(3, 3.0, 20.0)], steps=steps)
    arm = arms_of([run])[1]["a"]
    assert arm.numbers["mean_nu"].mean == 1.5
    assert arm.numbers["accepted_share"].mean == 0.25
    assert arm.numbers["peak_memory_bytes"].mean == 2**30


def test_markdown_csv_and_json_agree(tmp_path):
    report.write_report(two_arms(tmp_path), tmp_path / "out")
    data = json.loads((tmp_path / "out/report.json").read_text())
    markdown = (tmp_path / "out/report.md").read_text()
    with open(tmp_path / "out/report.csv", newline="") as file:
        rows = {row["arm"]: row for row in csv.DictReader(file)}
    table = [line for line in markdown.splitlines() if line.startswith("| ")]
    head = [cell.strip() for cell in table[0].strip("|").split("|")]
    cells = {
        row[0]: dict(zip(head, row, strict=True))
        for row in ([c.strip() for c in line.strip("|").split("|")] for line in table[2:])
    }
    for arm in data["scenes"][0]["arms"]:
        row, cell = rows[arm["arm"]], cells[arm["arm"]]
        found = {
            "final_psnr": (arm["final"]["psnr"], cell["final psnr"]),
            "seconds": (arm["seconds"], cell["seconds"]),
            "seconds_to_baseline": (arm["seconds_to_baseline"], cell["seconds to baseline psnr"]),
            "gain_at_equal_seconds": (
                arm["gain_at_equal_seconds"],
                cell["psnr gain at equal seconds"],
            ),
        }
        for name, (stat, text) in found.items():
            assert row[f"{name}_mean"] == ("" if stat is None else str(stat["mean"]))
            if stat is not None:
                shown = text.split()[0]
                digits = len(shown.partition(".")[2])
                assert float(shown) == pytest.approx(stat["mean"], abs=0.51 * 10**-digits)
    assert "Testix-1, 3 CPUs" in markdown
    assert "75" in cells["mcmc"]["seconds to baseline psnr"]
    assert "(1 of 2)" in cells["mcmc"]["seconds to baseline psnr"]
    assert cells["mcmc"]["psnr gain at equal seconds"] == "baseline"


def picture(path):
    matplotlib_image = pytest.importorskip("matplotlib.image", reason="needs matplotlib")
    return matplotlib_image.imread(path)


def test_picture_opens_and_shows_curves_without_touching_matplotlib(tmp_path):
    matplotlib = pytest.importorskip("matplotlib", reason="needs matplotlib")
    before = dict(matplotlib.rcParams)
    steps = [(i, 1.0, "exploration" if i < 8 else "exploitation") for i in range(10)]
    runs = two_arms(tmp_path)
    runs += [write_run(tmp_path / "$_|.jsonl", "_$x^{", 0, [(9, 9.0, 21.0)], steps=steps)]
    assert report.write_report(runs, tmp_path / "out")[-1].name == "report.png"
    assert dict(matplotlib.rcParams) == before
    image = picture(tmp_path / "out/report.png")[..., :3]
    assert image.shape[1] == 1650
    assert (image[0] == 1).all()  # white margin
    for colour in ((0x33, 0x33, 0x33), (0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):
        near = np.abs(image * 255 - np.array(colour)).max(axis=-1) < 3
        assert near.sum() > 200, colour  # a legend handle and a line at least


@pytest.mark.parametrize(
    ("points", "note"),
    [
        ([], "no evaluation of psnr"),
        ([(5, 5.0, 20.0)], "a single evaluation of psnr"),
        ([(5, 5.0, 20.0), (9, 9.0, NAN)], "psnr not finite in 1 evaluations"),
        ([(5, 5.0, "inf"), (9, 9.0, NAN)], "psnr not finite in 2 evaluations"),
    ],
)
@pytest.mark.parametrize("others", [False, True])
def test_odd_runs_are_reported_in_words(tmp_path, points, note, others):
    steps = [(1, 1.0, "exploration")]
    runs = two_arms(tmp_path) if others else []
    runs += [write_run(tmp_path / "odd.jsonl", "odd", 0, points, steps=steps)]
    report.write_report(runs, tmp_path / "out")
    assert f"odd (odd): {note}" in (tmp_path / "out/report.md").read_text()
    text = (tmp_path / "out/report.json").read_text()
    json.loads(text, parse_constant=pytest.fail)


def test_empty_log_and_mixed_metrics(tmp_path):
    (tmp_path / "empty.jsonl").write_text("")
    runs = [read_run(tmp_path / "empty.jsonl")]
    runs += [write_run(tmp_path / "a.jsonl", "a", 0, [(1, 1.0, 20.0), (2, 2.0, 21.0)])]
    runs += [write_run(tmp_path / "b.jsonl", "b", 0, [(1, 1.0, 0.5)], metric="ssim")]
    report.write_report(runs, tmp_path / "out", baseline="a")
    text = (tmp_path / "out/report.md").read_text()
    assert "empty (empty): empty run, nothing logged" in text
    assert "b (b): no evaluation of psnr" in text
    assert "final psnr | final ssim" in text


def test_scenes_get_their_own_table_and_picture(tmp_path):
    points = [(1, 1.0, 20.0), (2, 2.0, 21.0)]
    runs = [write_run(tmp_path / f"{s}.jsonl", "a", 0, points, scene=s) for s in ("x", "y/z")]
    names = [path.name for path in report.write_report(runs, tmp_path / "out")]
    assert names[:3] == ["report.md", "report.csv", "report.json"]
    assert names[3:] in ([], ["report-x.png", "report-y_z.png"])
    text = (tmp_path / "out/report.md").read_text()
    assert "## x" in text
    assert "## y/z" in text


def command(*arguments, blocked=False):
    """The command line in a process of its own, with matplotlib hidden if ``blocked``."""
    call = [sys.executable, "-W", "error", "-m", "opt3dgs_optim.report", *map(str, arguments)]
    if blocked:
        code = (
            "import sys, runpy; sys.modules['matplotlib'] = None; "
            "runpy.run_module('opt3dgs_optim.report', run_name='__main__')"
        )
        call = [sys.executable, "-W", "error", "-c", code, *map(str, arguments)]
    return subprocess.run(call, capture_output=True, text=True, check=False)


def test_command_line(tmp_path):
    two_arms(tmp_path / "logs")
    done = command(tmp_path / "logs", tmp_path / "logs/m0.jsonl", "-o", tmp_path / "out")
    said = "" if importlib.util.find_spec("matplotlib") else f"{report.NO_PICTURE}\n"
    assert (done.returncode, done.stderr) == (0, said)
    data = json.loads((tmp_path / "out/report.json").read_text())
    assert [len(arm["runs"]) for arm in data["scenes"][0]["arms"]] == [2, 2]  # m0 counts once


def test_command_line_without_matplotlib(tmp_path):
    two_arms(tmp_path / "logs")
    done = command(tmp_path / "logs", "-o", tmp_path / "out", blocked=True)
    assert done.returncode == 0
    assert done.stderr.strip() == report.NO_PICTURE
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "report.csv",
        "report.json",
        "report.md",
    ]
    assert ".png" not in (tmp_path / "out/report.md").read_text()


def test_command_line_says_in_one_line_what_is_wrong(tmp_path, capsys):
    two_arms(tmp_path / "logs")
    (tmp_path / "void").mkdir()
    (tmp_path / "bad.jsonl").write_text("{}\n")
    (tmp_path / "file").write_text("")
    logs, out = str(tmp_path / "logs"), str(tmp_path / "out")
    for arguments, message in (
        ([str(tmp_path / "nowhere"), "-o", out], "no such file or folder"),
        ([str(tmp_path / "void"), "-o", out], "no *.jsonl file in the folder"),
        ([str(tmp_path / "bad.jsonl"), "-o", out], "bad.jsonl, line 1"),
        ([logs, "-o", out, "--baseline", "x"], "no such arm; there are faded, mcmc"),
        ([logs, "-o", str(tmp_path / "file")], "file"),
    ):
        assert report.main(arguments) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    done = command(tmp_path / "nowhere", "-o", out)
    assert done.returncode == 2
    assert done.stderr.startswith("report: no such file or folder")
