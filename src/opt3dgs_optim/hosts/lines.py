"""The lines for a trainer, by its name or put into its file: `opt3dgs lines`."""

from __future__ import annotations

import argparse
import difflib
import re
import shutil
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path

from opt3dgs_optim.hosts.diff import ANY, edited
from opt3dgs_optim.hosts.pages import OPEN_END, PAGES
from opt3dgs_optim.hosts.schedules import schedule, shortened
from opt3dgs_optim.hosts.trainers import TRAINERS

WIDTH = 100
FEWER = "Fewer iterations"  # the topic of a note


def text(name: str, iterations: int | None = None, open_end: bool = False) -> str:
    """All that is known of a trainer.

    Args:
        name: the trainer's.
        iterations: to which its schedule is shortened.
        open_end: whether the lines are for a training of no planned end.

    Raises:
        KeyError: no trainer of this name is known.
        ValueError: no schedule of it is known, or not for so many iterations; its page does not
            say how to train without a planned end.
    """
    trainer = TRAINERS[name]
    if open_end and not trainer.open_end:
        known = ", ".join(each for each, one in TRAINERS.items() if one.open_end)
        raise ValueError(f"--open-end is for {known}; {name} plans its length")
    block = trainer.open_end if open_end else trainer.block
    notes = "\n".join(
        textwrap.fill(
            f"{topic}: {_plain(said)}", WIDTH, subsequent_indent="  ", break_on_hyphens=False
        )
        for topic, said in trainer.notes.items()
        if topic != (FEWER if open_end else OPEN_END)
    )
    head = textwrap.fill(trainer.head, WIDTH, break_on_hyphens=False)
    if iterations is None:
        return "\n\n".join([head, block, notes])
    if (stock := schedule(trainer)) is None:
        known = ", ".join(each for each, one in TRAINERS.items() if schedule(one))
        raise ValueError(f"--iterations is for {known}; the schedule of {name} was not read")
    return "\n\n".join([head, block, shortened(stock, iterations), notes])


def _plain(said: str) -> str:
    """A page's link, `[title](page)`, as words for a terminal."""
    return re.sub(r"\[([^][]+)\]\(([^)]+)\)", rf'"\1" ({PAGES.as_posix()}/\2)', said)


def put(path: Path, *, write: bool) -> tuple[str, str]:
    """The lines in a file, as a diff, and what was done; written where that is asked for.

    Raises:
        ValueError: the file is refused; the message has what to do by hand.
    """
    if not path.is_file():
        raise ValueError("that is no file; give the path of the trainer's script")
    old = path.read_bytes().decode()
    trainer, new = edited(old)
    done = "not written"
    if write:
        kept = path.with_name(f"{path.name}.orig")
        if kept.exists():
            raise ValueError(f"{kept} is there already; move it away")
        shutil.copy2(path, kept)
        path.write_bytes(new.encode())
        done = f"written, the old file is {kept}"
    before, after = (each.replace("\r", "").split("\n") for each in (old, new))
    changes = "\n".join(difflib.unified_diff(before, after, str(path), str(path), lineterm=""))
    if schedule(trainer) is not None:
        name = next(name for name, each in TRAINERS.items() if each is trainer)
        done += (
            f"; `opt3dgs lines {name} --iterations N` prints its schedule shortened to N iterations"
        )
    return changes, f"{trainer.title}: {done}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print or write what was asked for: 0; 1 for a file that is refused, 2 for a wrong word."""
    parser = argparse.ArgumentParser(
        prog="opt3dgs lines",
        description="The three lines for your trainer, and where they go.",
        epilog="Without an argument: the names of the trainers that are known.",
    )
    parser.add_argument(
        "trainer",
        nargs="?",
        metavar="NAME|FILE",
        help="a trainer's name: its lines, and what to know; its script: the same lines as a diff",
    )
    parser.add_argument(
        "--write", action="store_true", help="write them; the old file stays as FILE.orig"
    )
    parser.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        help="with NAME: also what shortens the whole schedule of its trainer to N iterations",
    )
    parser.add_argument(
        "--open-end",
        action="store_true",
        help="with NAME: the lines of a training of no planned end",
    )
    options = parser.parse_args(arguments)
    word = options.trainer
    is_file = word is not None and (Path(word).exists() or word.endswith(".py"))
    is_file &= word not in TRAINERS  # a clone's folder may bear the name
    if options.write and not is_file:
        parser.error("--write needs the path of a trainer's script")
    if (options.iterations is not None or options.open_end) and (word is None or is_file):
        parser.error("--iterations and --open-end need the name of a trainer")
    if options.iterations is not None and options.open_end:
        parser.error("--iterations plans an end, --open-end does not; give one of them")
    if word is None:
        print("\n".join(f"{name:18} {trainer.title}" for name, trainer in TRAINERS.items()))
        print(f"\nAny other trainer:\n\n{ANY}")
    elif word in TRAINERS:
        try:
            print(text(word, options.iterations, options.open_end))
        except ValueError as error:
            parser.error(str(error))
    elif is_file:
        try:
            changes, done = put(Path(word), write=options.write)
        except (OSError, ValueError) as error:
            print(f"opt3dgs lines {word}: {error}", file=sys.stderr)
            return 1
        print(changes)
        print(f"\n{done}", file=sys.stderr)
    else:
        titles = {each.title.partition(":")[0].lower(): name for name, each in TRAINERS.items()}
        known = titles | {name: name for name in TRAINERS}
        near = difflib.get_close_matches(word.lower(), known, cutoff=0.4)
        near = list(dict.fromkeys(known[each] for each in near))
        meant = f"did you mean {' or '.join(near)}?" if near else "any trainer has these lines:"
        print(f"opt3dgs lines: no trainer and no file {word!r}; {meant}\n\n{ANY}", file=sys.stderr)
        return 2
    return 0
