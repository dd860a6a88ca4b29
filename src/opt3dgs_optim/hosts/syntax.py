"""What a syntax tree says of places: which loops are around a node, where a name gets its value."""

import ast
from collections.abc import Iterator
from typing import NamedTuple

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
LOOPS = (ast.For, ast.AsyncFor, ast.While)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
Scope = ast.Module | ast.FunctionDef | ast.AsyncFunctionDef


class Spot(NamedTuple):
    """A node of a scope, and the nodes around it, from the scope on."""

    node: ast.AST
    above: tuple[ast.AST, ...]

    @property
    def line(self) -> int:
        """The line in which the node begins."""
        nodes = (self.node, *reversed(self.above))
        return next((n.lineno for n in nodes if isinstance(n, ast.stmt | ast.expr | ast.arg)), 1)

    @property
    def chain(self) -> tuple[ast.AST, ...]:
        """Below each node of `above` the next one on the way to the node itself."""
        return (*self.above[1:], self.node)


def spots(tree: ast.AST, *above: ast.AST) -> Iterator[Spot]:
    """Every node below this one, in the file's order; nested functions are not looked into."""
    for child in ast.iter_child_nodes(tree):
        yield Spot(child, (*above, tree))
        if not isinstance(child, (*FUNCTIONS, ast.ClassDef, ast.Lambda)):
            yield from spots(child, *above, tree)


def scopes(tree: ast.Module) -> list[Scope]:
    """The module and all functions, wherever they stand."""
    return [tree, *(node for node in ast.walk(tree) if isinstance(node, FUNCTIONS))]


def loops_around(spot: Spot) -> list[ast.AST]:
    """The loops that run a node more than once, from the outermost to the innermost.

    The `else` of a loop and what a `for` goes over are evaluated once, and are not in the loop.
    """
    found: list[ast.AST] = []
    for around, inner in zip(spot.above, spot.chain, strict=True):
        match around:
            case ast.For() | ast.AsyncFor():
                inside = inner in around.body
            case ast.While():
                inside = inner not in around.orelse
            case _:
                inside = isinstance(around, COMPREHENSIONS)
        if inside:
            found.append(around)
    return found


def are_exclusive(first: Spot, second: Spot) -> bool:
    """Whether the two are in different arms of an `if` or a `match`: only one of them runs."""
    for node, one, other in zip(first.above, first.chain, second.chain, strict=False):
        if one is not other:
            if isinstance(node, ast.If):
                return (one in node.orelse) != (other in node.orelse) and node.test not in (
                    one,
                    other,
                )
            return isinstance(node, ast.Match) and node.subject not in (one, other)
    return False


def is_reference(node: ast.AST) -> bool:
    """Whether an expression only names a value: `loss`, `self.loss`, `losses["total"]`."""
    match node:
        case ast.Name():
            return True
        case ast.Attribute(value) | ast.Subscript(value, ast.Constant()):
            return is_reference(value)
    return False


def counts_of(loop: ast.AST, inside: list[Spot]) -> set[str]:
    """What counts the turns of a loop: its own names, and the targets of `+=` and the like in it.

    Args:
        loop: a `while`, which has no names of its own, counts by what is in it alone.
        inside: the nodes in the loop.
    """
    own = ast.walk(loop.target) if isinstance(loop, ast.For) else ()
    names = {node.id for node in own if isinstance(node, ast.Name)}
    nodes = [spot.node for spot in inside]
    return names | {ast.unparse(node.target) for node in nodes if isinstance(node, ast.AugAssign)}


def with_values(test: ast.expr, inside: list[Spot]) -> list[ast.expr]:
    """A condition, and what the names in it are given in these nodes."""
    names = {node.id for node in ast.walk(test) if isinstance(node, ast.Name)}
    return [test, *(value for name in names for _, value in values(inside, name) if value)]


def values(own: list[Spot], name: str) -> Iterator[tuple[int, ast.expr | None]]:
    """The lines in which a name gets a value, and the value, where it is written there.

    That of an argument, or of a name of another scope, is not. The variables of comprehensions are
    other names.
    """
    for spot in own:
        *above, around = spot.above
        match spot.node:
            case ast.arg(id) as node if id == name:
                yield node.lineno, None
            case (ast.Global(names) | ast.Nonlocal(names)) as node if name in names:
                yield node.lineno, None
            case ast.Name(id, ast.Store()) as node if id == name:
                if isinstance(around, ast.NamedExpr):
                    yield node.lineno, around.value
                elif any(isinstance(each, ast.comprehension) for each in (*above, around)):
                    continue
                elif isinstance(around, ast.Assign | ast.AnnAssign):
                    yield node.lineno, around.value
                elif isinstance(around, ast.withitem):
                    yield node.lineno, around.context_expr
                else:
                    yield node.lineno, None


class NothingToAddError(ValueError):
    """A file is refused, and there are no lines that would make it work."""


def refusal(line: int | ast.AST, reason: str) -> ValueError:
    """The error that says which line cannot be read with certainty, and why."""
    number = line if isinstance(line, int) else getattr(line, "lineno", 1)
    return ValueError(f"line {number}: {reason}")
