"""The examples' commands: what they print, and what they say of a wrong option."""

from __future__ import annotations

from pathlib import Path

import awsgld_double_well
import error_vs_time
import lqnadam_quadratics
import pytest
from PIL import Image

from opt3dgs_optim.runs import read_run

TINY = ["--size", "images_4", "--iterations", "40", "--points", "120", "--looks", "4"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("compared")
    assert error_vs_time.main([*TINY, "--arms", "stock,defaults,x3", "-o", str(out)]) == 0
    return out


def test_the_comparison_logs_every_arm_and_draws(compared: Path) -> None:
    for arm in ("stock", "defaults", "x3"):
        run = read_run(compared / arm / "seed-0.jsonl")
        assert run.evaluations["iteration"].tolist() == [0, 10, 20, 30, 40]
        assert (run.evaluations["seconds"][1:] > run.evaluations["seconds"][:-1]).all()
        assert run.metadata["arm"] == arm
    with Image.open(compared / "comparison.png") as picture:
        assert len(picture.convert("RGB").getcolors() or []) > 200  # of the 256 that it has
    assert "| defaults | 1 |" in (compared / "report.md").read_text(encoding="utf-8")


def test_the_arms_of_the_comparison_do_not_disturb_each_other(
    compared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They take turns in one process; alone, an arm has the same curve, and so when begun anew."""
    for _ in range(2):
        assert error_vs_time.main([*TINY, "--arms", "defaults", "-o", str(tmp_path)]) == 0
    alone = read_run(tmp_path / "defaults" / "seed-0.jsonl")
    beside = read_run(compared / "defaults" / "seed-0.jsonl")
    assert alone.evaluations["psnr"].tolist() == beside.evaluations["psnr"].tolist()
    head, row, seeds, *files, last = capsys.readouterr().out.splitlines()[-6:]
    assert head.split()[:2] == ["PSNR", "SSIM"]
    assert row.split()[0] == "defaults"
    assert seeds == "One seed."
    assert all(Path(file).exists() for file in (*files, last.split(": ")[1]))
    assert last.startswith("defaults ends ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--arms", "stock,sgd"], "'sgd' is unknown"),
        (["--scene", "/nowhere/at/all"], "/nowhere/at/all"),
        (["--seeds", "0"], "--seeds 0"),
        (["--iterations", "0"], "iterations=0"),
        (["-o", "/dev/null/here"], "/dev/null"),
    ],
)
def test_bad_options_are_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert error_vs_time.main(["-o", str(tmp_path), *words]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not any(tmp_path.iterdir())


@pytest.mark.thorough
def test_awsgld_crosses_the_barrier_and_sgld_does_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(awsgld_double_well, "STEPS", 3_000)
    assert awsgld_double_well.main() == 0
    _, sgld, awsgld, _, constant = capsys.readouterr().out.splitlines()
    counts = [int(line.split(" crossings")[0].split()[-1]) for line in (sgld, awsgld, constant)]
    assert counts[0] <= 1
    assert min(counts[1:]) >= 2


def test_lqnadam_wins_in_rosenbrocks_valley_and_loses_on_a_well_conditioned_quadratic(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(lqnadam_quadratics, "RATES", (0.1, 0.3))
    monkeypatch.setattr(lqnadam_quadratics, "CASES", ((100, 200),))
    assert lqnadam_quadratics.main() == 0
    quadratic, valley = capsys.readouterr().out.splitlines()
    assert quadratic.endswith("; Adam wins")
    assert valley.endswith("; LQNAdam wins")
