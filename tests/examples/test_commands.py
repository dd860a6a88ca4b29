"""What the examples' commands say: their defaults, and what is wrong, before any work is done."""

from __future__ import annotations

import error_vs_time
import pytest
import quickstart
import train
from splatting.arms import DEFAULT_ARM

MAINS = {main.__module__: main for main in (train.main, error_vs_time.main, quickstart.main)}


@pytest.mark.parametrize(
    ("name", "defaults"),
    [
        ("train", ["embedded", "images_2", "3000", "4000", "0.9666666666666667", DEFAULT_ARM]),
        ("error_vs_time", ["embedded", "3000", "4000", error_vs_time.DEFAULT_ARMS, "2"]),
        ("quickstart", ["runs/quickstart.png", "0"]),
    ],
)
def test_help_shows_defaults(
    name: str, defaults: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        MAINS[name](["--help"])
    shown = "".join(capsys.readouterr().out.split())
    for default in defaults:
        assert f"(default:{default})" in shown


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--iterations", "0"], "iterations=0"),
        (["--points", "0"], "points=0"),
        (["--switch", "2"], "switch=2"),
        (["--scene", "/nowhere/at/all"], "/nowhere/at/all"),
        (["-o", "/dev/null/here"], "/dev/null"),
    ],
)
def test_train_says_in_one_line_what_is_wrong(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path
) -> None:
    assert train.main(["-o", str(tmp_path), *words]) == 2
    said = capsys.readouterr().err
    assert said.startswith("train: ")
    assert message in said
    assert said.count("\n") == 1
    assert not any(tmp_path.iterdir())
