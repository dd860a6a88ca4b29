"""Python source with one place changed: operators, comparisons, numbers, calls, statements."""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from typing import NamedTuple

SKIPPED = ("__repr__", "__all__")  # what they say is not arithmetic
OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.Mod: ast.Mult,
    ast.FloorDiv: ast.Mult,
}
BOUNDARIES = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
OPPOSITES = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
CALLS = {"amax": "amin", "minimum": "maximum", "maximum": "minimum", "ceil": "floor", "log": "exp"}
ATOMS = (ast.Name, ast.Constant, ast.Call, ast.Attribute, ast.Subscript)
STATEMENTS = (ast.Expr, ast.AugAssign, ast.Pass)


class Mutant(NamedTuple):
    """One changed place: where it is, what the line said, what it says now, the whole module."""

    line: int
    function: str  # "Class.method", "" at the top of the module
    before: str  # the lines that the place spans
    after: str
    source: str

    @property
    def key(self) -> tuple[str, str, str]:
        """What finds it again when lines have moved."""
        return self.function, self.before, self.after


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Every way to change this one node."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        yield ast.Pass()
    elif isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in OPERATORS:
        yield _replaced(node, op=OPERATORS[type(node.op)]())
    elif isinstance(node, ast.Compare):
        first, *others = node.ops
        for table in (BOUNDARIES, OPPOSITES):
            if type(first) in table:
                yield _replaced(node, ops=[table[type(first)](), *others])
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Invert, ast.Not)):
        yield node.operand
    elif isinstance(node, ast.BoolOp):
        yield _replaced(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        more = node.value + 1
        yield ast.Constant(more if more != node.value else 2 * node.value)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        yield from _changed_calls(node, node.func)


def _changed_calls(node: ast.Call, func: ast.Attribute) -> Iterator[ast.AST]:
    if func.attr in CALLS:
        yield _replaced(node, func=_replaced(func, attr=CALLS[func.attr]))
    elif func.attr == "where" and len(node.args) == 3:
        if ast.dump(node.args[1]) != ast.dump(node.args[2]):
            yield _replaced(node, args=[node.args[0], node.args[2], node.args[1]])
    elif func.attr == "clamp":
        yield func.value


def _replaced(node: ast.AST, **fields: object) -> ast.AST:
    other = copy.copy(node)
    for name, value in fields.items():
        setattr(other, name, value)
    return other


def places(tree: ast.AST, function: str = "") -> Iterator[tuple[ast.AST, str]]:
    """Every node that computes something, with the function it is in."""
    for field, value in ast.iter_fields(tree):
        if field in ("annotation", "returns", "decorator_list"):
            continue
        for item in value if isinstance(value, list) else [value]:
            if not isinstance(item, ast.AST) or getattr(item, "name", None) in SKIPPED:
                continue
            if isinstance(item, ast.keyword) and item.arg == "strict":
                continue  # of zip: says what is so, changes nothing
            if isinstance(item, (ast.JoinedStr, ast.Raise, ast.Import, ast.ImportFrom)):
                continue  # messages
            inside = function
            if isinstance(item, (ast.FunctionDef, ast.ClassDef)):
                inside = f"{function}.{item.name}".lstrip(".")
            yield item, inside
            yield from places(item, inside)


def mutants(source: str) -> Iterator[Mutant]:
    """All mutants of a module; each differs from it in one place, comments and lines are kept."""
    lines = source.encode().splitlines(keepends=True)  # columns count bytes
    for node, function in places(ast.parse(source)):
        for changed in changes(node):
            first, last = node.lineno, node.end_lineno  # pyright: ignore[reportAttributeAccessIssue]
            head = lines[first - 1][: node.col_offset]  # pyright: ignore[reportAttributeAccessIssue]
            tail = lines[last - 1][node.end_col_offset :]  # pyright: ignore[reportAttributeAccessIssue]
            text = ast.unparse(changed)
            if not isinstance(changed, (*ATOMS, *STATEMENTS)):
                text = f"({text})"
            after = head + text.encode() + tail
            before = b"".join(lines[first - 1 : last])
            module = b"".join([*lines[: first - 1], after, *lines[last:]])
            yield Mutant(first, function, _one_line(before), _one_line(after), module.decode())


def _one_line(text: bytes) -> str:
    return " ".join(text.decode().split())
