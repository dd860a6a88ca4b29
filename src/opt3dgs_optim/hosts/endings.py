"""Whether a training loop is left before its range is over."""

import ast

from opt3dgs_optim.hosts.syntax import (
    FUNCTIONS,
    Spot,
    asks_for_nan,
    called_functions,
    conditions,
    counts_of,
    loops_around,
    refusal,
    spots,
    stored_attributes,
    values,
)

EXITS = ("exit", "quit", "sys.exit", "os._exit")
EXCEPTIONS_THAT_EXIT = {"SystemExit", "KeyboardInterrupt", "StopIteration"}
CLOCKS = ("next", "time", "perf_counter", "monotonic")  # calls that give another value each time


def check_end(tree: ast.Module, loop: ast.stmt, inside: list[Spot], loss: str) -> None:
    """Refuse a loop that is left at a certain count or time, before its range is over.

    Args:
        tree: the file's syntax tree.
        loop: the training loop.
        inside: every node in it.
        loss: the expression of its loss, which is no count although terms are added to it.

    Raises:
        ValueError: the number of iterations cannot be read from the range.
    """
    asked = _Question(tree, loop, inside, counts_of(loop, inside) - {loss})
    caught = _exceptions(tree, loop)
    for spot in inside:
        if not _leaves(spot, loop, caught):
            continue
        handlers = [node.type for node in spot.above if isinstance(node, ast.ExceptHandler)]
        if any(kind is not None and "StopIteration" in ast.unparse(kind) for kind in handlers):
            raise _refused(spot, loop, "the data are over")
        tests = [*conditions(spot, loop)]
        for test in tests:
            if asked.depends_on_count(test, frozenset()):
                raise _refused(spot, loop, ast.unparse(test))
        if not tests and not handlers:
            raise _refused(spot, loop, "nothing is asked")
    for function in called_functions(tree, loop):
        for spot in spots(function):
            if isinstance(spot.node, ast.Raise) and _leaves(spot, loop, caught):
                raise _refused(spot, loop, f"{function.name} raises this")


def _refused(spot: Spot, loop: ast.stmt, where: str) -> ValueError:
    shown = ast.unparse(loop.iter) if isinstance(loop, ast.For) else "its condition"
    return refusal(
        spot.line,
        f"the loop over {shown} is left where {where}: the number of iterations cannot be read "
        "from its range",
    )


def _leaves(spot: Spot, loop: ast.stmt, caught: set[str]) -> bool:
    """Whether a node ends a loop: most exceptions are no end that a training has."""
    match spot.node:
        case ast.Break():
            return loops_around(spot)[-1] is loop
        case ast.Return():
            return True
        case ast.Call(called):
            return ast.unparse(called) in EXITS
        case ast.Raise(ast.Call(called) | (ast.Name() | ast.Attribute() as called)):
            return ast.unparse(called).split(".")[-1] in caught
    return False


def _exceptions(tree: ast.Module, loop: ast.stmt) -> set[str]:
    """The exceptions that end a training: those that a file defines, or catches around the loop."""
    found = set(EXCEPTIONS_THAT_EXIT)
    within = {*ast.walk(loop)}
    for node in ast.walk(tree):
        match node:
            case ast.ClassDef(name):
                found.add(name)
            case ast.ExceptHandler(ast.expr() as kinds) if node not in within:
                each = kinds.elts if isinstance(kinds, ast.Tuple) else [kinds]
                found |= {ast.unparse(kind).split(".")[-1] for kind in each}
    return found


class _Question:
    """What a condition in a loop depends on."""

    def __init__(
        self, tree: ast.Module, loop: ast.stmt, inside: list[Spot], counts: set[str]
    ) -> None:
        self.loop, self.inside, self.counts = loop, inside, counts
        self.functions = {n.name for n in ast.walk(tree) if isinstance(n, FUNCTIONS)}
        self.attributes = stored_attributes(called_functions(tree, loop))

    def depends_on_count(self, test: ast.AST, seen: frozenset[str]) -> bool:
        """Whether the answer changes with a count, through whatever names and flags."""
        if asks_for_nan(test):
            return False
        for node in ast.walk(test):
            match node:
                case ast.Call(ast.Name(name) | ast.Attribute(_, name)) if name in CLOCKS:
                    return True
                case ast.Call(ast.Name(name)) if not seen and name in self.functions:
                    return True
                case ast.Attribute(_, name) if not seen and name in self.attributes:
                    return True
            if isinstance(node, ast.expr) and ast.unparse(node) in self.counts:
                return True
        return any(self._value_depends(name, seen) for name in _outside_calls(test) - seen)

    def _value_depends(self, name: str, seen: frozenset[str]) -> bool:
        """Whether what a name or an attribute is given in the loop depends on a count.

        For a flag, that is whether the place where it is set is reached.
        """
        seen |= {name}
        for value in [value for _, value in values(self.inside, name) if value is not None]:
            if self.depends_on_count(value, seen):
                return True
        for spot in self.inside:
            match spot.node:
                case ast.Assign(targets, ast.Constant()) if name in map(ast.unparse, targets):
                    asked = conditions(spot, self.loop)
                    if any(self.depends_on_count(test, seen) for test in asked):
                        return True
        return False


def _outside_calls(test: ast.AST) -> set[str]:
    """The names and attributes in an expression that are not what a call is given."""
    match test:
        case ast.Name() | ast.Attribute():
            return {ast.unparse(test)}
        case ast.Subscript(holder, index):
            return {ast.unparse(test), *_outside_calls(holder), *_outside_calls(index)}
        case ast.Call():
            return set()
    return {name for child in ast.iter_child_nodes(test) for name in _outside_calls(child)}
