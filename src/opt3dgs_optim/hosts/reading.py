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

from opt3dgs_optim.hosts.calls import check_calls
from opt3dgs_optim.hosts.counting import read_count
from opt3dgs_optim.hosts.endings import check_end
from opt3dgs_optim.hosts.optimizers import find_optimizers, model_files, read_step
from opt3dgs_optim.hosts.photometric import PixelLoss, find_pixel_loss
from opt3dgs_optim.hosts.rhythm import check_rhythm
from opt3dgs_optim.hosts.syntax import (
    FUNCTIONS,
    Scope,
    Spot,
    are_exclusive,
    called_functions,
    comes_to,
    is_reference,
    line_of,
    loops_around,
    properties,
    refusal,
    scopes,
    spots,
    stored_attributes,
    values,
)

BACKWARDS = ("backward", "manual_backward")


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
    models = model_files(tree, folder)
    steps = [step for spot in around if (step := read_step(tree, spot, own, models)) is not None]
    steps = [step for step in steps if loop in step.loops] or steps
    statements = [spot.above[-1] for spot in backwards]
    found = [statement for statement in statements if isinstance(statement, ast.stmt)]
    (loss,) = losses
    _check_scale(loss, inside)
    trainer = Trainer(scope, own, loop, loss, found, ast.Constant(0), "")
    found_optimizers = find_optimizers(tree, own, loop, steps, models)
    trainer.optimizers, trainer.setups, trainer.notes = found_optimizers
    if not isinstance(loop, ast.For):
        raise refusal(
            loop,
            "the training loop is a `while`: the number of iterations cannot be read from it, only "
            "from a range(...)",
        )
    main = [step for step in steps if step.optimizer == trainer.optimizers[0]]
    check_rhythm(tree, loop, inside, backwards, main)
    _check_loss(tree, backwards[0], loss, inside)
    check_calls(tree, scope, loop, trainer.optimizers[0])
    each_turn = _is_in_each_turn(backwards, inside, loop)
    trainer.total, trainer.iteration = read_count(tree, loop, own, found[-1], each_turn=each_turn)
    check_end(tree, loop, inside, loss)
    trainer.scene = _scene(inside)
    trainer.pixel, others = find_pixel_loss(tree, inside, loop, max(s.lineno for s in found))
    if not trainer.pixel:
        trainer.notes.append(
            "no L1 = l1_loss(render, photo) was found with certainty: the paper's squared loss "
            "needs phases.pixel_loss(render, photo) in its place, the defaults do not"
        )
    elif others:
        lines = ", ".join(map(str, others))
        trainer.notes.append(
            f"l1_loss of two photos stays as it is in line {lines}, which matters to the paper's "
            "squared loss alone"
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
    scene = found.pop() if len(found) == 1 else ""
    return scene if re.search(r"(^|[._])scene$", scene) else ""  # no number, as `scene_scale`


# -- the loop --------------------------------------------------------------------------------------


def _backwards(tree: ast.Module) -> tuple[Scope, list[Spot], list[Spot]]:
    """The scope that trains, its nodes, and the calls of `loss.backward()` in a loop of it."""
    every = [(scope, [*spots(scope)]) for scope in scopes(tree)]
    calls = [(scope, own, spot) for scope, own in every for spot in own if _is_backward(spot.node)]
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
    around = loops_around(backwards[0])[0]
    for node in ast.walk(around):
        if node not in inner and _is_backward(node):
            raise refusal(node, "this loss.backward() is in a function inside the loop")
    direct = called_functions(tree, around, deep=False)
    for function in called_functions(tree, around):
        others = [
            node
            for node in ast.walk(function)
            if _is_backward(node) and (function in direct or _is_of_a_name(node))
        ]
        if others and function is not scope:
            raise refusal(
                others[0],
                f"{function.name}, which the loop of line {line_of(around)} calls, computes "
                "gradients too; one loss.backward() an iteration is needed",
            )
    return scope, own, backwards


def _is_backward(node: ast.AST) -> bool:
    """Whether a node is a call that computes gradients."""
    match node:
        case ast.Call(ast.Attribute(receiver, name)) if name in BACKWARDS:
            return ast.unparse(receiver) != "super()"
    return False


def _is_of_a_name(backward: ast.AST) -> bool:
    """Whether it is `loss.backward()`: gradients of sums of an image are scores for pruning."""
    match backward:
        case ast.Call(ast.Attribute(receiver)):
            return is_reference(receiver)
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


def _check_loss(tree: ast.Module, backward: Spot, loss: str, inside: list[Spot]) -> None:
    """ValueError where a loss may be something else that has a method `backward`, or a property."""
    reference: ast.AST = ast.parse(loss, mode="eval").body
    attribute = reference.attr if isinstance(reference, ast.Attribute) else ""
    if attribute in properties(tree):
        raise refusal(
            backward.line,
            f"{loss} is a property, which would be computed once more where it is observed; give "
            "it a name above loss.backward()",
        )
    known = attribute in stored_attributes([tree])
    while isinstance(reference, ast.expr):
        known |= any(values(inside, ast.unparse(reference)))
        reference = getattr(reference, "value", tree)
    if loss in ("self", "cls") or not known:
        raise refusal(
            backward.line,
            f"{ast.unparse(backward.node)}: {loss} gets no value in the loop, so that it is not "
            "clear that it is a loss",
        )


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


def _is_in_each_turn(backwards: list[Spot], inside: list[Spot], loop: ast.For) -> bool:
    """Whether every turn of a loop comes to a `loss.backward()`."""
    first = min(spot.line for spot in backwards)
    skips = any(isinstance(spot.node, ast.Continue) and spot.line < first for spot in inside)
    fails = any(isinstance(spot.node, ast.Try) and spot.node.handlers for spot in inside)
    for spot in inside:
        fails |= isinstance(spot.node, ast.withitem) and "suppress(" in ast.unparse(spot.node)
    return not skips and not fails and comes_to(loop.body, _statements(backwards))


def _statements(found: list[Spot]) -> list[ast.AST]:
    return [spot.above[-1] for spot in found]
