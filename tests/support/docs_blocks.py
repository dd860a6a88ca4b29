"""The fenced blocks of a Markdown page, and what an excerpt of a trainer needs to run."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>\w*) *(?:title=\"(?P<title>[^\"]*)\")?[^\n]*\n"
    r"(?P<text>.*?)^(?P=indent)```[ \t]*$",
    re.M | re.S,
)


@dataclass(frozen=True)
class Block:
    """One fenced block."""

    language: str
    title: str  # "prints": what the block before it prints
    text: str
    line: int  # of the fence, from 1


def pages() -> list[Path]:
    """The READMEs, CONTRIBUTING and the pages of docs/ that people write (not tables of runs)."""
    written = [p for p in DOCS.rglob("*.md") if "results" not in p.parts]
    readmes = [
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *(ROOT / "examples").rglob("README.md"),
    ]
    return [*readmes, *sorted(written)]


def name(page: Path) -> str:
    """The page's path in the repository."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, *languages: str) -> list[Block]:
    """The page's fenced blocks, of those languages or of all."""
    text = page.read_text(encoding="utf-8")
    found = [
        Block(m["language"], m["title"] or "", m["text"], text.count("\n", 0, m.start()) + 1)
        for m in FENCE.finditer(text)
    ]
    return [b for b in found if not languages or b.language in languages]


def unfenced(text: str) -> str:
    """A page without its fenced blocks and inline code, in which links and pictures are looked for.

    Fences keep their number of lines.
    """
    text = FENCE.sub(lambda m: "\n" * m[0].count("\n"), text)
    return re.sub(r"`[^`\n]*`", "", text)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    headings = re.findall(r"^#{1,6} +(.+?) *$", text, re.M)
    slugs = (re.sub(r"[^\w\s-]", "", heading.lower()) for heading in headings)
    return {re.sub(r"[\s]+", "-", slug.strip()) for slug in slugs}
