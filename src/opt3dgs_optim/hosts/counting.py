"""How a training loop counts: over which range, how far, and which expression is the iteration."""

import ast
from typing import NamedTuple

from opt3dgs_optim.hosts.syntax import (
    Spot,
    are_exclusive,
    refusal,
    scopes,
    shared_names,
    spots,
    values,
)

RANGES = ("range", "trange")
WRAPPERS = ("tqdm", "track", "iter", "list")  # what goes over its first argument, in its order
OF_PROGRESS_BARS = (
    "refresh",
    "set_description",
    "set_postfix",
    "update",
    "write",
)  # change no order
FUNCTIONS_OF_NUMBERS = ("int", "len", "max", "min", "round", "abs")


class Count(NamedTuple):
    """How many iterations a training has, and which one the loop is in."""

    total: ast.expr
    iteration: str  # an expression, from 0; empty where the number of observed losses is the same


def read_count(
    tree: ast.Module, loop: ast.For, own: list[Spot], observed: ast.stmt, *, each_turn: bool
) -> Count:
    """The count of a loop over a range.

    Args:
        tree: the file's syntax tree.
        loop: the training loop.
        own: every node of its scope.
        observed: the last statement after which the loss is observed.
        each_turn: whether every turn of the loop observes a loss.

    Raises:
        ValueError: it goes over something else, backwards, or over the rest of a training, or
            changes its own count.
    """
    start, end, step = _arguments(loop, own)
    known = _Known(tree, own)
    for value in known.values_of(step):
        if isinstance(value, ast.UnaryOp) or (_number(value) or 1) < 0 or _number(value) == 0:
            raise refusal(loop, f"range(...) with a step of {ast.unparse(value)} counts down")
    _check_rest(loop, start, end, known)
    if not _is_plain(end):
        raise refusal(
            loop,
            f"the number of iterations is {ast.unparse(end)}, which may not be evaluated twice; "
            "give it a name above the loop",
        )
    total, shift = end, ""
    match end:
        case ast.BinOp(left, ast.Add(), ast.Constant(1)) if _is_one_or_more(start, loop, known):
            total, shift = left, " - 1"
    if known.is_zero(start) and _number(step) == 1 and each_turn:
        return Count(total, "")
    count = ast.unparse(loop.target)
    if not isinstance(loop.target, ast.Name):
        raise refusal(loop, f"the loop counts in {count}, but one name is needed")
    last = observed.end_lineno or observed.lineno
    inside = [s for s in own if loop in s.above and s.node is not loop.target and s.line <= last]
    for line, _ in values(inside, count):
        raise refusal(line, f"{count}, the count of the loop, gets another value in it")
    return Count(total, count + shift)


class _Known:
    """What a file says of the value of a name or an attribute."""

    def __init__(self, tree: ast.Module, own: list[Spot]) -> None:
        self.own, self.shared = own, shared_names(tree)
        self.every = [*spots(tree), *(s for each in scopes(tree)[1:] for s in spots(each))]

    def values_of(self, number: ast.expr) -> list[ast.expr]:
        """An expression, and what it is given where it is a name or an attribute, also by `-=`."""
        if not isinstance(number, ast.Name | ast.Attribute):
            return [number]
        text = ast.unparse(number)
        everywhere = isinstance(number, ast.Attribute) or text in self.shared
        found: list[ast.expr] = [number]
        for spot in self.every if everywhere else self.own:
            match spot.node:
                case ast.AugAssign(target, operator, value) if ast.unparse(target) == text:
                    found.append(ast.BinOp(number, operator, value))
        given = values(self.every if everywhere else self.own, text)
        return [*found, *(value for _, value in given if value is not None)]

    def is_zero(self, start: ast.expr) -> bool:
        """Whether a count certainly starts at 0: written so, or a name with this one value."""
        if isinstance(start, ast.Name):
            given = [*values(self.own, start.id)]
            alone = len(given) == 1 and start.id not in self.shared
            return alone and _number(given[0][1]) == 0
        return _number(start) == 0

    def may_be_negative(self, number: ast.expr) -> bool:
        """Whether a number, or what a name is given, is written as a negative one."""
        return any((_number(value) or 0) < 0 for value in self.values_of(number))


def _check_rest(loop: ast.For, start: ast.expr, end: ast.expr, known: _Known) -> None:
    """ValueError where a range from the first iteration on may count only those that are left."""
    if not known.is_zero(start) and _number(start) != 1:
        return
    ends = [end.left] if isinstance(end, ast.BinOp) and _number(end.right) == 1 else [end]
    for value in [value for each in (end, *ends) for value in known.values_of(each)]:
        if _is_difference(value):
            raise refusal(
                loop,
                f"range({ast.unparse(value)}) may be the rest of a training; a range from its "
                "first to its last iteration is needed",
            )
    sources = [loop.iter, *known.values_of(loop.iter)]
    for call in [node for source in sources for node in ast.walk(source)]:
        if isinstance(call, ast.Call):
            for keyword in call.keywords:
                if keyword.arg == "initial" and _number(keyword.value) != 0:
                    raise refusal(
                        call,
                        f"{ast.unparse(call)} begins at {ast.unparse(keyword.value)}, so that its "
                        "range may be the rest of a training; a range from its first to its last "
                        "iteration is needed",
                    )


def _is_difference(number: ast.expr) -> bool:
    """Whether something that is not written there is subtracted."""
    return any(
        isinstance(node, ast.BinOp) and isinstance(node.op, ast.Sub) and _number(node.right) is None
        for node in ast.walk(number)
    )


def _arguments(loop: ast.For, own: list[Spot]) -> tuple[ast.expr, ast.expr, ast.expr]:
    """Start, end and step of the range that a loop goes over."""
    shown = ast.unparse(loop.iter)
    ranges = _ranges(loop.iter, own, loop.lineno)
    found = {tuple(map(ast.unparse, call.args)): call.args for call in ranges}
    if len(found) > 1:
        lines = ", ".join(str(call.lineno) for call in ranges)
        raise refusal(
            loop, f"the loop goes over {shown}, which has several values (lines: {lines})"
        )
    arguments = next(iter(found.values()), [])
    if not 1 <= len(arguments) <= 3 or any(isinstance(a, ast.Starred) for a in arguments):
        raise refusal(
            loop,
            f"the loop goes over {shown}: the number of iterations cannot be read from it, only "
            "from a range(...), bare or in tqdm(...)",
        )
    if len(arguments) == 1:
        arguments = [ast.Constant(0), *arguments]
    start, end, *step = arguments
    return start, end, step[0] if step else ast.Constant(1)


def _ranges(source: ast.expr, own: list[Spot], line: int) -> list[ast.Call]:
    """The calls of `range` that an expression may stand for in a line; none where it is unclear."""
    match source:
        case ast.Name(name):
            given = [(at, value) for at, value in values(own, name) if at < line]
            found = [_ranges(value, own, at) if value else [] for at, value in given]
            if all(found) and given:
                _check_unchanged(name, min(at for at, _ in given), line, own)
            return [call for calls in found for call in calls] if all(found) else []
        case ast.IfExp(_, yes, no):
            arms = [_ranges(arm, own, line) for arm in (yes, no)]
            return [call for calls in arms for call in calls] if all(arms) else []
        case ast.Call(called, arguments):
            name = ast.unparse(called).split(".")[-1]
            if name in RANGES:
                return [source]
            if name in WRAPPERS and arguments:
                return _ranges(arguments[0], own, line)
    return []


def _is_plain(node: ast.AST) -> bool:
    """Whether an expression of numbers can be evaluated twice, and gives the same."""
    match node:
        case ast.Name() | ast.Constant():
            return True
        case ast.Attribute(value) | ast.UnaryOp(_, value):
            return _is_plain(value)
        case ast.Subscript(value, index):
            return _is_plain(value) and _is_plain(index)
        case ast.BinOp(left, _, right):
            return _is_plain(left) and _is_plain(right)
        case ast.Call(ast.Name(name), arguments, []):
            return name in FUNCTIONS_OF_NUMBERS and all(map(_is_plain, arguments))
    return False


def _number(node: ast.AST | None) -> int | None:
    """The integer that is written there, also as the negative or the sum of others."""
    match node:
        case ast.Constant(int(value)) if not isinstance(value, bool):
            return value
        case ast.UnaryOp(ast.USub(), value) if (number := _number(value)) is not None:
            return -number
        case ast.BinOp(left, ast.Add() | ast.Sub() as operator, right):
            one, other = _number(left), _number(right)
            if one is not None and other is not None:
                return one + other if isinstance(operator, ast.Add) else one - other
    return None


def _check_unchanged(name: str, first: int, last: int, own: list[Spot]) -> None:
    """ValueError where a list or a range with a name may be another one before the loop over it."""
    for spot in own:
        match spot.node:
            case ast.Name(known, ast.Load()) if known == name and first < spot.line < last:
                around, outer = spot.above[-1], spot.above[-2]
            case _:
                continue
        match around, outer:
            case ast.Call(ast.Name(called) | ast.Attribute(_, called)), _ if (
                called in (*WRAPPERS, "len", "print") and spot.node is not around.func
            ):
                continue
            case ast.Attribute(_, method, ast.Load()), ast.Call(called) if (
                called is around and method in OF_PROGRESS_BARS
            ):
                continue
        raise refusal(spot.line, f"{name}, which the loop goes over, may be changed here")


def _is_one_or_more(start: ast.expr, loop: ast.For, known: _Known) -> bool:
    """Whether a count certainly starts at 1 or later: by its value, or by `start += 1` above."""
    own = known.own
    match start:
        case ast.BinOp(left, ast.Add(), more) if _number(start) is None:
            return _is_positive(more) and not known.may_be_negative(left)
        case ast.Name(name):
            if name in known.shared or known.may_be_negative(start):
                return False
            at = next(spot for spot in own if spot.node is loop)
            before = [spot for spot in own if spot.line < loop.lineno]
            given = [*values(before, name)]
            if given and all(_is_positive(value) for _, value in given):
                return True
            last = max((line for line, _ in given), default=0)
            return any(
                isinstance(spot.node, ast.AugAssign)
                and spot.line == last
                and ast.unparse(spot.node.target) == name
                and isinstance(spot.node.op, ast.Add)
                and _is_positive(spot.node.value)
                and spot.above[-1] in at.above  # in no branch that may be left out
                and not are_exclusive(spot, at)
                for spot in before
            )
    return _is_positive(start)


def _is_positive(node: ast.AST | None) -> bool:
    """Whether a positive integer is written there."""
    return (_number(node) or 0) >= 1
