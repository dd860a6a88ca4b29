"""The first example that anybody runs."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import quickstart


def test_it_fits_prints_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quickstart, "STEPS", 60)
    picture = tmp_path / "new" / "quick.png"
    monkeypatch.setattr(sys, "argv", ["quickstart.py", "-o", str(picture)])
    quickstart.main()
    stock, ours, written = capsys.readouterr().out.splitlines()
    assert written == str(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    psnr = [float(line.split(": ")[1].split()[0]) for line in (stock, ours)]
    assert psnr[1] > psnr[0] + 0.3  # 1.6 dB when written
