"""What is known of a trainer: its file, the lines to insert, and where they go."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Place:
    """Lines, and the line of the trainer next to which they go, with its indentation.

    `{parts}` in a line stands for the density control's preset, `{names}` for what is imported.
    """

    anchor: str  # a whole line; it stands in the file exactly `times` times
    lines: tuple[str, ...]
    above: bool = False
    times: int = 1

    @property
    def indent(self) -> str:
        """The spaces before the anchor, and before the lines."""
        return self.anchor[: len(self.anchor) - len(self.anchor.lstrip())]


@dataclass(frozen=True)
class Trainer:
    """One trainer, at the commits that were read.

    Args:
        title: its name as its authors write it.
        repository: on github.com.
        file: which one changes, or what is done instead where none does.
        read: the commits that the lines were tried on, newest first.
        relocates: whether density control relocates Gaussians, or an expression of the file that
            says so. Where it does not, it clones, splits and prunes.
        places: the lines.
        signs: further whole lines that the file has exactly once. Of a tuple, one of them is there.
        counts: strings, and how many lines have them that are no comments; of a tuple, one holds.
        notes: what to know, by topic.
        inserted: False where a line must be replaced, so that the lines are written by hand.
        variants: names under which the lines are printed for one kind of density control each.
    """

    title: str
    repository: str
    file: str
    read: tuple[str, ...]
    relocates: bool | str
    places: tuple[Place, ...]
    signs: tuple[str | tuple[str, ...], ...] = ()
    counts: Mapping[str, int | tuple[int, ...]] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    inserted: bool = True
    variants: dict[str, bool] = field(default_factory=dict)

    def lines_at(self, place: Place, relocates: bool | str | None = None) -> list[str]:
        """The lines of a place; `relocates` takes the place of the trainer's own."""
        either = self.relocates if relocates is None else relocates
        parts = {True: "", False: ", parts=DEFAULTS_ADC"}.get(either)  # type: ignore[call-overload]
        if parts is None:
            parts = f", parts=None if {either} else DEFAULTS_ADC"
        names = "DEFAULTS_ADC, PhaseScheduler" if parts else "PhaseScheduler"
        return [line.format(parts=parts, names=names) for line in place.lines]
