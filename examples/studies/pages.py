"""What is made from records, between the markers of a page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping


def filled(page: str, texts: Mapping[str, str], mark: str, *, every: bool = True) -> str:
    """The page with each text between the marker of its name and `<!-- end -->`.

    Args:
        mark: what stands before a text; `{}` is its name.
        every: whether each of the texts must have a place.

    Raises:
        ValueError: a marker's name is unknown, or a text has no place or several.
    """
    found: list[str] = []

    def put(match: re.Match[str]) -> str:
        if match[1] not in texts:
            name = mark.format(match[1])
            raise ValueError(f"marker {name} is unknown; there are {', '.join(texts)}")
        found.append(match[1])
        return f"{mark.format(match[1])}\n{texts[match[1]]}\n<!-- end -->"

    pattern = re.escape(mark).replace(r"\{\}", "([a-z0-9-]+)") + "\n.*?<!-- end -->"
    made = re.sub(pattern, put, page, flags=re.DOTALL)
    for name in texts if every else ():
        if found.count(name) != 1:
            places = found.count(name)
            raise ValueError(f"the page has {places} places for {name!r}, but 1 is needed")
    return made


def table(heads: Iterable[str], align: str, rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table.

    Args:
        align: an l or an r for each column; the last one counts for the rest.
    """
    heads = list(heads)
    first, *others = [f"| {' | '.join(map(str, line))} |" for line in (heads, *rows)]
    marks = ["---:" if side == "r" else "---" for side in align.ljust(len(heads), align[-1])]
    return "\n".join([first, f"|{'|'.join(marks)}|", *others])
