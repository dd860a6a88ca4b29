"""What a syntax tree says of places: which loops are around a node, where a name gets its value."""

import ast
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
LOOPS = (ast.For, ast.AsyncFor, ast.While)
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
MUTATING = {  # the methods that change a list, a set or a dict
    *("add", "append", "appendleft", "clear", "discard", "extend", "insert", "pop", "popitem"),
    *("popleft", "remove", "reverse", "setdefault", "sort", "update"),
}
OF_TORCH = {"backward", "eval", "forward", "item", "step", "train", "zero_grad", *MUTATING}
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


def conditions(spot: Spot, loop: ast.AST) -> Iterator[ast.expr]:
    """What is asked inside a loop before it comes to a node: of `if`, `and`, `match` and the like.

    Whether the node runs where the answer is yes or no is not said.
    """
    below_loop = False
    for node, below in zip(spot.above, spot.chain, strict=True):
        below_loop |= node is loop
        if not below_loop:
            continue
        match node:
            case ast.If(test) | ast.IfExp(test) if below is not test:
                yield test
            case ast.BoolOp(_, parts):
                yield from parts[: next(i for i, part in enumerate(parts) if part is below)]
            case ast.Match(subject) if below is not subject:
                yield subject
            case ast.match_case(_, ast.expr() as guard) if below is not guard:
                yield guard
        if isinstance(node, COMPREHENSIONS) and not isinstance(below, ast.comprehension):
            yield from (test for each in node.generators for test in each.ifs)


def counts_of(loop: ast.AST, inside: list[Spot]) -> set[str]:
    """What counts the turns of a loop.

    Its own names, what `+=`, `n = n + 1` and the like change, and lists that grow or shrink in it.

    Args:
        loop: a `while`, which has no names of its own, counts by what is in it alone.
        inside: the nodes in the loop.
    """
    own = ast.walk(loop.target) if isinstance(loop, ast.For) else ()
    found = {node.id for node in own if isinstance(node, ast.Name)}
    for spot in inside:
        match spot.node:
            case ast.AugAssign(target):
                found.add(ast.unparse(target))
            case ast.Assign([target], ast.BinOp() as value) | ast.NamedExpr(
                target, ast.BinOp() as value
            ):
                terms = {ast.unparse(value.left), ast.unparse(value.right)}
                found |= {ast.unparse(target)} & terms
            case ast.Call(ast.Attribute(holder, method)) if method in MUTATING:
                found.add(ast.unparse(holder))
    return found


def changed_in(inside: list[Spot]) -> set[str]:
    """What gets a value in these nodes, or has an item or a method that changes it, as text."""
    found: set[str] = set()
    for spot in inside:
        match spot.node:
            case ast.Subscript(holder, _, ast.Store() | ast.Del()):
                found.add(ast.unparse(holder))
            case ast.Name(_, ast.Store()) | ast.Attribute(_, _, ast.Store()) as node:
                found.add(ast.unparse(node))
            case ast.Call(ast.Attribute(holder, method)) if method in MUTATING:
                found.add(ast.unparse(holder))
    return found


def called_functions(
    tree: ast.Module, node: ast.AST, *, deep: bool = True
) -> list[ast.FunctionDef]:
    """The functions and methods of a file that are called below a node, or by such a one.

    They are known by their names alone, so that there may be one too many.

    Args:
        tree: the file's syntax tree.
        node: where they are called.
        deep: False leaves out those that only other functions call.
    """
    every = [each for each in ast.walk(tree) if isinstance(each, FUNCTIONS)]
    found: list[Any] = []
    waiting = [node]
    while waiting:
        names: set[str] = set()
        for each in ast.walk(waiting.pop()):
            match each:
                case ast.Call(ast.Name(name)):
                    names.add(name)
                case ast.Call(ast.Attribute(holder, name)):
                    own = isinstance(holder, ast.Name) and holder.id in ("self", "cls")
                    names |= {name} if own or name not in OF_TORCH else set()
        more = [each for each in every if each.name in names and each not in found]
        found += more
        waiting += more if deep else []
    return found


def shared_names(tree: ast.Module) -> set[str]:
    """The names that some function declares `global` or `nonlocal`: another scope may change it."""
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Global | ast.Nonlocal)]
    return {name for node in nodes for name in node.names}


def stored_attributes(functions: Iterable[ast.AST]) -> set[str]:
    """The names of the attributes that get a value in these functions."""
    nodes = [node for function in functions for node in ast.walk(function)]
    return {n.attr for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)}


def properties(tree: ast.Module) -> set[str]:
    """The names of the properties that the classes of a file have."""
    functions = [node for node in ast.walk(tree) if isinstance(node, FUNCTIONS)]
    return {f.name for f in functions if "property" in " ".join(map(ast.unparse, f.decorator_list))}


def references(node: ast.AST) -> set[str]:
    """The names and attributes below a node, as text."""
    return {ast.unparse(n) for n in ast.walk(node) if isinstance(n, ast.Name | ast.Attribute)}


def asks_for_nan(test: ast.AST) -> bool:
    """Whether a condition is only whether a number is finite."""
    match test:
        case ast.UnaryOp(ast.Not(), value):
            return asks_for_nan(value)
        case ast.BoolOp(_, parts):
            return all(map(asks_for_nan, parts))
        case ast.Call(ast.Attribute(value, "any" | "all" | "item"), []):
            return asks_for_nan(value)
        case ast.Call(ast.Name(name) | ast.Attribute(_, name)):
            return name in ("isnan", "isinf", "isfinite")
    return False


def values(own: list[Spot], name: str) -> Iterator[tuple[int, ast.expr | None]]:
    """The lines in which a name or an attribute gets a value, and that, where it is written there.

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
            case (
                ast.Name(_, ast.Store())
                | ast.Attribute(_, _, ast.Store())
                | ast.Subscript(_, _, ast.Store())
            ) as node if ast.unparse(node) == name:
                if isinstance(around, ast.NamedExpr):
                    yield node.lineno, around.value
                elif any(isinstance(each, ast.comprehension) for each in (*above, around)):
                    continue
                elif isinstance(around, ast.Assign | ast.AnnAssign):
                    yield node.lineno, around.value
                elif isinstance(around, ast.withitem):
                    yield node.lineno, around.context_expr
                elif isinstance(around, ast.Tuple | ast.List):
                    yield node.lineno, _paired(node, around, above[-1])
                else:
                    yield node.lineno, None


def _paired(target: ast.expr, targets: ast.Tuple | ast.List, statement: ast.AST) -> Any:
    """What one of several targets is given: `b` of `x, y = a, b`; None where it is not written."""
    match statement:
        case ast.Assign(_, ast.Tuple(given) | ast.List(given)) if len(given) == len(targets.elts):
            if not any(isinstance(each, ast.Starred) for each in (*given, *targets.elts)):
                return given[next(i for i, each in enumerate(targets.elts) if each is target)]
    return None


def comes_to(block: list[ast.stmt], targets: list[ast.AST]) -> bool:
    """Whether statements that run to their end run one of the targets, whatever branches they take.

    A `try` whose handlers leave the block does, if its own statements do.
    """
    leaving = (ast.Continue, ast.Break, ast.Return, ast.Raise)
    for statement in block:
        match statement:
            case ast.If(_, body, orelse):
                found = comes_to(body, targets) and comes_to(orelse, targets)
            case ast.With(_, body):
                found = comes_to(body, targets)
            case ast.Try(body, handlers, _, final):
                leave = all(isinstance(handler.body[-1], leaving) for handler in handlers)
                found = comes_to(final, targets) or (leave and comes_to(body, targets))
            case _:
                found = statement in targets
        if found:
            return True
    return False


def runs_before(spot: Spot, targets: list[ast.AST]) -> bool:
    """Whether one of the statements has always run when a node is reached."""
    for around, below in zip(spot.above, spot.chain, strict=True):
        for name in ("body", "orelse", "finalbody"):
            block = getattr(around, name, [])
            inside = isinstance(block, list) and below in block
            if inside and comes_to(block[: block.index(below)], targets):
                return True
    return False


def line_of(node: ast.AST) -> int:
    """The line in which a node begins."""
    return getattr(node, "lineno", 1)


class NothingToAddError(ValueError):
    """A file is refused, and there are no lines that would make it work."""


def refusal(line: int | ast.AST, reason: str) -> ValueError:
    """The error that says which line cannot be read with certainty, and why."""
    number = line if isinstance(line, int) else line_of(line)
    return ValueError(f"line {number}: {reason}")
