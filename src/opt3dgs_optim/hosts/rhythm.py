"""Whether a training loop takes one step of the Gaussians' optimizer for every loss.

A condition around the step may hold up to some iteration, from one on, in all of them, or wherever
the loss is finite. Every other one, as of every second iteration, may let the gradients of several
losses come together in one step, and is refused.
"""

import ast
import re
from itertools import combinations
from typing import Any, NamedTuple

from opt3dgs_optim.hosts.optimizers import Step
from opt3dgs_optim.hosts.syntax import (
    Spot,
    are_exclusive,
    asks_for_nan,
    called_functions,
    changed_in,
    comes_to,
    conditions,
    line_of,
    loops_around,
    properties,
    refusal,
    shared_names,
    stored_attributes,
    values,
)

SEVERAL_BATCHES = re.compile(r"accum|sync|micro", re.I)  # what decides of a step of several batches
FUNCTIONS_OF_VALUES = (  # give the same for the same
    *("abs", "all", "any", "bool", "float", "getattr", "hasattr", "int", "isinstance", "len"),
    *("max", "min", "round", "str"),
)
METHODS_OF_VALUES = ("endswith", "get", "is_initialized", "lower", "startswith", "upper")
ORDERS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)


class Loop(NamedTuple):
    """A training loop, and what may be another value in each of its turns."""

    node: ast.stmt
    inside: list[Spot]
    counts: set[str]  # its own names
    changed: set[str]  # expressions
    changed_attributes: set[str]  # properties, and by the functions that it calls: the names


def check_rhythm(
    tree: ast.Module, loop: ast.stmt, inside: list[Spot], backwards: list[Spot], steps: list[Step]
) -> None:
    """Refuse a loop that does not follow each `loss.backward()` with one step.

    Args:
        tree: the file's syntax tree.
        loop: the training loop.
        inside: every node in it.
        backwards: the calls of `loss.backward()`.
        steps: the steps of the Gaussians' optimizer.

    Raises:
        ValueError: some turn makes a step without a loss, two steps, or none after its loss.
    """
    _check_loops(backwards, steps)
    last = max(spot.line for spot in backwards)
    first = min(step.spot.line for step in steps)
    if first < last:
        raise refusal(
            first, f"{steps[0].optimizer} steps above loss.backward() (line {last}), not below it"
        )
    for one, other in combinations([step.spot for step in steps], 2):
        if not are_exclusive(one, other):
            raise refusal(
                other.line, f"{steps[0].optimizer} steps twice an iteration (line {one.line})"
            )
    for spot in inside:
        skips = isinstance(spot.node, ast.Continue) and loops_around(spot)[-1] is loop
        if skips and not _skips_a_loss(spot, last) and last < spot.line < first:
            raise refusal(
                spot.line,
                f"`continue` between loss.backward() (line {last}) and the step (line {first}): "
                "one step may have several of them",
            )
    for step in steps:
        if not _follows(step.spot, loop, [spot.above[-1] for spot in backwards]):
            raise refusal(
                step.spot.line,
                f"{step.optimizer} steps also where no loss.backward() (line {last}) came before",
            )
    _check_conditions(tree, loop, inside, backwards, steps)


def _skips_a_loss(skip: Spot, last: int) -> bool:
    """Whether a `continue` stands where the loss has failed, so that there is none to step for."""
    for node in skip.above:
        if isinstance(node, ast.Try) and any(each in skip.above for each in node.handlers):
            raised = [n for n in ast.walk(node) if isinstance(n, ast.Raise) and n.lineno > last]
            return not raised
    return False


def _check_loops(backwards: list[Spot], steps: list[Step]) -> None:
    """ValueError unless each turn of one loop has a backward and a step, and it runs once."""
    around = loops_around(backwards[0])
    backward = backwards[0].line
    for step in steps:
        if step.loops == around:
            continue
        line = step.spot.line
        if step.loops == around[: len(step.loops)]:
            raise refusal(
                backward,
                f"loss.backward() runs several times for one step of {step.optimizer} (line "
                f"{line}), in the loop of line {line_of(around[len(step.loops)])}: observe the "
                "mean of its losses once, above the step",
            )
        raise refusal(
            line, f"{step.optimizer} steps in another loop than loss.backward() (line {backward})"
        )
    if len(around) > 1:
        raise refusal(
            around[-1],
            f"the training loop runs inside another loop (line {line_of(around[-2])}): the "
            "iterations of all its runs together are the schedule's, and cannot be read from one "
            "of them",
        )


def _follows(step: Spot, loop: ast.AST, backwards: list[ast.AST]) -> bool:
    """Whether one of the statements has run whenever a turn of the loop comes to a step."""
    for around, below in zip(step.above, step.chain, strict=True):
        if around is loop or loop in step.above[: step.above.index(around)]:
            for name in ("body", "orelse", "finalbody"):
                block: list[Any] = getattr(around, name, [])
                before = block[: block.index(below)] if below in block else []
                if comes_to(before, backwards):
                    return True
    return False


# -- conditions around the step --------------------------------------------------------------------


def _check_conditions(
    tree: ast.Module, loop: ast.stmt, inside: list[Spot], backwards: list[Spot], steps: list[Step]
) -> None:
    """ValueError where a step may be left out in the middle of a training."""
    for spot in (*backwards, *(step.spot for step in steps)):
        for node in spot.above:
            if isinstance(node, ast.With) and loop in spot.above[: spot.above.index(node)]:
                for item in node.items:
                    _check_batches(spot.line, steps[0], item.context_expr)
    target = loop.target if isinstance(loop, ast.For) else ast.Tuple([])
    own = {node.id for node in ast.walk(target) if isinstance(node, ast.Name)}
    changed = changed_in(inside) | shared_names(tree)
    attributes = stored_attributes(called_functions(tree, loop)) | properties(tree)
    last = max(step.spot.line for step in steps)  # what comes above the loss is read elsewhere
    between = [spot for spot in inside if backwards[0].line < spot.line <= last]
    facts = Loop(loop, inside, own - changed_in(between), changed | own, attributes)
    always = comes_to(getattr(loop, "body", []), [step.spot.above[-1] for step in steps])
    for step in steps:
        together = not any(are_exclusive(spot, step.spot) for spot in backwards)
        for test in conditions(step.spot, loop):
            _check_batches(step.spot.line, step, test)
            around_all = together and all(test in conditions(spot, loop) for spot in backwards)
            negated = _is_where_false(step.spot, test)
            if not (always or around_all or _is_steady(test, facts, negated=negated)):
                shown = ast.unparse(ast.UnaryOp(ast.Not(), test) if negated else test)
                raise refusal(
                    step.spot.line,
                    f"{step.optimizer} steps only where {shown}: one step may have several losses; "
                    "observe their mean once, above the step",
                )


def _check_batches(line: int, step: Step, test: ast.expr) -> None:
    if SEVERAL_BATCHES.search(ast.unparse(test)):
        raise refusal(
            line,
            f"{step.optimizer} steps only where {ast.unparse(test)}: one step may have several "
            "losses; observe their mean once, above the step",
        )


def _is_where_false(spot: Spot, test: ast.expr) -> bool:
    """Whether a node is what runs where a condition around it does not hold."""
    for node, below in zip(spot.above, spot.chain, strict=True):
        match node:
            case ast.If(asked, _, orelse) if asked is test:
                return below in orelse
            case ast.IfExp(asked, _, orelse) if asked is test:
                return below is orelse
            case ast.BoolOp(ast.Or(), parts) if test in parts:
                return True
    return False


def _is_steady(
    test: ast.expr, loop: Loop, seen: frozenset[str] = frozenset(), *, negated: bool = False
) -> bool:
    """Whether a condition never fails between two turns in which it holds.

    But for a loss that is not finite: its gradients are no part of a sum.
    """
    match test:
        case _ if asks_for_nan(test) or _is_fixed(test, loop):
            return True
        case ast.UnaryOp(ast.Not(), value):
            return _is_steady(value, loop, seen, negated=not negated)
        case ast.BoolOp(operator, parts):
            # Of two that hold from some turn on and up to some turn, only both are without a gap.
            both = isinstance(operator, ast.Or if negated else ast.And)
            alone = sum(not _is_fixed(part, loop) for part in parts) == 1
            steady = all(_is_steady(part, loop, seen, negated=negated) for part in parts)
            return steady and (both or alone)
        case ast.Compare(left, operators, others):
            counted = all(_is_count(n, loop) or _is_fixed(n, loop) for n in (left, *others))
            gap = negated and len(operators) > 1
            return counted and not gap and all(isinstance(each, ORDERS) for each in operators)
        case ast.Name(name) if name not in seen:
            value = _only_value(name, loop)
            return value is not None and _is_steady(value, loop, seen | {name}, negated=negated)
    return False


def _only_value(name: str, loop: Loop) -> ast.expr | None:
    """What a name is given in every turn of a loop, in one place; else None."""
    stores = [spot for spot in loop.inside if _stores(spot, name)]
    given = [value for _, value in values(loop.inside, name)]
    once = len(stores) == len(given) == 1
    return given[0] if once and not any(conditions(stores[0], loop.node)) else None


def _stores(spot: Spot, name: str) -> bool:
    node = spot.node
    return isinstance(node, ast.Name) and node.id == name and isinstance(node.ctx, ast.Store)


def _is_count(number: ast.expr, loop: Loop) -> bool:
    """Whether an expression is the loop's own count, or so far from it in every turn."""
    match number:
        case ast.Name(name):
            return name in loop.counts
        case ast.BinOp(left, ast.Add() | ast.Sub(), right):
            return _is_count(left, loop) and _is_fixed(right, loop)
    return False


def _is_fixed(value: ast.expr, loop: Loop) -> bool:
    """Whether an expression is certainly the same in every turn of a loop."""
    for node in ast.walk(value):
        match node:
            case ast.Name() | ast.Attribute() if ast.unparse(node) in loop.changed:
                return False
            case ast.Attribute(_, name) if name in loop.changed_attributes:
                return False
            case ast.Call(ast.Name(name)) if name in FUNCTIONS_OF_VALUES:
                continue
            case ast.Call(ast.Attribute(_, name)) if name in METHODS_OF_VALUES:
                continue
            case ast.Call() | ast.NamedExpr() | ast.Await() | ast.Yield() | ast.Lambda():
                return False
    return True
