"""Where a training loop may put other optimizers in the place of those that were upgraded."""

import ast
from collections.abc import Callable

from opt3dgs_optim.hosts.syntax import (
    FUNCTIONS,
    MUTATING,
    Spot,
    loops_around,
    refusal,
    spots,
    values,
)

SECOND = ("shoptimizer",)  # of Gaussians; any other, as of exposures or networks, is left alone


def find_remade(
    trees: list[ast.Module], own: list[Spot], loop: ast.stmt, optimizer: str
) -> list[ast.stmt]:
    """The statements in a loop after which the optimizers may be others, in the file's order.

    Upgrading again what is the same changes nothing, so that one too many does no harm.

    Args:
        trees: the file, and those of the model.
        own: every node of the loop's scope.
        loop: the training loop.
        optimizer: the expression of the optimizers.

    Raises:
        ValueError: the object that holds them is exchanged, it happens in a condition, or they are
            made in the loop alone.
    """
    inside = [spot for spot in own if loop in loops_around(spot)]
    owner, _, name = optimizer.rpartition(".")
    names = {optimizer, *(n for n in _aliases(own, optimizer))}
    makers = _functions(trees, {"training_setup", "restore"}, lambda f: _makes(f, name))
    exchangers = _functions(trees, set(), lambda f: _exchanges(f, owner))
    changers = _functions(trees, set(), _changes_argument)
    found: list[ast.stmt] = []
    for spot in inside:
        called = ""
        match spot.node:
            case ast.Call(ast.Name(known) | ast.Attribute(_, known)):
                called = known
        stored = isinstance(getattr(spot.node, "ctx", None), ast.Store)
        text = ast.unparse(spot.node) if stored else ""
        if (owner and text == owner) or called in exchangers:
            raise refusal(spot.line, f"{owner}, which has the optimizers, gets another value here")
        match spot.node:
            case ast.Name(_, ast.Store()) | ast.Attribute(_, _, ast.Store()):
                makes = text == optimizer
            case ast.Subscript(holder, _, ast.Store()):
                makes = ast.unparse(holder) in names
            case ast.Call(ast.Attribute(holder, method)) if method in MUTATING:
                makes = ast.unparse(holder) in names or called in makers
            case ast.Call(_, arguments, keywords):
                given = {ast.unparse(each) for each in (*arguments, *(k.value for k in keywords))}
                makes = called in makers or (called in changers and bool(given & names))
            case _:
                makes = False
        if not makes:
            continue
        statement = next(node for node in reversed(spot.above) if isinstance(node, ast.stmt))
        if not isinstance(statement, (ast.Expr, ast.Assign, ast.AnnAssign)):
            raise refusal(
                spot.line,
                f"{optimizer} may be made anew by {ast.unparse(spot.node)}, and no line can stand "
                "directly below it; give it a statement of its own",
            )
        if statement not in found:
            found.append(statement)
    if found:
        _check_made_above(own, loop, owner, makers)
    return found


def set_ups(among: list[Spot], owner: str) -> list[ast.stmt]:
    """The statements that make a model's optimizers."""
    statements = [spot.node for spot in among if isinstance(spot.node, ast.Expr)]
    return [s for s in statements if ast.unparse(s).startswith(f"{owner}.training_setup(")]


def _check_made_above(own: list[Spot], loop: ast.stmt, owner: str, makers: set[str]) -> None:
    """ValueError where a model that is made above a loop gets its optimizers in the loop alone."""
    above = [spot for spot in own if spot.line < loop.lineno]
    made = [line for line, value in values(above, owner) if isinstance(value, ast.Call)]
    for spot in above:
        match spot.node:
            case ast.Call(ast.Name(name) | ast.Attribute(_, name)) if name in makers:
                return
            case ast.Attribute(_, _, ast.Store()) as node if ast.unparse(node.value) == owner:
                return
    setups = set_ups([spot for spot in own if loop in loops_around(spot)], owner)
    if made and setups:
        raise refusal(
            setups[0], f"{owner} gets its optimizers in the loop alone: there are none above it"
        )


def _aliases(own: list[Spot], optimizer: str) -> set[str]:
    """Other names of the optimizers."""
    found: set[str] = set()
    for spot in own:
        match spot.node:
            case ast.Assign([ast.Name(name)], value) if ast.unparse(value) == optimizer:
                found.add(name)
    return found


def _functions(
    trees: list[ast.Module], known: set[str], does: Callable[[ast.AST], bool]
) -> set[str]:
    """The functions and methods of these files that do something, or call such a one, by name."""
    calls: dict[str, set[str]] = {}
    found = set(known)
    for function in [node for tree in trees for node in ast.walk(tree)]:
        if not isinstance(function, FUNCTIONS) or function.name.startswith("__"):
            continue
        if does(function):
            found.add(function.name)
        for spot in spots(function):
            match spot.node:
                case ast.Call(ast.Name(name) | ast.Attribute(_, name)):
                    calls.setdefault(function.name, set()).add(name)
    while more := {name for name, called in calls.items() if called & found} - found:
        found |= more
    return found


def _makes(function: ast.AST, optimizer: str) -> bool:
    """Whether a function sets an attribute `optimizer` or `optimizers`, or an item of it."""
    names = {"optimizer", "optimizers", *SECOND, optimizer}
    for spot in spots(function):
        match spot.node:
            case ast.Attribute(_, name, ast.Store()) if name in names:
                around = spot.above[-1]
                if not (isinstance(around, ast.Assign) and _is_none(around.value)):
                    return True
            case ast.Name(name, ast.Store()) if name in names and _is_shared(function, name):
                return True
            case ast.Subscript(ast.Name(name) | ast.Attribute(_, name), _, ast.Store()):
                if name in names and not _makes_itself(function, name):
                    return True
            case ast.Call(ast.Attribute(ast.Attribute(_, name) | ast.Name(name), method)) if (
                method in MUTATING and name in names and not _makes_itself(function, name)
            ):
                return True
            case ast.Call(ast.Name("setattr"), [_, ast.Constant(name), _]) if name in names:
                return True
    return False


def _makes_itself(function: ast.AST, name: str) -> bool:
    """Whether a name is one that a function has given a value: not what others hold."""
    own = [*spots(function)]
    given = any(not isinstance(value, ast.Attribute) for _, value in values(own, name) if value)
    return given and not _is_shared(function, name)


def _is_shared(function: ast.AST, name: str) -> bool:
    """Whether a function declares a name to be another scope's."""
    nodes = [spot.node for spot in spots(function)]
    return any(isinstance(n, ast.Global | ast.Nonlocal) and name in n.names for n in nodes)


def _exchanges(function: ast.AST, owner: str) -> bool:
    """Whether a function gives another value to the object that has the optimizers."""
    name = owner.rsplit(".", maxsplit=1)[-1]
    if name in ("", "self", "cls"):
        return False
    for spot in spots(function):
        match spot.node:
            case ast.Attribute(_, attribute, ast.Store()) if attribute == name and "." in owner:
                return True
            case ast.Name(known, ast.Store()) if known == owner and _is_shared(function, name):
                return True
    return False


def _changes_argument(function: ast.AST) -> bool:
    """Whether a function puts items into what it is given."""
    own = [*spots(function)]
    given = {spot.node.arg for spot in own if isinstance(spot.node, ast.arg)}
    for spot in own:
        match spot.node:
            case ast.Subscript(ast.Name(name), _, ast.Store()) if name in given:
                return True
            case ast.Call(ast.Attribute(ast.Name(name), method)) if method in MUTATING:
                if name in given:
                    return True
    return False


def _is_none(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is None
