"""How often the function that trains is called on the same optimizers."""

import ast
from itertools import combinations

from opt3dgs_optim.hosts.syntax import (
    FUNCTIONS,
    Scope,
    Spot,
    are_exclusive,
    comes_to,
    line_of,
    loops_around,
    refusal,
    scopes,
    spots,
    values,
)

REPEATING = ("imap", "map", "partial", "repeat", "starmap")  # may call what they are given again


def check_calls(
    tree: ast.Module,
    scope: Scope,
    loop: ast.stmt,
    optimizer: str,
    seen: frozenset[Scope] = frozenset(),
) -> None:
    """Refuse a function that trains with optimizers of others, and runs more than once.

    Args:
        tree: the file's syntax tree.
        scope: the function that trains, or one that calls it.
        loop: the training loop.
        optimizer: the expression of the optimizers.
        seen: the functions on the way here.

    Raises:
        ValueError: it is, or may be, called several times.
    """
    if isinstance(scope, ast.Module) or _makes_optimizers(scope, loop, optimizer):
        return
    if scope in seen:
        raise refusal(
            scope,
            f"{scope.name} trains and calls itself: the iterations of all its calls together are "
            "the schedule's",
        )
    called = _calls(tree, scope)
    what = f"{scope.name} (line {scope.lineno}) trains"
    for spot, loops in called:
        if loops:
            raise refusal(
                spot.line,
                f"{what} and is called in a loop (line {line_of(loops[-1])}): the iterations of "
                "all its calls together are the schedule's",
            )
    for (one, _), (other, _) in combinations(called, 2):
        if one.above[0] is not other.above[0] or not are_exclusive(one, other):
            raise refusal(
                other.line,
                f"{what} and is called twice (line {one.line}): the iterations of both calls "
                "together are the schedule's",
            )
    for spot, _ in called:
        caller = spot.above[0]
        if isinstance(caller, FUNCTIONS) and caller is not scope:
            check_calls(tree, caller, loop, optimizer, seen | {scope})


def _calls(tree: ast.Module, function: ast.AST) -> list[tuple[Spot, list[ast.AST]]]:
    """Where a function is called, and the loops in which that is on the same optimizers.

    A method is called on `self`, or on an object that the same scope has made of its class: one
    that is made in the loop has optimizers of its own. An object that comes from elsewhere may be
    of the class; only `train()`, which every network has too, is not taken for the method there.
    """
    name = getattr(function, "name", "")
    every = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    owners = {node.name for node in every if function in node.body}
    found = []
    for own in [[*spots(scope)] for scope in scopes(tree)]:
        for spot in own:
            match spot.node:
                case ast.Name(known, ast.Load()) if known == name and not owners:
                    if not any(values(own, name)):  # no other value of this name
                        found.append((spot, _loops_of_use(spot, name)))
                case ast.Attribute(ast.Name("self" | "cls"), known) if known == name and owners:
                    found.append((spot, _loops_of_use(spot, name)))
                case ast.Call(ast.Attribute(ast.Name(holder), known)) if known == name:
                    given = [value for _, value in values(own, holder)]
                    if owners and name != "train" and given in ([], [None]):
                        found.append((spot, loops_around(spot)))
                    for made in own:
                        match made.node:
                            case ast.Assign([ast.Name(given)], ast.Call(kind)) if (
                                given == holder and ast.unparse(kind) in owners
                            ):
                                around = loops_around(made)
                                loops = [n for n in loops_around(spot) if n not in around]
                                found.append((spot, loops))
                case ast.Call(ast.Attribute(ast.Attribute(_, held), known)) if (
                    known == name and owners
                ):
                    if name != "train" or _holds(tree, held, owners):
                        found.append((spot, loops_around(spot)))
    return found


def _holds(tree: ast.Module, attribute: str, owners: set[str]) -> bool:
    """Whether an attribute is given an object of one of these classes."""
    for node in ast.walk(tree):
        match node:
            case ast.Assign([ast.Attribute(_, name)], ast.Call(kind)) if name == attribute:
                if ast.unparse(kind) in owners:
                    return True
    return False


def _loops_of_use(spot: Spot, name: str) -> list[ast.AST]:
    """The loops in which a function is called, where its name stands.

    Raises:
        ValueError: it gets another name, or is given to what may call it several times.
    """
    around = spot.above[-1]
    if isinstance(around, ast.keyword):
        around = spot.above[-2]
    match around:
        case ast.Call(called) if called is spot.node:
            return loops_around(spot)
        case ast.Call(ast.Name(called) | ast.Attribute(_, called)) if called not in REPEATING:
            return loops_around(spot)
    raise refusal(
        spot.line,
        f"{name} trains, and may be called several times by way of {ast.unparse(around)}: the "
        "iterations of all its calls together are the schedule's",
    )


def _makes_optimizers(scope: Scope, loop: ast.stmt, optimizer: str) -> bool:
    """Whether a function always makes the optimizers itself, so that each call trains anew."""
    owner = optimizer.removesuffix(".optimizer")
    statements = [spot.node for spot in spots(scope) if isinstance(spot.node, ast.stmt)]
    if loop in statements:
        statements = [statement for statement in statements if statement.lineno < loop.lineno]
    return comes_to(scope.body, [each for each in statements if _gives(each, optimizer, owner)])


def _gives(statement: ast.stmt, optimizer: str, owner: str) -> bool:
    """Whether a statement makes the optimizer."""
    match statement:
        case ast.Assign(targets):
            return optimizer in {ast.unparse(n) for t in targets for n in ast.walk(t)}
        case ast.Expr(value):
            return ast.unparse(value).startswith(f"{owner}.training_setup(")
    return False
