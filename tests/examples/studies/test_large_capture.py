"""The simulated capture: what a photo sees of it, and a short run of all of it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from splatting.scenes import View
from studies import large_capture
from studies.pages import filled

SMALL = ["--photos", "80", "--points", "300", "--iterations", "20", "--seeds", "2"]


@pytest.mark.thorough
def test_a_photo_sees_little_of_the_scene() -> None:
    scene, whole = large_capture.make_scene(80, 2_000)
    assert 0.02 < large_capture.visible_share(scene.points, scene.train) < 0.06
    assert large_capture.visible_share(scene.points, [whole]) > 0.9  # the rest is beside the field
    again, _ = large_capture.make_scene(80, 2_000)
    assert torch.equal(again.points, scene.points)
    assert torch.equal(again.train[7].image, scene.train[7].image)
    assert len({view.name for view in (*scene.train, *scene.test)}) == 80 + large_capture.HELD_OUT


def test_the_share_is_of_points_inside_the_picture() -> None:
    scene, _ = large_capture.make_scene(2, 10)
    view: View = scene.train[0]
    pose = view.camera.viewmat
    ahead, behind = (pose[:3, :3].T @ (torch.tensor([0.0, 0.0, z]) - pose[:3, 3]) for z in (2, -2))
    assert large_capture.visible_share(torch.stack([ahead, behind]), [view]) == 0.5


@pytest.mark.thorough
def test_it_trains_goes_on_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*SMALL, "--runs", str(tmp_path / "runs"), "-o", str(tmp_path / "out")]
    page = large_capture.PAGE.read_text(encoding="utf-8")
    assert large_capture.main(words) == 0
    first = json.loads((tmp_path / "out" / "capture.json").read_text(encoding="utf-8"))
    assert list(first["arms"]) == [arm.name for arm in large_capture.ARMS]
    seeds = [arm["seeds"] for arm in first["arms"].values()]
    assert all(len(each) == 2 and each[1]["iteration"][-1] == 20 for each in seeds)
    assert large_capture.main([*words, "--redraw"]) == 0  # nothing is trained
    assert json.loads((tmp_path / "out" / "capture.json").read_text())["arms"] == first["arms"]
    assert (tmp_path / "out" / "capture.png").stat().st_size > 10_000
    assert large_capture.PAGE.read_text(encoding="utf-8") == page  # another folder: no page
    capsys.readouterr()


def test_the_page_is_made_from_the_committed_result() -> None:
    result = json.loads((large_capture.OUT / "capture.json").read_text(encoding="utf-8"))
    page = large_capture.PAGE.read_text(encoding="utf-8")
    assert filled(page, large_capture.texts(result), large_capture.MARK) == page
