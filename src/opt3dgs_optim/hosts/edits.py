"""The lines to change in a trainer: read from the file, put into it, and checked.

What is written is at most: the import, `PhaseScheduler(...)` and `upgrade` above the training loop
(and after every new set-up inside it), `pixel_loss` in place of the L1 term, `observe` after
`backward`. The result must compile, and each name it uses must be bound where it stands.
"""

from __future__ import annotations

import ast
import builtins
import difflib
import re
import symtable
from pathlib import Path
from typing import NamedTuple

from opt3dgs_optim.hosts.reading import Trainer, read_trainer, within

IMPORT = "from opt3dgs_optim import PhaseScheduler"
BY_HAND = """\
{call} = PhaseScheduler(TOTAL_STEPS)  # above the training loop, and the import at the top:
{upgrade}  # {import_}
L1 = phases.pixel_loss(RENDER, PHOTO)  # in place of the mean absolute error
phases.observe(LOSS)  # after LOSS.backward(), before the optimizers' step()"""
LINES_BY_HAND = (
    f"{IMPORT}  # at the top",
    "phases = PhaseScheduler(TOTAL_STEPS)  # above the training loop",
    "OPTIMIZER = phases.upgrade(OPTIMIZER)  # a torch.optim.Adam with named groups, or a dict",
    "L1 = phases.pixel_loss(RENDER, PHOTO)  # in place of the mean absolute error",
    "phases.observe(LOSS)  # after LOSS.backward(), before OPTIMIZER.step()",
)
NOT_PYTHON = {".cpp", ".cu", ".cuh", ".cc", ".h", ".hpp", ".rs"}


class Edited(NamedTuple):
    """A trainer's file with the lines in it."""

    new: bytes
    diff: str
    notes: list[str]


class Change(NamedTuple):
    """Bytes `start:end` of the file become `text`."""

    start: int
    end: int
    text: str


def edited(source: bytes, folder: Path | None = None) -> tuple[bytes, list[str]]:
    """A trainer's source with the lines in it, and what there is to say of it.

    Args:
        source: the file's bytes; every line keeps its own line end.
        folder: where it lies; the model's optimizers are read from `scene/` there.

    Raises:
        ValueError: the file is not one that can be edited with certainty.
    """
    tree = _parsed(source)
    if any("opt3dgs_optim" in _modules(node) for node in ast.walk(tree)):
        raise ValueError("it imports opt3dgs_optim already; start from the trainer's own file")
    if any("nerfstudio" in _modules(node) for node in ast.walk(tree)):
        raise ValueError(
            "nerfstudio needs no change: ns-train splatfacto-opt3dgs (docs/hosts/nerfstudio.md)"
        )
    trainer = read_trainer(tree, folder)
    new = _apply(source, _changes(File(source), tree, trainer))
    _check(new, trainer)
    return new, trainer.notes


def diff(path: Path) -> Edited:
    """The file at `path` with the lines in it; ValueError as `edited`."""
    if path.suffix in NOT_PYTHON:
        raise ValueError(
            "no Python: the optimizers of LichtFeld Studio (C++) and Brush (Rust) are not "
            "torch.optim's, and there is nothing here for them"
        )
    if path.is_dir():
        known = [p for p in sorted(path.glob("**/*.py")) if p.match("*train*.py")]
        names = ", ".join(str(p.relative_to(path)) for p in known[:10])
        raise ValueError(f"it is a folder; name the training script ({names or 'no *train*.py'})")
    try:
        old = path.read_bytes()
    except OSError as error:
        raise ValueError(f"it cannot be read: {error}") from None
    new, notes = edited(old, path.parent)
    before, after = (text.decode().splitlines(keepends=True) for text in (old, new))
    lines = difflib.unified_diff(before, after, str(path), str(path), n=1)
    return Edited(new, "".join(lines), notes)


def write(path: Path) -> Path:
    """Apply the lines to the file at `path`; returns the backup's path.

    Raises:
        ValueError: as `edited`, there is a backup already, or the file cannot be written; it and
            its folder are then as they were.
    """
    backup = path.with_name(path.name + ".orig")
    if backup.exists():
        raise ValueError(f"its backup {backup} exists already; remove it or move it away")
    new = diff(path).new
    old = path.read_bytes()
    try:
        with path.open("r+b") as file:  # before there is a backup: can it be written at all?
            backup.write_bytes(old)
            file.truncate()
            file.write(new)
    except OSError as error:
        if backup.exists():
            path.write_bytes(old)
            backup.unlink()
        raise ValueError(f"it cannot be written: {error}") from None
    return backup


# -- where the lines go ------------------------------------------------------------------------


class File:
    """Positions in a source's bytes."""

    def __init__(self, source: bytes) -> None:
        self.lines = re.findall(rb"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+\Z", source)
        starts = [0]
        for line in self.lines:
            starts.append(starts[-1] + len(line))
        self.starts = starts

    def at(self, line: int, column: int) -> int:
        """The byte of a syntax tree's (line, column)."""
        return self.starts[line - 1] + column

    def span(self, node: ast.expr) -> tuple[int, int]:
        """The bytes of an expression."""
        end_line, end_column = node.end_lineno, node.end_col_offset
        assert end_line is not None
        assert end_column is not None
        return self.at(node.lineno, node.col_offset), self.at(end_line, end_column)

    def before(self, node: ast.stmt, lines: list[str]) -> Change:
        """Lines above a statement, with its indentation and its line's end."""
        first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
        text = self.lines[first - 1]
        indent, end = text[: node.col_offset].decode(), _line_end(text)
        if indent.strip():
            raise ValueError(f"line {first} has several statements: {text.decode().strip()}")
        start = self.starts[first - 1]
        return Change(start, start, "".join(f"{indent}{line}{end}" for line in lines))

    def after(self, node: ast.stmt, lines: list[str]) -> Change:
        """Lines below a statement."""
        last = node.end_lineno or node.lineno
        indent = self.lines[node.lineno - 1][: node.col_offset].decode()
        text = self.lines[last - 1]
        rest = text[node.end_col_offset or 0 :].decode().strip()
        if indent.strip() or (rest and not rest.startswith("#")):
            raise ValueError(f"line {last} has several statements: {text.decode().strip()}")
        end = _line_end(text)
        new = "".join(f"{indent}{line}{end}" for line in lines)
        start = self.starts[last]
        if not text.endswith((b"\n", b"\r")):  # the file's last line
            new = end + new[: -len(end)]
        return Change(start, start, new)


def _changes(file: File, tree: ast.Module, trainer: Trainer) -> list[Change]:
    name = _free_name(trainer)
    upgrade = _upgrade_lines(trainer, name)
    point = _upgrade_point(trainer)
    options = ""
    if _bound_before(trainer, "world_size", point):
        options = ", process_group=torch.distributed.group.WORLD if world_size > 1 else None"
    scheduler = f"{name} = PhaseScheduler({trainer.total}{options})"
    observe = f"{name}.observe({trainer.loss}{_iteration(trainer)})"
    changes = [_import(file, tree), file.before(point, [scheduler, *upgrade])]
    changes += [file.after(statement, [observe]) for statement in trainer.backwards]
    changes += [file.after(statement, upgrade) for statement in trainer.setups]
    for value, (render, photo) in trainer.pixel:
        changes.append(
            Change(
                *file.span(value), f"{name}.pixel_loss({ast.unparse(render)}, {ast.unparse(photo)})"
            )
        )
    return changes


def _upgrade_lines(trainer: Trainer, name: str) -> list[str]:
    first, *second = trainer.optimizers
    lines = [f"{first} = {name}.upgrade({first})"]
    for other in second:  # None where the trainer's options leave it out
        lines += [f"if {other} is not None:", f"    {other} = {name}.upgrade({other})"]
    return lines


def _iteration(trainer: Trainer) -> str:
    """The trainer's own count, where a checkpoint may start it later."""
    if trainer.shift is None or not (trainer.shift or trainer.resumes):
        return ""
    count = ast.unparse(trainer.loop.target)
    return f", iteration={count} - 1" if trainer.shift else f", iteration={count}"


def _upgrade_point(trainer: Trainer) -> ast.stmt:
    """The statement above which the optimizers are upgraded.

    After the last set-up or restore, and above the learning-rate schedulers, if there are any.
    """
    body = trainer.function.body
    outer = next((s for s in body if trainer.loop in within([s])), None)
    if outer is None:
        raise ValueError(f"line {trainer.loop.lineno}: the loop is in a nested function")
    if outer is not trainer.loop:
        return trainer.loop
    above = body[: body.index(outer)]
    makes = [i for i, s in enumerate(above) if _makes_optimizers(s, trainer)]
    start = makes[-1] + 1 if makes else 0
    owner = trainer.optimizers[0]
    for statement in above[start:]:
        text = ast.unparse(statement)
        if owner in text and re.search(r"lr_scheduler|LR\(", text):
            return statement
    return outer


def _makes_optimizers(statement: ast.stmt, trainer: Trainer) -> bool:
    owner = trainer.optimizers[0].rsplit(".", 1)[0]
    text = ast.unparse(statement)
    return f"{owner}.training_setup(" in text or f"{owner}.restore(" in text


def _free_name(trainer: Trainer) -> str:
    used = {n.id for n in ast.walk(trainer.function) if isinstance(n, ast.Name)}
    used |= {a.arg for a in ast.walk(trainer.function) if isinstance(a, ast.arg)}
    return "opt3dgs_phases" if "phases" in used else "phases"


def _bound_before(trainer: Trainer, name: str, point: ast.stmt) -> bool:
    arguments = {a.arg for a in ast.walk(trainer.function.args) if isinstance(a, ast.arg)}
    return name in arguments or any(
        isinstance(n, ast.Name) and n.id == name and isinstance(n.ctx, ast.Store)
        for n in within(trainer.function.body)
        if getattr(n, "lineno", point.lineno) < point.lineno
    )


def _import(file: File, tree: ast.Module) -> Change:
    imports = [s for s in tree.body if isinstance(s, (ast.Import, ast.ImportFrom))]
    if not imports:
        raise ValueError("it has no imports")
    functions = [s.lineno for s in tree.body if isinstance(s, (ast.FunctionDef, ast.ClassDef))]
    above = [s for s in imports if s.lineno < min(functions, default=s.lineno + 1)]
    return file.after((above or imports)[-1], [IMPORT])


def _apply(source: bytes, changes: list[Change]) -> bytes:
    for change in sorted(changes, reverse=True):
        source = source[: change.start] + change.text.encode() + source[change.end :]
    return source


def _line_end(line: bytes) -> str:
    return line[len(line.rstrip(b"\r\n")) :].decode() or "\n"


# -- what is written is checked -----------------------------------------------------------------


def _parsed(source: bytes) -> ast.Module:
    try:
        source.decode()
        return ast.parse(source)
    except (SyntaxError, ValueError) as error:
        raise ValueError(f"it cannot be read as Python: {error}") from None


def _modules(node: ast.AST) -> set[str]:
    names: list[str | None] = []
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom):
        names = [node.module]
    return {name.split(".")[0] for name in names if name}


def _check(new: bytes, trainer: Trainer) -> None:
    """ValueError unless the new source compiles and binds what our lines use before they do."""
    text = new.decode()
    try:
        compile(text, "<edited>", "exec", dont_inherit=True)
        table = symtable.symtable(text, "<edited>", "exec")
    except (SyntaxError, ValueError) as error:
        raise ValueError(f"the lines do not fit into it: {error}") from None
    functions = [
        n
        for n in ast.walk(ast.parse(text))
        if isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef))
        and n.name == trainer.function.name
        and "PhaseScheduler" in ast.unparse(n)
    ]
    (function,) = functions
    scope = _scope(table, function)
    first = function.lineno
    for statement in within(function.body):
        if not isinstance(statement, (ast.Assign, ast.Expr, ast.If)) or not _ours(statement):
            continue
        for node in ast.walk(statement.test if isinstance(statement, ast.If) else statement):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
                _check_bound(node, scope, table, function, first)


def _ours(statement: ast.Assign | ast.Expr | ast.If) -> bool:
    text = ast.unparse(statement.test if isinstance(statement, ast.If) else statement)
    calls = ("PhaseScheduler(", "phases.upgrade(", "phases.observe(", "phases.pixel_loss(")
    return any(call in text for call in calls)


def _scope(table: symtable.SymbolTable, function: ast.AST) -> symtable.SymbolTable:
    tables = [table]
    for one in tables:
        tables += one.get_children()
        if one.get_type() == "function" and one.get_lineno() == getattr(function, "lineno", 0):
            return one
    raise ValueError("its training function is not found again")


def _check_bound(
    name: ast.Name,
    scope: symtable.SymbolTable,
    module: symtable.SymbolTable,
    function: ast.FunctionDef | ast.AsyncFunctionDef,
    first: int,
) -> None:
    symbol = scope.lookup(name.id)
    if symbol.is_parameter() or symbol.is_free():
        return
    if symbol.is_local():
        stores = [
            n.lineno
            for n in within(function.body)
            if isinstance(n, ast.Name) and n.id == name.id and isinstance(n.ctx, ast.Store)
        ]
        if symbol.is_imported() or any(first <= line <= name.lineno for line in stores):
            return
    elif name.id in module.get_identifiers():
        found = module.lookup(name.id)
        if found.is_assigned() or found.is_imported() or found.is_namespace():
            return
    elif hasattr(builtins, name.id):
        return
    raise ValueError(f"the name {name.id} is not defined where the lines need it")
