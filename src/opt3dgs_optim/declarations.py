"""What the classes of parts declare, checked when a course is made of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from opt3dgs_optim.names import ADAM_KEYS, GAUSSIAN
from opt3dgs_optim.part import Kept, Part, Phase


def parts_by_name(parts: Iterable[Part]) -> dict[str, Part]:
    """The parts by their classes' names; "#2" is the second of a class."""
    named: dict[str, Part] = {}
    for part in parts:
        kind = type(part).__name__
        again = sum(name.split("#")[0] == kind for name in named)
        named[f"{kind}#{again + 1}" if again else kind] = part
    return named


def check_attributes(call: str, part: Part) -> None:
    """ValueError unless a part's class says in a known way when and on what it acts."""
    kind, names, during = type(part).__name__, part.names, part.during
    if not (isinstance(part.keeps, (tuple, list)) and all(isinstance(k, Kept) for k in part.keeps)):
        raise ValueError(f"{call}: {kind}.keeps={part.keeps!r}, but a tuple of Kept is needed")
    if during is not None and not isinstance(during, Phase):
        raise ValueError(f"{call}: {kind}.during={during!r}, but a Phase or None is needed")
    if names is not None and not (isinstance(names, (tuple, list)) and {*names} <= {*GAUSSIAN}):
        raise ValueError(
            f"{call}: {kind}.names={names!r}, but None or a tuple of gsplat's names is needed: "
            f"{', '.join(GAUSSIAN)}"
        )


def check_units(call: str, parts: Sequence[Part]) -> None:
    """ValueError where a part that needs the parameter's own units comes after one with others.

    Or where two of one class say how long a step is in units of their own.
    """
    for i, part in enumerate(parts):
        for before in parts[:i]:
            shared = part.names is None or before.names is None or {*part.names} & {*before.names}
            at_once = None in (part.during, before.during) or part.during is before.during
            if part.own_units and type(part) is type(before) and shared and at_once:
                raise ValueError(
                    f"{call}: parts has {before!r} and {part!r}, each of which steps the same "
                    "parameters in units of its own; one of them is needed"
                )
            if part.needs_units and before.own_units and shared:
                late, early = type(part).__name__, type(before).__name__
                raise ValueError(
                    f"{call}: parts has {late} after {early}, which feeds gradients in units of "
                    f"its own, but {late} needs those of the parameter; {late} must come first"
                )


def declared_by(call: str, part: Part) -> dict[str, Kept]:
    """What a part keeps, by name; ValueError where a name occurs twice, or is Adam's."""
    entries = {kept.name: kept for kept in part.keeps}
    if len(entries) < len(part.keeps) or any(name in ADAM_KEYS for name in entries):
        names = [kept.name for kept in part.keeps]
        raise ValueError(
            f"{call}: {type(part).__name__} keeps {names}, but different names, none of them "
            f"Adam's own ({', '.join(ADAM_KEYS)}), are needed"
        )
    return entries
