"""The lines put into a trainer's file.

The file is known by whole lines that it must have exactly so often as `trainers` says. Lines are
inserted and nothing else changes, which the syntax tree of the new file confirms. Any other file is
refused, with the lines to write by hand.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable

from opt3dgs_optim.hosts.pages import Place, Trainer
from opt3dgs_optim.hosts.trainers import TRAINERS

ANY = """\
from opt3dgs_optim import PhaseScheduler

# above the training loop, when the optimizers are made and a checkpoint is loaded
phases = PhaseScheduler(N)  # N: how many steps the training makes
phases.upgrade(OPTIMIZERS)  # a torch.optim.Adam with named groups, a dict of them, or a list"""


def misses(trainer: Trainer, text: str) -> list[str]:
    """What the file of a trainer has and this text has not; empty where it is that file."""
    code = [line for line in text.split("\n") if not line.lstrip().startswith("#")]
    found = []
    for place in trainer.places:
        if (times := len(_starts(place.anchor, text))) != place.times:
            found.append(f"`{place.anchor.strip()}` stands {times} times, not {place.times}")
    for sign in trainer.signs:
        forms = (sign,) if isinstance(sign, str) else sign
        if sum(len(_starts(form, text)) for form in forms) != 1:
            found.append(f"`{' '.join(forms[0].split())}` is not there exactly once")
    for said, number in trainer.counts.items():
        times = sum(said in line for line in code)
        if times not in (number if isinstance(number, tuple) else (number,)):
            found.append(f"{times} lines have `{said}`, not {number}")
    return found


def edited(text: str) -> tuple[Trainer, str]:
    """The trainer whose file this is, and the file with its lines.

    Raises:
        ValueError: the file is not known, or has been edited; the message has what to do by hand.
    """
    plain = "\n".join(line.rstrip() for line in text.split("\n"))
    word = re.search(r"\b(opt3dgs_optim|PhaseScheduler)\b", plain)
    own = re.search(r"\bphases\b", plain)
    if (found := word or own) is not None:
        line = plain.count("\n", 0, found.start()) + 1
        cure = "" if word else f"; write them by hand, under another name:\n\n{ANY}"
        raise ValueError(f"line {line} has `{found[0]}` already, so that nothing is inserted{cure}")
    fit = [each for each in TRAINERS.values() if each.signs and not misses(each, plain)]
    if len(fit) != 1:
        raise ValueError(_by_hand(plain))
    new_text, ours = inserted(text, fit[0].places)
    if not _only_inserted(text, new_text, ours):
        raise ValueError(f"the lines would not be statements of their own\n\n{_by_hand(plain)}")
    return fit[0], new_text


def inserted(text: str, places: Iterable[Place]) -> tuple[str, set[int]]:
    """A text with lines at their places, and the numbers, from 1, that these have in it."""
    plain = "\n".join(line.rstrip() for line in text.split("\n"))
    lines, found = text.split("\n"), {}  # above that line, from 0
    for place in places:
        for at in _starts(place.anchor, plain):
            end = "\r" if lines[at].endswith("\r") else ""
            new = [f"{place.indent}{line}{end}" for line in place.lines]
            found.setdefault(at if place.above else at + 1, []).extend(new)
    whole: list[str] = []
    ours: set[int] = set()
    for at, line in enumerate([*lines, ""]):
        new = found.get(at, [])
        ours.update(range(len(whole) + 1, len(whole) + 1 + len(new)))
        whole += [*new, line]
    return "\n".join(whole[:-1]), ours


def _starts(lines: str, text: str) -> list[int]:
    """The numbers, from 0, of the lines of a text at which these whole lines begin."""
    found = re.finditer(rf"^{re.escape(lines)}$", text, re.M)
    return [text.count("\n", 0, match.start()) for match in found]


def _only_inserted(old: str, new: str, ours: set[int]) -> bool:
    """Whether both are Python, and the new one is the old one with statements at our lines."""

    class WithoutOurs(ast.NodeTransformer):
        def visit(self, node: ast.AST) -> ast.AST | None:
            return None if getattr(node, "lineno", 0) in ours else self.generic_visit(node)

    try:
        trees = [ast.parse(text.encode()) for text in (old, new)]
    except (SyntaxError, ValueError):
        return False
    WithoutOurs().generic_visit(trees[1])
    return ast.dump(trees[0]) == ast.dump(trees[1])


def _by_hand(text: str) -> str:
    """Why the file is not known, and the lines for the trainer that it is most like."""

    def alike(trainer: Trainer) -> tuple[int, int]:
        found = sum(bool(_starts(place.anchor, text)) for place in trainer.places[1:])
        return found, -len(misses(trainer, text))

    best = max(TRAINERS.values(), key=alike)
    if not alike(best)[0]:
        return f"it is no trainer that is known; the lines to write by hand:\n\n{ANY}"
    found = ((place.anchor, at) for place in best.places for at in _starts(place.anchor, text))
    numbers = [f"line {at + 1}: `{anchor.strip()}`" for anchor, at in found]
    differs = misses(best, text) if best.signs else ["a line of it must be replaced"]
    return (
        f"it is like {best.title}, but {'; '.join(differs[:3])}. Read the file, then write by hand "
        f"those lines that fit ({', '.join(numbers)}):\n\n{best.block}"
    )
