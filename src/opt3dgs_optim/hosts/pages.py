"""The pages of docs/hosts, which have the lines and the notes of each trainer.

A wheel carries a copy of them as `pages`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

COPY = Path(__file__).with_name("pages")
PAGES = COPY if COPY.is_dir() else Path(__file__).parents[3] / "docs" / "hosts"
OPEN_END = "Open end"  # the topic of a note
WHERE = re.compile(
    r"# (above|below) `(.+)`(?:, indented by (\d+) like it)?(?:, at each of its (\d+) places)?"
)


def section(place: str) -> str:
    """The text of `page.md` above its first heading, or of `page.md#anchor` to the next one."""
    page, _, anchor = place.partition("#")
    above, *rest = re.split(
        r"^#{2,3} (.+)\n", (PAGES / page).read_text(encoding="utf-8"), flags=re.M
    )
    slugs = [re.sub(r"[^\w\s-]", "", title.lower()).replace(" ", "-") for title in rest[::2]]
    return rest[1::2][slugs.index(anchor)] if anchor else above


@dataclass(frozen=True)
class Place:
    """Lines, and the line of the trainer next to which they go, with its indentation."""

    anchor: str  # a whole line; it stands in the file exactly `times` times
    lines: tuple[str, ...]
    above: bool
    times: int

    @property
    def indent(self) -> str:
        """The spaces before the anchor, and before the lines."""
        return self.anchor[: len(self.anchor) - len(self.anchor.lstrip())]


def places_in(block: str) -> tuple[Place, ...]:
    """Those of a block of lines, each group below a comment that says where it goes."""
    found = []
    for group in block.split("\n\n"):
        comment, *lines = group.split("\n")
        if where := WHERE.fullmatch(comment):
            anchor = " " * int(where[3] or 0) + where[2]
            above, times = where[1] == "above", int(where[4] or 1)
            found.append(Place(anchor, tuple(lines), above, times))
    return tuple(found)


@dataclass(frozen=True)
class Trainer:
    """One trainer.

    Args:
        sections: of the pages. The last one has the lines; a note replaces one of the same topic.
        signs: whole lines that the file has exactly once besides those at the places; of a tuple,
            one of them is there. Without signs the lines are written by hand.
        counts: strings, and how many lines have them that are no comments; of a tuple, one holds.
    """

    sections: tuple[str, ...]
    signs: tuple[str | tuple[str, ...], ...] = ()
    counts: Mapping[str, int | tuple[int, ...]] = field(default_factory=dict)

    @property
    def block(self) -> str:
        """The lines, each group below a comment that says where it goes."""
        text = section(self.sections[-1])
        return re.findall(r"^```\w+\n(# .+?)\n```$", text, re.M | re.S)[0]

    @property
    def places(self) -> tuple[Place, ...]:
        """The same, read; empty where no file of the trainer changes."""
        return places_in(self.block)

    @property
    def open_end(self) -> str:
        """Those of a training of no planned end; empty where its end is not known.

        They have no number, and what stands below its notes, the shared ones' first.
        """
        text = "".join(section(place) for place in self.sections)
        found = re.findall(
            rf"^\*\*{OPEN_END}\.\*\* (?:.+\n)+\n```py\n(# (?s:.+?))\n```$", text, re.M
        )
        if not found:
            return ""
        return "\n\n".join((re.sub(r"(PhaseScheduler\()[^,()]+", r"\1", self.block), *found))

    @property
    def notes(self) -> dict[str, str]:
        """What to know, by topic, each in one line."""
        found = {}
        for place in self.sections:
            for topic, said in re.findall(
                r"^\*\*(.+?)\.\*\* (.+?)\n(?=\n|\Z)", section(place), re.M | re.S
            ):
                found[topic] = " ".join(said.split())
        return found

    @property
    def head(self) -> str:
        """Its file and name, and the commits that the lines were tried on."""
        text = "".join(section(place) for place in self.sections)
        return " ".join(re.findall(r"^File: .+?\n(?=\n|\Z)", text, re.M | re.S)[-1].split())

    @property
    def title(self) -> str:
        """Its name and its file."""
        file, name = re.findall(r"^File: (.+?) of (.+?) \(", self.head)[0]
        return f"{name}: {file.strip('`')}"
