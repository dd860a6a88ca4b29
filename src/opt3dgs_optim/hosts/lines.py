"""The lines for a trainer, by its name: `opt3dgs lines`, `opt3dgs lines gsplat-mcmc`."""

from __future__ import annotations

import difflib
import re
import sys
import textwrap
from collections.abc import Sequence

from opt3dgs_optim.hosts.places import Place, Trainer
from opt3dgs_optim.hosts.trainers import ANY, TRAINERS

USAGE = """opt3dgs lines             the trainers that are known
opt3dgs lines TRAINER     its lines, where they go, and what to know

"""
WIDTH = 100


def known() -> dict[str, tuple[Trainer, bool | str]]:
    """Every name, with its trainer and what the lines assume of density control."""
    found = {}
    for name, trainer in TRAINERS.items():
        found[name] = trainer, trainer.relocates
        found.update((each, (trainer, kind)) for each, kind in trainer.variants.items())
    return found


def block(trainer: Trainer, relocates: bool | str | None = None) -> str:
    """The lines, each group below a comment that says where it goes."""
    groups = []
    for place in trainer.places:
        lines = trainer.lines_at(place, relocates)
        groups.append("\n".join([f"# {where(place)}", *lines]))
    return "\n\n".join(groups)


def where(place: Place) -> str:
    """The place in words."""
    if not place.anchor.startswith((" ", "import")):
        return place.anchor
    side = "above" if place.above else "below"
    each = "" if place.times == 1 else f", at each of its {place.times} places"
    inside = f", indented by {len(place.indent)} as it is" if place.indent else ""
    return f"{side} `{place.anchor.strip()}`{inside}{each}"


def text(name: str) -> str:
    """All that is known of a trainer. KeyError for an unknown name."""
    trainer, relocates = known()[name]
    read = ", ".join(trainer.read)
    head = f"{trainer.title}: {trainer.file}\ngithub.com/{trainer.repository}, read at {read}"
    notes = (
        textwrap.fill(
            f"{topic}: {_plain(said)}", WIDTH, subsequent_indent="  ", break_on_hyphens=False
        )
        for topic, said in trainer.notes.items()
        if not (topic == "Density control" and isinstance(relocates, bool) and trainer.variants)
    )
    return "\n\n".join([head, block(trainer, relocates), "\n".join(notes)])


def _plain(said: str) -> str:
    """A page's link, `[title](page)`, as words for a terminal."""
    return re.sub(r"\[([^][]+)\]\(([^)]+)\)", r'"\1" (docs/hosts/\2)', said)


def main(arguments: Sequence[str]) -> int:
    """Print the trainers, or one trainer's lines; 2 for a name that is not known."""
    names = known()
    if not arguments or arguments[0] in ("-h", "--help"):
        for name, (trainer, _) in names.items():
            print(f"{name:18} {trainer.title}: {trainer.file}")
        print(f"\n{USAGE}{ANY}")
        return 0
    if len(arguments) > 1 or arguments[0] not in names:
        near = difflib.get_close_matches(arguments[0], names, cutoff=0.4)
        meant = f"did you mean {' or '.join(near)}?" if near else "any trainer has these lines:"
        print(
            f"opt3dgs lines: no trainer {' '.join(arguments)!r}; {meant}\n\n{ANY}", file=sys.stderr
        )
        return 2
    print(text(arguments[0]))
    return 0
