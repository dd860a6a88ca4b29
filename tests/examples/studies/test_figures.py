"""The figures of the explanation pages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from studies import figures

DOCS = Path(__file__).resolve().parents[3] / "docs"


@pytest.mark.parametrize("name", figures.MADE)
def test_they_are_made_of_what_is_committed(name: str, tmp_path: Path) -> None:
    assert figures.main([name, "--out", str(tmp_path)]) == 0
    with Image.open(tmp_path / name) as made, Image.open(DOCS / "figures" / name) as kept:
        assert made.size == kept.size
        assert max(made.size) <= 1200  # print that a phone shows
        assert len(made.convert("RGB").getcolors(1 << 24) or []) > 100


def test_an_unknown_name_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert figures.main(["picture.png"]) == 2
    assert "picture.png: unknown; there are performance.png" in capsys.readouterr().err


@pytest.mark.parametrize("heights", [[1.0, 1.0, 1.0], [3.0, 1.0, 1.1], [1.0, 2.0, 3.0]])
def test_names_beside_lines_keep_their_order_and_their_distance(heights: list[float]) -> None:
    placed = figures.spread(heights, 0.5)
    assert np.diff(np.sort(placed)).min() >= 0.5 - 1e-6
    assert placed[0] > placed[1] or heights[0] <= heights[1]
    if min(np.diff(sorted(heights))) >= 0.5:
        assert placed == heights
