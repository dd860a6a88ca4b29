"""The lines to change in a trainer: read from the file, put into it, and checked.

What is written is at most: the import, `PhaseScheduler(...)` and `upgrade` above the training loop
(and below what makes the optimizers anew in it), `pixel_loss` in place of the L1 term, `observe`
after `backward`. The result must compile, and each name it uses must be bound where it stands.
"""

import argparse
import ast
import builtins
import difflib
import io
import os
import re
import sys
import tokenize
from collections.abc import Iterable, Iterator, Sequence
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

from opt3dgs_optim.hosts.counting import FUNCTIONS_OF_NUMBERS
from opt3dgs_optim.hosts.reading import Trainer, read_trainer
from opt3dgs_optim.hosts.syntax import (
    FUNCTIONS,
    LOOPS,
    MUTATING,
    NothingToAddError,
    Spot,
    comes_to,
    properties,
    refusal,
    runs_before,
    scopes,
    spots,
    values,
)

COMMAND = """Print the lines to change in a training script as a diff; --write applies them.

gsplat's simple_trainer.py, the train.py of INRIA's gaussian-splatting, 3dgs-mcmc and derivatives. A
file whose names cannot be read with certainty is refused, with the lines to add by hand or the page
that has them.
"""
SCHEDULER = "PhaseScheduler"
TOO_DEEP = "an expression or a branch in it is nested too deeply to be read"
LINES_BY_HAND = (
    "from opt3dgs_optim import PhaseScheduler  # at the top",
    "phases = PhaseScheduler(TOTAL_STEPS)  # above the loop",
    "OPTIMIZER = phases.upgrade(OPTIMIZER)  # a torch.optim.Adam with named groups, or a dict",
    "L1 = phases.pixel_loss(RENDER, PHOTO)  # in place of the mean absolute error",
    "phases.observe(LOSS)  # after LOSS.backward(), before OPTIMIZER.step()",
)
IMPORTS = {  # where it is refused, and why
    "opt3dgs_optim": "it imports opt3dgs_optim already; to begin anew, take the trainer's own file",
    "nerfstudio": (
        "it imports nerfstudio, whose own trainer needs no change: ns-train splatfacto-opt3dgs; a "
        "trainer of another model is none that is known"
    ),
}
# Modules of trainers that need other lines than these, or none, and the page of docs/hosts that has
# what they need.
PAGES = {
    "nerfstudio": "nerfstudio",
    "threedgrut": "3dgrut",
    "fvdb": "fvdb",
}
# What tells gaussian-splatting-lightning and CityGaussian from others with a package `internal`.
LIGHTNING = Path("internal", "gaussian_splatting.py")
NOT_PYTHON = {".cpp", ".cu", ".cuh", ".cc", ".h", ".hpp", ".rs"}


class Edited(NamedTuple):
    """A trainer's file with the lines in it."""

    new: bytes
    diff: str
    notes: list[str]


def diff(path: Path) -> Edited:
    """The file at `path` with the lines in it; every line keeps its own line end.

    The model's optimizers are read from `scene/` beside it.

    Raises:
        ValueError: the file is not one that can be edited with certainty.
    """
    if path.suffix in NOT_PYTHON:
        raise ValueError(
            "no Python: the optimizers of LichtFeld Studio (C++) and Brush (Rust) are not "
            "torch.optim's, and there is nothing here for them"
        )
    if os.path.isdir(path):  # of a folder that may not be entered nothing is known
        names = ", ".join(str(p.relative_to(path)) for p in sorted(path.rglob("*train*.py"))[:10])
        raise ValueError(f"it is a folder; name the training script ({names or 'no *train*.py'})")
    source = _read(path)
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError) as error:
        raise ValueError(f"it cannot be read as Python: {error}") from None
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    for name, reason in IMPORTS.items():
        if _imports(tree, name):
            raise (ValueError if name in PAGES else NothingToAddError)(reason)
    try:
        trainer = read_trainer(tree, path.parent)
        new = b"".join(_edited_lines(source.splitlines(keepends=True), tree, trainer))
    except RecursionError:
        raise ValueError(TOO_DEEP) from None
    try:
        compile(new, "<edited>", "exec", dont_inherit=True)
    except (SyntaxError, ValueError) as error:
        reason = getattr(error, "msg", error)  # without the line, which is one of the edited file
        raise refusal(trainer.loop, f"the lines do not fit around this loop: {reason}") from None
    before, after = ([x.decode() for x in y.splitlines(keepends=True)] for y in (source, new))
    shown = difflib.unified_diff(before, after, str(path), str(path), n=1)
    return Edited(new, "".join(shown), trainer.notes)


def _read(path: Path) -> bytes:
    """The bytes of a script.

    Raises:
        ValueError: it is no regular file, or is not written in UTF-8.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise ValueError("it is no regular file")
    try:
        source = path.read_bytes()
    except OSError as error:
        raise ValueError(f"it cannot be read: {error}") from None
    try:
        encoding, _ = tokenize.detect_encoding(io.BytesIO(source).readline)
    except SyntaxError:  # which the parser names
        encoding = "utf-8"
    if encoding not in ("utf-8", "utf-8-sig"):
        raise refusal(1, f"it says that it is written in {encoding}; only UTF-8 is read")
    try:
        source.decode()
    except UnicodeDecodeError as error:
        line = source[: error.start].count(b"\n") + 1
        raise refusal(line, f"it is not written in UTF-8, and only that is read: {error}") from None
    return source


def _imports(tree: ast.Module, module: str) -> bool:
    """Whether a file imports a module, or from it."""
    found: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.Import(names):
                found |= {each.name.split(".")[0] for each in names}
            case ast.ImportFrom(str(name), _, 0):
                found.add(name.split(".")[0])
    return module in found


def _help_by_hand(path: Path) -> list[str]:
    """What to do with a script that is refused."""
    try:
        tree = ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError):
        tree = ast.Module([], [])
    pages = [page for module, page in PAGES.items() if _imports(tree, module)]
    if any(os.path.isfile(folder / LIGHTNING) for folder in path.resolve().parents):
        pages.append("lightning")
    if pages:
        return [f"docs/hosts/{pages[0]}.md says what this trainer needs."]
    return ["The lines to add by hand:", *LINES_BY_HAND]


def write(path: Path) -> Path:
    """Apply the lines to the file at `path`; returns the backup's path.

    Raises:
        ValueError: as `diff`, there is a backup already, or the file cannot be written; it and
            its folder are then as they were.
    """
    path = path.resolve()  # of a link, the file itself is changed
    backup = path.with_name(path.name + ".orig")
    if backup.exists():
        raise ValueError(f"its backup {backup} exists already; remove it or move it away")
    new, old = diff(path).new, path.read_bytes()
    touched = False
    try:
        with path.open("r+b") as file:  # before there is a backup: can it be written at all?
            backup.write_bytes(old)
            touched = True
            file.truncate()
            file.write(new)
    except OSError as error:
        if touched:  # if that fails, too, the backup stays
            path.write_bytes(old)
        backup.unlink(missing_ok=True)
        raise ValueError(f"it cannot be written: {error}") from None
    return backup


def _edited_lines(lines: list[bytes], tree: ast.Module, trainer: Trainer) -> list[bytes]:
    """The file's lines with ours among them."""
    used = _used(tree)
    name = _unused("phases", used)
    scheduler = SCHEDULER if SCHEDULER not in used else _unused("TwoPhaseScheduler", used)
    first, *second = trainer.optimizers
    point = trainer.loop  # below all that may make the optimizers anew
    known = _known(tree, trainer, point)
    is_known = trainer.scene.split(".")[0].split("[")[0] in known
    scene = f", scene={trainer.scene}" if is_known else ""
    upgrade = [f"{_target(tree, trainer, first)}{name}.upgrade({first}{scene})"]
    for other in second:  # None where the trainer's options leave it out
        target = _target(tree, trainer, other)
        upgrade += [f"if {other} is not None:", f"    {target}{name}.upgrade({other})"]
    _check_total(trainer, point)
    call = ast.unparse(trainer.total)
    if "world_size" in known and _counts_processes(tree, trainer, point):
        call += ", process_group=torch.distributed.group.WORLD if world_size > 1 else None"
    start = [f"{name} = {scheduler}({call})", *upgrade]
    defined = {*known, name, scheduler}
    for node in ast.walk(ast.parse("\n".join(start))):
        if isinstance(node, ast.Name) and node.id not in defined:
            raise refusal(point, f"the name {node.id} is not defined here, where the lines need it")
    count = f", iteration={trainer.iteration}" if trainer.iteration else ""
    for value, images in reversed(trainer.pixel):
        _replace(lines, value, f"{name}.pixel_loss({', '.join(map(ast.unparse, images))})")
    renamed = SCHEDULER if scheduler == SCHEDULER else f"{SCHEDULER} as {scheduler}"
    _insert(lines, _last_import(tree, point), [f"from opt3dgs_optim import {renamed}"])
    for statement in trainer.backwards:
        _insert(lines, statement, [f"{name}.observe({trainer.loss}{count})"])
    for statement in trainer.setups:
        _insert(lines, statement, upgrade)
    _insert(lines, point, start, above=True)
    return lines


def _used(tree: ast.Module) -> set[str]:
    """Every name that a file uses in any way."""
    found: set[str] = set()
    for node in ast.walk(tree):
        match node:
            case ast.Name(name) | ast.arg(name) | ast.keyword(str(name)) | ast.Attribute(_, name):
                found.add(name)
            case ast.FunctionDef(name) | ast.AsyncFunctionDef(name) | ast.ClassDef(name):
                found.add(name)
            case ast.ExceptHandler(_, str(name)) | ast.MatchAs(_, str(name)):
                found.add(name)
            case ast.MatchStar(str(name)) | ast.MatchMapping(_, _, str(name)):
                found.add(name)
            case ast.Global(names) | ast.Nonlocal(names):
                found |= {*names}
            case ast.alias(name, other):
                found |= {name.split(".")[-1], other or name.split(".")[0]}
    return found


def _unused(name: str, used: set[str]) -> str:
    """A name of ours that a file does not use."""
    while name in used:
        name = f"opt3dgs_{name}"
    return name


def _check_total(trainer: Trainer, point: ast.stmt) -> None:
    """ValueError where the number of iterations changes between our lines and the loop."""
    nodes = [*ast.walk(trainer.total)]
    parts = {ast.unparse(node) for node in nodes if isinstance(node, ast.expr)}
    sized = {
        ast.unparse(node.args[0]) for node in nodes if isinstance(node, ast.Call) and node.args
    }
    for spot in trainer.spots:
        changed, line = "", spot.line
        match spot.node:
            case ast.Name(ctx=ast.Store()) | ast.Attribute(ctx=ast.Store()) as node:
                changed = ast.unparse(node)
            case ast.Subscript(holder, _, ast.Store() | ast.Del()):
                changed = ast.unparse(holder)
            case ast.Call(ast.Attribute(holder, method)) if method in MUTATING:
                changed = ast.unparse(holder)
            case ast.Call(ast.Name("setattr" | "vars"), [holder, *_]):
                changed = ast.unparse(holder)
            case ast.Call(called, arguments) if ast.unparse(called) not in FUNCTIONS_OF_NUMBERS:
                changed = next((t for t in map(ast.unparse, arguments) if t in sized), "")
        later = line > trainer.total.lineno or line >= point.lineno
        if changed in parts and later and line < trainer.loop.lineno:
            raise refusal(line, f"{changed} changes here, between the range and the loop over it")


def _replace(lines: list[bytes], node: ast.expr, text: str) -> None:
    """Put `text` in the place of an expression."""
    first, last = node.lineno - 1, (node.end_lineno or node.lineno) - 1
    before, after = lines[first][: node.col_offset], lines[last][node.end_col_offset :]
    lines[first : last + 1] = [before + text.encode() + after, *[b""] * (last - first)]


def _insert(lines: list[bytes], node: ast.stmt, new: list[str], *, above: bool = False) -> None:
    """Put lines below a statement, or above it, with its indentation and its line's end."""
    first, last = node.lineno - 1, (node.end_lineno or node.lineno) - 1
    at = first if above else last
    indent = lines[first][: node.col_offset]
    # What is above a statement does not depend on its last line, which may have been edited.
    rest = b"" if above else lines[last][node.end_col_offset :].strip()
    if indent.strip() or (rest and not rest.startswith(b"#")):
        shown = lines[at].decode().strip()
        raise refusal(at + 1, f"there are several statements in this line: {shown}")
    end = lines[at][len(lines[at].rstrip(b"\r\n")) :]
    own, text = lines[at].removesuffix(end), [indent + line.encode() for line in new]
    # The file's last line may have no end.
    lines[at] = (end or b"\n").join([*text, own] if above else [own, *text]) + end


def _last_import(tree: ast.Module, point: ast.stmt) -> ast.stmt:
    """The last import at the top of a file, above the lines that need it."""
    code = (*FUNCTIONS, ast.ClassDef)
    top = takewhile(lambda s: not isinstance(s, code) and s.lineno < point.lineno, tree.body)
    imports = [s for s in top if isinstance(s, (ast.Import, ast.ImportFrom))]
    if not imports:
        raise refusal(1, "there are no imports at the top, below which ours could stand")
    return imports[-1]


def _target(tree: ast.Module, trainer: Trainer, optimizer: str) -> str:
    """What is left of `upgrade(...)`: it works in place, so that an assignment may be left off.

    It is where the name is another scope's, and an assignment would make it one of this function,
    or where the attribute cannot be set.
    """
    owner, _, name = optimizer.rpartition(".")
    if owner:
        off = name in {*properties(tree), *_frozen_fields(tree)}
    else:
        off = isinstance(trainer.scope, FUNCTIONS) and name not in _bound(trainer.spots)
    return "" if off else f"{optimizer} = "


def _frozen_fields(tree: ast.Module) -> set[str]:
    """The fields of the classes in a file that cannot be set: frozen dataclasses, named tuples."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            said = " ".join(map(ast.unparse, (*node.decorator_list, *node.bases)))
            if re.search(r"frozen=True|NamedTuple", said):
                fields = [each.target for each in node.body if isinstance(each, ast.AnnAssign)]
                found |= {ast.unparse(field) for field in fields}
    return found


def _counts_processes(tree: ast.Module, trainer: Trainer, point: ast.stmt) -> bool:
    """Whether the name `world_size` is a number wherever the training loop is reached.

    Raises:
        ValueError: it has a value in some cases alone.
    """
    name = "world_size"
    own = [spot for spot in trainer.spots if spot.line < point.lineno]
    here = name in _bound(trainer.spots)
    places = [*_places(own, name)] if here else []
    if here and not any(isinstance(node, ast.arg) for node in places):
        at = next(spot for spot in trainer.spots if spot.node is point)
        always = runs_before(at, [node for node in places if not isinstance(node, LOOPS)])
    else:
        around = [scope for scope in scopes(tree) if trainer.scope in ast.walk(scope)]
        bodies = [] if here else [(each, [*spots(each)]) for each in around]
        always = here
        for scope, inside in bodies:
            found = [*_places(inside, name)]
            places += found
            always |= any(isinstance(node, ast.arg) for node in found)
            always |= comes_to(scope.body, found)
    given = [value for _, value in values(own if here else [*spots(tree)], name)]
    if any(isinstance(value, ast.Tuple | ast.List | ast.Dict | ast.Set) for value in given):
        return False
    if not always:
        raise refusal(
            places[0] if places else point,
            f"{name} has a value in some cases alone, so that it is not certain whether several "
            "processes train",
        )
    return True


def _places(among: list[Spot], name: str) -> Iterator[ast.AST]:
    """The statements and the arguments that give a value to a name."""
    for spot in among:
        if name in _bound([spot]):
            is_statement = isinstance(spot.node, ast.stmt | ast.arg)
            above = (node for node in reversed(spot.above) if isinstance(node, ast.stmt))
            yield spot.node if is_statement else next(above)


def _known(tree: ast.Module, trainer: Trainer, point: ast.stmt) -> set[str]:
    """The names that have a value where a statement of the training function begins."""
    own = trainer.spots
    before = [spot for spot in own if getattr(spot.node, "lineno", point.lineno) < point.lineno]
    around = [scope for scope in scopes(tree) if trainer.scope in ast.walk(scope)]
    outside = _bound(spot for scope in around for spot in spots(scope)) | set(dir(builtins))
    return _bound(before) | (outside - _bound(own))


def _bound(among: Iterable[Spot]) -> set[str]:
    """The names to which these nodes give a value; the variables of comprehensions are others."""
    found: set[str] = set()
    for spot in among:
        match spot.node:
            case ast.Name(name, ast.Store()):
                if not any(isinstance(each, ast.comprehension) for each in spot.above):
                    found.add(name)
            case ast.arg(name) | ast.FunctionDef(name):
                found.add(name)
            case ast.alias(_, str(name)) | ast.alias(name):
                found.add(name.split(".")[0])
            case ast.Global(names) | ast.Nonlocal(names):
                found |= {*names}
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line: 0 where the file was edited, else 1."""
    parser = argparse.ArgumentParser("opt3dgs hosts", description=COMMAND)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("diff", help="print the changed lines for a trainer's file")
    command.add_argument("path", type=Path, help="simple_trainer.py or train.py")
    command.add_argument("--write", action="store_true", help="apply them, keep PATH.orig")
    options = parser.parse_args(arguments)
    try:
        done = diff(options.path)
        backup = write(options.path) if options.write else None
    except ValueError as error:
        print(f"opt3dgs hosts: {options.path}: {error}", file=sys.stderr)
        more = options.path.is_file() and options.path.suffix == ".py"
        if more and not isinstance(error, NothingToAddError):
            print("\n".join(_help_by_hand(options.path)), file=sys.stderr)
        return 1
    print(done.diff, end="")
    for note in done.notes:
        print(f"note: {note}", file=sys.stderr)
    if backup is not None:
        print(f"{options.path} changed, the old file is {backup}")
    return 0
