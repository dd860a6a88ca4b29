"""Where a link of a page leads, and what makes a picture."""

from __future__ import annotations

import re
from pathlib import Path

from docs_blocks import ROOT


def makes(maker: str, picture: Path) -> bool:
    """Whether a script, or what it uses of ours, writes a file of that name.

    The name may be composed: its words must occur, as in f"step_{device}.png".
    """
    folder = (ROOT / maker).parent
    sources = [
        *folder.glob("*.py"),
        *folder.glob("*/*.py"),
        *(ROOT / "src").glob("*/runs/report.py"),
    ]
    text = "\n".join(path.read_text(encoding="utf-8") for path in sources)
    return all(word in text for word in re.split(r"[_-]", picture.stem)) and picture.suffix in text


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    text = unfenced_headings(page.read_text(encoding="utf-8"))
    headings = re.findall(r"^#{1,6} +(.+?) *$", text, re.M)
    slugs = (re.sub(r"[^\w\s-]", "", heading.lower()) for heading in headings)
    return {re.sub(r"[\s]+", "-", slug.strip()) for slug in slugs}


def unfenced_headings(text: str) -> str:
    """A page without fenced blocks, inline code kept: it is part of headings."""
    return re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
