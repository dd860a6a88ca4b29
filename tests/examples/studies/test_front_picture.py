"""The README's first picture from folders of the study."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatting.scenes import load_scene
from studies.scenes import front_picture
from studies.scenes.training import Spec

SPEC = Spec("embedded", "mcmc", 0, 100, 200)


def folder_of(path: Path, spec: Spec, psnr: float) -> Path:
    """What a training leaves: its record, its call, its renders."""
    path.mkdir()
    curve = [{"seconds": 10.0 * i, "psnr": 10 + (psnr - 10) * i / 20} for i in range(21)]
    (path / "record.json").write_text(json.dumps({"curve": curve, "finished": True}))
    (path / "call.json").write_text(json.dumps({"spec": asdict(spec)}))
    views = load_scene("embedded", "images_4").test
    np.savez_compressed(path / "renders.npz", *[np.uint8(255 * v.image.numpy()) for v in views])
    return path


def test_it_is_made_of_two_folders(tmp_path: Path) -> None:
    stock = folder_of(tmp_path / "stock", SPEC, 20.0)
    ours = folder_of(tmp_path / "ours", replace(SPEC, arm="faded"), 22.0)
    picture = tmp_path / "front.png"
    assert front_picture.main([str(stock), str(ours), "--view", "1", "--out", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    record = json.loads(picture.with_suffix(".json").read_text())
    assert record["arms"] == ["mcmc", "faded"]
    assert record["scene"] == "embedded"
    assert record["seconds_to_stock_psnr"] == 170.0  # the first look at 20 dB or more
    assert min(record["psnr_of_the_pictures"]) > 45  # the render is the photo, but for rounding
    assert str(tmp_path) not in picture.with_suffix(".json").read_text()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("change", "words", "message"),
    [
        ({"seed": 1}, [], "of one setting"),
        ({}, ["--view", "99"], "--view 99"),
        (None, [], "has no renders.npz"),
    ],
)
def test_what_does_not_belong_together_is_refused(
    change: dict[str, Any] | None,
    words: list[str],
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stock = folder_of(tmp_path / "stock", SPEC, 20.0)
    other = replace(SPEC, arm="faded", **(change or {}))
    ours = folder_of(tmp_path / "ours", other, 22.0)
    if change is None:
        (ours / "renders.npz").unlink()
    out = tmp_path / "front.png"
    assert front_picture.main([str(stock), str(ours), *words, "--out", str(out)]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()
