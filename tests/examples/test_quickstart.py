"""The first example that anybody runs."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import quickstart


@pytest.mark.skipif(
    importlib.util.find_spec("matplotlib") is None, reason="matplotlib is not installed"
)
def test_it_fits_prints_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "new" / "quick.png"
    assert quickstart.main(["-o", str(picture)]) == 0
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == str(picture)
    assert "phase: exploitation, iteration 240 of 240, since 232" in said.out
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_both_trainings_learn_the_picture() -> None:
    stock = quickstart.train("stock", None, seed=1)
    ours = quickstart.train("ours", quickstart.PhaseScheduler(quickstart.STEPS), seed=1)
    for training in (stock, ours):
        assert training.psnr[-1] > training.psnr[0] + 10
    assert stock.factor == []
    assert ours.factor[0] > 1 > ours.factor[-1]
