"""The first example that anybody runs."""

from __future__ import annotations

from pathlib import Path

import pytest
import quickstart


def test_it_fits_prints_and_draws(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(quickstart, "ITERATIONS", 400)
    picture = tmp_path / "new" / "quick"  # no suffix: written as named
    assert quickstart.main(["-o", str(picture)]) == 0
    stock, ours, written = capsys.readouterr().out.splitlines()
    assert stock.startswith("3DGS-MCMC: ")
    assert written == str(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    psnr = [float(line.split(": ")[1].split()[0]) for line in (stock, ours)]
    assert psnr[1] > psnr[0] + 1


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        ([20.0, 25.0], [20.0, 25.0]),
        ([20.0, 20.4], [19.7, 20.7]),
        ([20.4, 20.0], [20.7, 19.7]),
        ([20.0, 20.0], [19.5, 20.5]),
    ],
)
def test_names_beside_the_lines_never_overlap(ends: list[float], expected: list[float]) -> None:
    assert quickstart.beside(ends, 1.0) == pytest.approx(expected)


@pytest.mark.parametrize("out", ["/dev/null/quick.png", "."])
def test_a_place_that_cannot_be_written_is_one_line(
    out: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert quickstart.main(["-o", out]) == 2
    said = capsys.readouterr().err
    assert said.startswith("quickstart: ")
    assert said.count("\n") == 1
