"""The embedded scene is drawn once: drawing it takes longer than the trainings of these tests."""

from __future__ import annotations

from functools import cache

import pytest
from splatting import embedded


@pytest.fixture(autouse=True, scope="session")
def _drawn_once() -> None:
    embedded.embedded_scene = cache(embedded.embedded_scene)
