"""The tables of the pages on performance and stability are those of the committed records."""

from __future__ import annotations

from pathlib import Path

import pytest
from studies.figures import PAGES, TABLES, tabled


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_pages_tables_are_made_from_the_records(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert tabled(text) == text


def test_each_table_has_its_place() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert all(text.count(f"<!-- figures:{name} -->") == 1 for name in TABLES)
