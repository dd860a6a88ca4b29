"""Whether poses fit, and which photos are matched. The library that poses them is not in CI."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from studies.scenes import register


@pytest.mark.parametrize("count", [1, 2, 13, 40, 252])
def test_photos_are_matched_with_their_neighbours_and_across_orbits(count: int) -> None:
    pairs = register.pairs_of(count)
    assert all(0 <= i < j < count for i, j in pairs)
    assert len(set(pairs)) == len(pairs)
    for i in range(count - 1):
        assert {(i, j) for j in range(i + 1, min(count, i + 13))} <= set(pairs)
    assert {(i, j) for i in range(0, count, 3) for j in range(i + 3, count, 3)} <= set(pairs)
    assert len(pairs) <= 12 * count + (count / 3 + 1) ** 2 / 2


def photo(name: str, offsets: list[float], unseen: int = 0) -> Any:
    """A photo with one point per offset, which projects so many pixels beside where it was seen."""

    def point(at: int, known: bool) -> Any:
        return SimpleNamespace(
            has_point3D=lambda: known, point3D_id=at, xy=np.array([float(at), 0.0])
        )

    points = [point(i, known=True) for i in range(len(offsets))]
    points += [point(99, known=False) for _ in range(unseen)]

    def project(xyz: np.ndarray) -> np.ndarray | None:
        offset = offsets[int(xyz[0])]
        return None if np.isnan(offset) else np.array([xyz[0], offset])

    number = sum(map(ord, name))
    return SimpleNamespace(
        name=name,
        points2D=points,
        project_point=project,
        projection_center=lambda: np.array([np.cos(number), np.sin(number), 0.0]),
        viewing_direction=lambda: -np.array([np.cos(number), np.sin(number), 0.0]),
    )


@pytest.mark.parametrize("second", [0.0, 5.0])
def test_an_orbit_around_two_copies_is_seen(second: float) -> None:
    """Every photo fits its own points there."""

    def camera(i: int) -> Any:
        angle, centre = i / 10, np.array([second * (i >= 56), 0.0, 1.0])
        away = np.array([np.cos(angle), np.sin(angle), 0.3])
        axis = -away / np.linalg.norm(away)
        return SimpleNamespace(
            name=f"{i:03}",
            projection_center=lambda: centre + 2 * away,
            viewing_direction=lambda: axis,
        )

    model = SimpleNamespace(images={i: camera(i) for i in range(112)})
    found = register.spread_of_looks(model)
    distance = 2 * np.hypot(1.0, 0.3)
    assert found == pytest.approx(second / distance, abs=1e-6)


def test_a_photo_that_does_not_fit_is_named() -> None:
    photos = [photo(f"{i}.jpg", [0.3, 0.2, 0.4], unseen=2) for i in range(5)]
    photos += [photo("bad.jpg", [1.0, 0.9, 0.2]), photo("behind.jpg", [float("nan"), 0.1, np.nan])]
    photos += [photo("alone.jpg", [], unseen=3)]
    points = {i: SimpleNamespace(xyz=np.array([float(i), 0.0, 1.0])) for i in range(3)}
    model = SimpleNamespace(images=dict(enumerate(photos)), points3D=points)
    errors = register.median_errors(model)
    assert errors["0.jpg"] == pytest.approx(0.3)
    assert errors["bad.jpg"] == pytest.approx(0.9)
    assert register.that_do_not_fit(errors) == ["alone.jpg", "bad.jpg", "behind.jpg"]
    assert "bad.jpg: 0.90 pixels" in register.report(model)
    assert "3 photos have more than 2 times that" in register.report(model)


def test_a_folder_that_is_there_is_not_written_into(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="is there already; name a new folder"):
        register.main([str(tmp_path), str(tmp_path)])


def test_without_the_library_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pycolmap", None)
    with pytest.raises(SystemExit, match="pip install pycolmap"):
        register.main([str(tmp_path)])
