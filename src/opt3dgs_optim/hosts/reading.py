"""What a training script is made of, read from its syntax tree: nothing of it is run.

Looked for is a `for` loop over a `range` with one `loss.backward()` and one step of the Gaussians'
optimizer in each turn: gsplat's `for optimizer in self.optimizers.values()`, or INRIA's
`gaussians.optimizer.step()`, under whatever names the file uses. What else a file may hold is
refused, with the line and the reason: a schedule that runs at another speed than the training
would be worse than none.
"""

import ast
import re
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

from opt3dgs_optim.hosts.counting import read_count
from opt3dgs_optim.hosts.optimizers import Step, find_optimizers, read_step
from opt3dgs_optim.hosts.photometric import PixelLoss, find_pixel_loss
from opt3dgs_optim.hosts.syntax import (
    FUNCTIONS,
    Scope,
    Spot,
    are_exclusive,
    counts_of,
    is_reference,
    loops_around,
    refusal,
    scopes,
    spots,
    values,
    with_values,
)

BACKWARDS = ("backward", "manual_backward")
SOMETIMES = re.compile(r"accum|sync|micro", re.I)  # in the condition of a step of several batches


@dataclass
class Trainer:
    """The places and names in a training script."""

    scope: Scope  # the function that holds the loop, or the module
    spots: list[Spot]  # every node of it
    loop: ast.stmt
    loss: str  # an expression
    backwards: list[ast.stmt]  # `loss.backward()`; several only in branches of an `if`
    total: ast.expr  # how many iterations
    iteration: str  # an expression, from 0, where the observed losses may not be as many; else ""
    optimizers: list[str] = field(default_factory=list)  # expressions, the positions' first
    setups: list[ast.stmt] = field(default_factory=list)  # in the loop: they make them anew
    scene: str = ""  # an expression: what the strategy tells of its row edits
    pixel: list[PixelLoss] = field(default_factory=list)  # what to replace
    notes: list[str] = field(default_factory=list)  # what a user should know of this file


def read_trainer(tree: ast.Module, folder: Path) -> Trainer:
    """The training loop of a file.

    Args:
        tree: its syntax tree.
        folder: where the file lies: the model is read from `scene/*.py` beside it, if there is one.

    Raises:
        ValueError: there is no such loop, or it is not one that can be read with certainty; the
            message names the line and the reason.
    """
    scope, own, backwards = _backwards(tree)
    loop = _innermost(backwards)
    inside = [spot for spot in own if loop in loops_around(spot)]
    losses = {ast.unparse(_loss(spot)) for spot in backwards}
    if len(losses) != 1 or not all(are_exclusive(*pair) for pair in combinations(backwards, 2)):
        lines = ", ".join(str(spot.line) for spot in backwards)
        raise refusal(
            backwards[0].line, f"one loss.backward() an iteration is needed (lines: {lines})"
        )
    outermost = loops_around(backwards[0])[0]
    around = [spot for spot in own if outermost in spot.above]
    steps = [step for spot in around if (step := read_step(spot, own)) is not None]
    steps = [step for step in steps if loop in step.loops] or steps
    statements = [spot.above[-1] for spot in backwards]
    found = [statement for statement in statements if isinstance(statement, ast.stmt)]
    (loss,) = losses
    _check_scale(loss, inside)
    trainer = Trainer(scope, own, loop, loss, found, ast.Constant(0), "")
    found_optimizers = find_optimizers(tree, own, loop, steps, folder)
    trainer.optimizers, trainer.setups, trainer.notes = found_optimizers
    main = [step for step in steps if step.optimizer == trainer.optimizers[0]]
    _check_loops(backwards, main)
    _check_rhythm(trainer, inside, backwards, main)
    if not isinstance(loop, ast.For):
        raise refusal(
            loop,
            "the training loop is a `while`: the number of iterations cannot be read from it, only "
            "from a range(...)",
        )
    _check_calls(tree, scope, trainer)
    each_turn = _is_in_each_turn(backwards, inside, loop)
    trainer.total, trainer.iteration = read_count(loop, own, found[-1], each_turn=each_turn)
    trainer.scene = _scene(inside)
    trainer.pixel = find_pixel_loss(inside, loop, max(s.lineno for s in found))
    if not trainer.pixel:
        trainer.notes.append(
            "no L1 = l1_loss(render, photo) was found with certainty: the paper's squared loss "
            "needs phases.pixel_loss(render, photo) in its place, the defaults do not"
        )
    return trainer


def _scene(inside: list[Spot]) -> str:
    """What gsplat's strategy tells of its row edits; "": nothing, or more than one thing."""
    found: set[str] = set()
    for spot in inside:
        match spot.node:
            case ast.Call(ast.Attribute(_, "step_post_backward"), _, keywords):
                given = [k.value for k in keywords if k.arg == "scene"]
                found |= {ast.unparse(value) if is_reference(value) else "" for value in given}
    return found.pop() if len(found) == 1 else ""


# -- the loop --------------------------------------------------------------------------------------


def _backwards(tree: ast.Module) -> tuple[Scope, list[Spot], list[Spot]]:
    """The scope that trains, its nodes, and the calls of `loss.backward()` in a loop of it."""
    every = [(scope, [*spots(scope)]) for scope in scopes(tree)]
    calls = [(scope, own, spot) for scope, own in every for spot in own if _calls_backward(spot)]
    looped = [(scope, own, spot) for scope, own, spot in calls if loops_around(spot)]
    if not calls:
        raise ValueError(
            "one loop with a loss.backward() in it is needed, and there is no loss.backward()"
        )
    if not looped:
        scope, _, spot = calls[0]
        where = f"of {scope.name}" if isinstance(scope, FUNCTIONS) else "of the module"
        raise refusal(
            spot.line,
            f"{ast.unparse(spot.node)} is in no loop {where}; one loop with a loss.backward() in "
            "it is needed, and what calls this is elsewhere",
        )
    if len({scope for scope, _, _ in looped}) > 1:
        lines = ", ".join(str(spot.line) for _, _, spot in looped)
        raise refusal(
            looped[0][2].line,
            f"one loop with a loss.backward() in it is needed, several functions have one "
            f"(lines: {lines})",
        )
    scope, own, _ = looped[0]
    backwards = [spot for _, _, spot in looped]
    for spot in backwards:
        _loss(spot)  # refuses what is no loss
    inner = {spot.node for spot in backwards}
    for _, _, spot in calls:
        around = loops_around(backwards[0])[0]
        if spot.node not in inner and spot.node in ast.walk(around):
            raise refusal(spot.line, "this loss.backward() is in a function inside the loop")
    return scope, own, backwards


def _calls_backward(spot: Spot) -> bool:
    """Whether a node is a call that computes gradients."""
    match spot.node:
        case ast.Call(ast.Attribute(receiver, name)) if name in BACKWARDS:
            return ast.unparse(receiver) != "super()"
    return False


def _loss(spot: Spot) -> ast.expr:
    """The loss in a statement `loss.backward()` or `scaler.scale(loss).backward()`.

    Raises:
        ValueError: it is another expression, or no statement of its own.
    """
    loss: ast.expr | None = None
    match spot.node:
        case ast.Call(ast.Attribute(ast.Call(ast.Attribute(_, "scale"), [scaled]), "backward"), []):
            loss = scaled
        case ast.Call(ast.Attribute(receiver, "backward"), []):  # no accelerator.backward(loss)
            loss = receiver
    if loss is None or not is_reference(loss) or not isinstance(spot.above[-1], ast.Expr):
        raise refusal(
            spot.line,
            f"{ast.unparse(spot.node)}: a statement loss.backward() of a loss with a name is "
            "needed, so that what is observed is what is minimised",
        )
    return loss


def _check_scale(loss: str, inside: list[Spot]) -> None:
    """ValueError where the loss is one that a GradScaler has scaled, by a factor that changes."""
    for line, value in values(inside, loss):
        for node in ast.walk(value) if value else ():
            match node:
                case ast.Call(ast.Attribute(_, "scale" | "scale_loss")):
                    raise refusal(
                        line,
                        f"{loss} is {ast.unparse(node)}, scaled by a factor that changes; the "
                        "scheduler needs the loss itself: scaler.scale(loss).backward()",
                    )


def _innermost(backwards: list[Spot]) -> ast.stmt:
    """The loop that holds every `loss.backward()`, and no other loop in it does."""
    chains = [loops_around(spot) for spot in backwards]
    if any(chain != chains[0] for chain in chains):
        lines = ", ".join(str(spot.line) for spot in backwards)
        raise refusal(
            backwards[0].line,
            f"loss.backward() is called in several loops, one is needed (lines: {lines})",
        )
    loop = chains[0][-1]
    if not isinstance(loop, ast.stmt):  # a comprehension, which holds no statement
        raise refusal(loop, "loss.backward() is called in a comprehension")
    return loop


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
                f"{line}), in the loop of line {_line(around[len(step.loops)])}: observe the mean "
                "of its losses once, above the step",
            )
        raise refusal(
            line, f"{step.optimizer} steps in another loop than loss.backward() (line {backward})"
        )
    if len(around) > 1:
        raise refusal(
            around[-1],
            f"the training loop runs inside another loop (line {_line(around[-2])}): the "
            "iterations of all its runs together are the schedule's, and cannot be read from one "
            "of them",
        )


def _check_rhythm(
    trainer: Trainer, inside: list[Spot], backwards: list[Spot], steps: list[Step]
) -> None:
    """ValueError unless each `loss.backward()` of the loop is followed by one step."""
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
        skips = isinstance(spot.node, ast.Continue) and loops_around(spot)[-1] is trainer.loop
        failed = any(isinstance(node, ast.ExceptHandler) for node in spot.above)
        if skips and not failed and last < spot.line < first:
            raise refusal(
                spot.line,
                f"`continue` between loss.backward() (line {last}) and the step (line {first}): "
                "one step may have several of them",
            )
    for step in steps:
        if not _follows(step.spot, trainer.loop, _statements(backwards)):
            raise refusal(
                step.spot.line,
                f"{step.optimizer} steps also where no loss.backward() (line {last}) came before",
            )
        for node, below in zip(step.spot.above, step.spot.chain, strict=True):
            if isinstance(node, ast.If) and below is not node.test and trainer.loop in step.loops:
                _check_condition(node.test, inside, step)


def _follows(step: Spot, loop: ast.AST, backwards: list[ast.AST]) -> bool:
    """Whether one of the statements has run whenever a turn of the loop comes to a step."""
    for around, below in zip(step.above, step.chain, strict=True):
        if around is loop or loop in step.above[: step.above.index(around)]:
            for name in ("body", "orelse", "finalbody"):
                block: list[Any] = getattr(around, name, [])
                before = block[: block.index(below)] if below in block else []
                if _comes_to(before, backwards):
                    return True
    return False


def _check_condition(test: ast.expr, inside: list[Spot], step: Step) -> None:
    """ValueError where a step is made only in every so many iterations."""
    asked = with_values(test, inside)
    counts = counts_of(step.loops[-1], inside)
    sometimes = SOMETIMES.search(" ".join(map(ast.unparse, asked))) is not None
    for node in [each for value in asked for each in ast.walk(value)]:
        match node:
            case ast.BinOp(_, ast.Mod() | ast.FloorDiv() | ast.BitAnd()):
                sometimes = True
            case ast.Compare(left, [ast.Eq() | ast.In()], [right]):
                sometimes |= bool({ast.unparse(left), ast.unparse(right)} & counts)
            case ast.Call(_, arguments):
                sometimes |= bool({ast.unparse(each) for each in arguments} & counts)
    if sometimes:
        raise refusal(
            step.spot.line,
            f"{step.optimizer} steps only where {ast.unparse(test)}: one step may have several "
            "losses; observe their mean once, above the step",
        )


def _check_calls(
    tree: ast.Module, scope: Scope, trainer: Trainer, seen: frozenset[Scope] = frozenset()
) -> None:
    """ValueError where a function that trains with optimizers of others runs more than once."""
    if isinstance(scope, ast.Module) or _makes_optimizers(scope, trainer.optimizers[0]):
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
                f"{what} and is called in a loop (line {_line(loops[-1])}): the iterations of all "
                "its calls together are the schedule's",
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
            _check_calls(tree, caller, trainer, seen | {scope})


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
                case ast.Call(ast.Name(known)) if known == name and not owners:
                    found.append((spot, loops_around(spot)))
                case ast.Call(ast.Attribute(ast.Name("self" | "cls"), known)) if known == name:
                    found += [(spot, loops_around(spot))] if owners else []
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
    return found


def _makes_optimizers(scope: ast.AST, optimizer: str) -> bool:
    """Whether a function makes the optimizers itself, so that each call trains anew."""
    nodes = [spot.node for spot in spots(scope)]
    return any(
        isinstance(node, ast.stmt) and _gives(node, optimizer, optimizer.removesuffix(".optimizer"))
        for node in nodes
    )


def _gives(statement: ast.stmt, optimizer: str, owner: str) -> bool:
    """Whether a statement makes the optimizer."""
    match statement:
        case ast.Assign(targets):
            return optimizer in {ast.unparse(n) for t in targets for n in ast.walk(t)}
        case ast.Expr(value):
            return ast.unparse(value).startswith(f"{owner}.training_setup(")
    return False


def _is_in_each_turn(backwards: list[Spot], inside: list[Spot], loop: ast.For) -> bool:
    """Whether every turn of a loop comes to a `loss.backward()`."""
    first = min(spot.line for spot in backwards)
    skips = any(isinstance(spot.node, ast.Continue) and spot.line < first for spot in inside)
    fails = any(isinstance(spot.node, ast.Try) and spot.node.handlers for spot in inside)
    return not skips and not fails and _comes_to(loop.body, _statements(backwards))


def _statements(found: list[Spot]) -> list[ast.AST]:
    return [spot.above[-1] for spot in found]


def _comes_to(block: list[ast.stmt], targets: list[ast.AST]) -> bool:
    """Whether statements that run to their end run one of the targets, whatever branches they take.

    A `try` whose handlers leave the block does, if its own statements do.
    """
    leaving = (ast.Continue, ast.Break, ast.Return, ast.Raise)
    for statement in block:
        match statement:
            case ast.If(_, body, orelse):
                found = _comes_to(body, targets) and _comes_to(orelse, targets)
            case ast.With(_, body):
                found = _comes_to(body, targets)
            case ast.Try(body, handlers, _, final):
                leave = all(isinstance(handler.body[-1], leaving) for handler in handlers)
                found = _comes_to(final, targets) or (leave and _comes_to(body, targets))
            case _:
                found = statement in targets
        if found:
            return True
    return False


def _line(node: ast.AST) -> int:
    return getattr(node, "lineno", 1)
