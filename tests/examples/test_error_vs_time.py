"""The comparison's command line, end to end and tiny."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import error_vs_time
import pytest
from PIL import Image

from opt3dgs_optim.runs import read_run, stats

pytestmark = pytest.mark.processes

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
TINY = [
    "--size",
    "images_4",
    "--iterations",
    "40",
    "--points",
    "120",
    "--seeds",
    "1",
    "--switch",
    "0.75",
]


def compare(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(EXAMPLES / "error_vs_time.py"), *words],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "tiny"
    result = compare(*TINY, "--arms", "mcmc,constant,paper", "-o", str(out))
    assert result.returncode == 0, result.stderr
    head, *rows = result.stdout.splitlines()
    assert len(re.split("  +", head.strip())) <= 6  # columns
    assert [row.split()[0] for row in rows[:4]] == ["mcmc", "awsgld", "constant", "paper"]
    assert max(map(len, [head, *rows])) <= 100
    return out


def test_reports_all_arms_and_the_one_that_the_control_needs(finished: Path) -> None:
    (scene,) = stats.compare([read_run(path) for path in finished.rglob("log.jsonl")])
    numbers = {arm.name: arm.numbers for arm in scene.arms}
    assert set(numbers) == {"mcmc", "awsgld", "constant", "paper"}
    means = {}
    for name, found in numbers.items():
        psnr, nu = found["final psnr"], found["mean nu"]
        assert psnr is not None
        assert psnr.mean > 5  # forty iterations from nearly black
        means[name] = nu and nu.mean
    assert means["constant"] == pytest.approx(means["awsgld"], rel=1e-5)


def test_draws_the_report_and_the_renders(finished: Path) -> None:
    for name in ("report.png", "renders.png"):
        with Image.open(finished / name) as picture:
            assert min(picture.size) > 300
            assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 500


def test_no_folder_of_this_machine_is_recorded(finished: Path) -> None:
    assert str(finished.parent) not in (finished / "report.md").read_text()


def test_second_start_repeats_nothing(finished: Path) -> None:
    log = finished / "mcmc" / "seed-0" / "log.jsonl"
    before = log.read_bytes()
    result = compare(*TINY, "--arms", "mcmc,paper", "-o", str(finished))
    assert result.returncode == 0, result.stderr
    assert log.read_bytes() == before


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_interruption_leaves_checkpoints_and_the_same_command_goes_on(
    kind: signal.Signals, tmp_path: Path
) -> None:
    words = ["--iterations", "300", "--points", "120", "--seeds", "1", "--arms", "mcmc,adam"]
    words += ["--jobs", "2", "-o", str(tmp_path)]
    process = subprocess.Popen(
        [sys.executable, str(EXAMPLES / "error_vs_time.py"), *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    logs = [tmp_path / arm / "seed-0" / "log.jsonl" for arm in ("mcmc", "adam")]
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        if all(log.exists() and log.read_bytes().count(b"\n") > 25 for log in logs):
            break
        time.sleep(0.01)
    process.send_signal(kind)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    assert b"goes on from the checkpoints" in stderr
    for log in logs:
        run = read_run(log)
        if run.events[-1]["event"] == "interrupted":
            assert (log.parent / "checkpoint.pt").exists()
    assert any(read_run(log).events[-1]["event"] == "interrupted" for log in logs)
    result = compare(*words)
    assert result.returncode == 0, result.stderr
    for log in logs:
        assert read_run(log).steps["iteration"].tolist() == list(range(1, 301))


def test_folder_with_other_options_is_refused(finished: Path) -> None:
    result = compare(
        "--size", "images_4", "--iterations", "41", "--arms", "mcmc", "-o", str(finished)
    )
    assert result.returncode == 2
    assert "use another -o" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--arms", "mcmc,sgd"], "'sgd' is unknown"),
        (["--scene", "/nowhere/at/all"], "/nowhere/at/all"),
        (["--seeds", "0"], "--seeds 0"),
        (["--arms", ""], "--arms '': names no arm"),
        (["--iterations", "0"], "iterations=0"),
        (["-o", "/dev/null/here"], "/dev/null"),
    ],
)
def test_bad_options_are_one_line(words: list[str], message: str) -> None:
    result = compare(*words)
    assert result.returncode == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1


def test_the_readme_says_where_the_report_lies() -> None:
    args = error_vs_time._parser().parse_args([])
    readme = (Path(__file__).resolve().parents[2] / "README.md").read_text(encoding="utf-8")
    assert f"`runs/{args.scene}-{args.size}/report.png`" in readme
