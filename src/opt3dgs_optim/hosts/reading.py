"""What a training script is made of, read from its syntax tree: nothing of it is run.

Looked for is a `for` loop over a `range` with one `loss.backward()` and an optimizer's `step()` in
it: gsplat's `for optimizer in self.optimizers.values()`, or INRIA's `gaussians.optimizer.step()`,
under whatever names the file uses.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

SECOND = ("shoptimizer",)  # of Gaussians; any other, as of exposures or networks, is left alone
USUAL_L1 = ("ll1", "l1loss", "l1_loss", "ll1_render")
CLONES = r"DefaultStrategy|\.(?:prune_and_)?densify\w*(?=\()"  # what clones and splits


class Spot(NamedTuple):
    """A node of a function, and the nodes around it, from the function on."""

    node: ast.AST
    above: tuple[ast.AST, ...]


def spots(tree: ast.AST, *above: ast.AST) -> Iterator[Spot]:
    """Every node below this one, in the file's order; nested functions are not looked into."""
    for child in ast.iter_child_nodes(tree):
        yield Spot(child, (*above, tree))
        if not isinstance(child, (ast.FunctionDef, ast.ClassDef, ast.Lambda)):
            yield from spots(child, *above, tree)


def values(own: list[Spot], name: str) -> Iterator[tuple[int, ast.expr | None]]:
    """The lines in which a name gets a value, and the value, where it is written there."""
    for spot in own:
        match spot:
            case (ast.Name(id, ast.Store()) as node, (*_, around)) if id == name:
                yield node.lineno, around.value if isinstance(around, ast.Assign) else None


@dataclass
class Trainer:
    """The places and names in a training script."""

    function: ast.FunctionDef  # that holds the loop
    spots: list[Spot]  # every node of it
    loop: ast.For
    loss: str  # its name
    backwards: list[ast.stmt]  # `loss.backward()`; several only in branches of an `if`
    total: ast.expr  # how many iterations
    count: str  # the iteration, from 0, where the loop may start later; else empty
    parts: str = ""  # where it clones and splits: the argument that says so
    optimizers: list[str] = field(default_factory=list)  # expressions, the positions' first
    setups: list[ast.stmt] = field(default_factory=list)  # in the loop: they make them anew
    # The L1 terms: what to replace, and its two arguments.
    pixel: list[tuple[ast.expr, list[ast.expr]]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)  # what a user should know of this file


def read_trainer(tree: ast.Module, folder: Path) -> Trainer:
    """The training loop of a file.

    Args:
        tree: its syntax tree.
        folder: where the file lies: the model is read from `scene/*.py` beside it, if there is one.

    Raises:
        ValueError: there is no such loop, or it is not one that can be read with certainty.
    """
    loops: dict[ast.For, ast.FunctionDef] = {}
    for function in [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]:
        for node, above in spots(function):
            around = [n for n in above if isinstance(n, ast.For)]
            if _loss(node) and around:
                loops[around[0]] = function
    if len(loops) != 1:
        lines = ", ".join(str(loop.lineno) for loop in loops) or "none"
        raise ValueError(f"one `for` loop with a loss.backward() in it is needed (lines: {lines})")
    ((loop, function),) = loops.items()
    own = list(spots(function))
    inside = [spot for spot in own if loop in spot.above]
    backwards = [spot for spot in inside if _loss(spot.node)]
    statements = [spot.node for spot in backwards if isinstance(spot.node, ast.stmt)]
    losses = {loss for statement in statements if (loss := _loss(statement))}
    if len(losses) != 1 or not all(_either(a, b) for a, b in combinations(backwards, 2)):
        lines = ", ".join(str(statement.lineno) for statement in statements)
        raise ValueError(f"one loss.backward() an iteration is needed (lines: {lines})")
    trainer = Trainer(function, own, loop, losses.pop(), statements, *_range(loop, own))
    _find_optimizers(trainer, inside, folder)
    _find_pixel_loss(trainer, inside)
    if re.search(CLONES, ast.unparse(tree)):
        choice = re.search(r"isinstance\([\w.]+, DefaultStrategy\)", ast.unparse(loop))
        trainer.parts = ", parts=DEFAULTS_ADC" + (f" if {choice[0]} else None" if choice else "")
    return trainer


def _loss(node: ast.AST) -> str | None:
    """The loss in a statement `loss.backward()` or `scaler.scale(loss).backward()`."""
    match node:
        case ast.Expr(ast.Call(ast.Attribute(receiver, "backward"))):
            match receiver:
                case ast.Name(loss) | ast.Call(ast.Attribute(_, "scale"), [ast.Name(loss), *_]):
                    return loss
    return None


def _either(first: Spot, second: Spot) -> bool:
    """Whether the two are in different arms of an `if`."""
    chains = ((*spot.above[1:], spot.node) for spot in (first, second))
    for node, one, other in zip(first.above, *chains, strict=False):
        if one is not other:
            return isinstance(node, ast.If) and (one in node.orelse) != (other in node.orelse)
    return False


def _range(loop: ast.For, own: list[Spot]) -> tuple[ast.expr, str]:
    """Of the range that a loop counts through: how many, and the count, if it may start later."""
    source = loop.iter
    if isinstance(source, ast.Name):
        above = [v for line, v in values(own, source.id) if v and line < loop.lineno]
        source = above[-1] if above else source
    calls = [n for n in ast.walk(source) if isinstance(n, ast.Call)]
    ranges = [c.args for c in calls if ast.unparse(c.func) in ("range", "tqdm.trange", "trange")]
    if len(ranges) != 1 or len(ranges[0]) not in (1, 2):
        raise ValueError(
            f"the loop in line {loop.lineno} goes over {ast.unparse(loop.iter)}: the number of "
            "iterations cannot be read from it, only from a range(...)"
        )
    start, end = [ast.Constant(0), *ranges[0]][-2:]
    if isinstance(start, ast.Name) and len(once := [*values(own, start.id)]) == 1:
        start = once[0][1]
    count = ast.unparse(loop.target)
    if len([*values([spot for spot in own if loop in spot.above], count)]) != 1:
        count = ""  # the loop gives it other values
    match end:
        case ast.BinOp(total, ast.Add(), ast.Constant(1)) if len(ranges[0]) == 2:
            return total, count and f"{count} - 1"
    return end, "" if isinstance(start, ast.Constant) else count


def _find_optimizers(trainer: Trainer, inside: list[Spot], folder: Path) -> None:
    """Set `optimizers`, `setups` and what is to be said of them."""
    stepped = list(dict.fromkeys(text for spot in inside if (text := _stepped(spot))))
    dicts = [text for text in stepped if text.split(".")[-1] == "optimizers"]
    owners = [text[: -len(".optimizer")] for text in stepped if text.endswith(".optimizer")]
    if len(owners) > 1:
        owners = [owner for owner in owners if _set_up(trainer.spots, owner)]
    if len(dicts) == 1 and not owners:
        trainer.optimizers = dicts
    elif len(owners) == 1:
        (owner,) = owners
        groups, made = _model(folder)
        seconds = [name for name in SECOND if name in made or f"{owner}.{name}" in stepped]
        trainer.optimizers = [f"{owner}.{name}" for name in ("optimizer", *seconds)]
        trainer.setups = _set_up(inside, owner)
        if groups and not groups & {"xyz", "means"}:
            trainer.notes.append(
                "no group of its optimizer is named xyz or means; those with a Gaussian "
                f"parameter's name are acted on (all: {', '.join(sorted(groups))})"
            )
    else:
        raise ValueError(
            "the optimizer of the Gaussians is not clear: one `for optimizer in "
            "X.optimizers.values()` or one `X.optimizer.step()` is needed "
            f"(stepped in the loop: {', '.join(stepped) or 'nothing'})"
        )
    if others := [text for text in stepped if text not in trainer.optimizers]:
        trainer.notes.append(f"left alone: {', '.join(others)}")


def _set_up(among: list[Spot], owner: str) -> list[ast.stmt]:
    """The statements that make a model's optimizers."""
    statements = [spot.node for spot in among if isinstance(spot.node, ast.Expr)]
    return [s for s in statements if ast.unparse(s).startswith(f"{owner}.training_setup(")]


def _stepped(spot: Spot) -> str | None:
    """The expression of the optimizer, or of the many, that a call steps.

    Raises:
        ValueError: it is stepped in a way that is no Adam's.
    """
    match spot.node:
        case ast.Call(ast.Attribute(owner, "optimizer_step")):
            return f"{ast.unparse(owner)}.optimizer"
        case ast.Call(ast.Attribute(owner, "step"), given, options) as call:
            name = ast.unparse(owner)
        case _:
            return None
    if name.endswith("scaler") and given:
        name = ast.unparse(given[0])
    elif not name.endswith("optimizer"):
        return None
    elif options or len(given) > 2:
        raise ValueError(
            f"line {call.lineno}: {ast.unparse(call)} is no step of an Adam; only step() and "
            "step(mask, ...) are known"
        )
    loops = [n for n in spot.above if isinstance(n, ast.For) and ast.unparse(n.target) == name]
    return ast.unparse(loops[-1].iter).removesuffix(".values()") if loops else name


def _model(folder: Path) -> tuple[set[str], set[str]]:
    """The names of the parameter groups, and of all attributes set, in the classes of `scene/`."""
    groups: set[str] = set()
    made: set[str] = set()
    for path in sorted((folder / "scene").glob("*model*.py")):
        try:
            tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError):
            continue
        for node in ast.walk(tree):
            match node:
                case ast.Dict(
                    [ast.Constant("params"), *_, ast.Constant("name")],
                    [*_, ast.Constant(str(name))],
                ):
                    groups.add(name)
                case ast.Attribute(_, name, ast.Store()):
                    made.add(name)
    return groups, made


def _find_pixel_loss(trainer: Trainer, inside: list[Spot]) -> None:
    """Set `pixel`: `L1 = l1_loss(a, b)`, `F.l1_loss(a, b)` or `l1_loss(a, b).mean()`."""
    last = max(statement.lineno for statement in trainer.backwards)
    found: dict[str, list[tuple[ast.expr, list[ast.expr]]]] = {}
    for node, _ in inside:
        match node:
            case ast.Assign(
                [target, *_],
                ast.Call(ast.Attribute(ast.Call(called, [_, _] as pair, []), "mean"))
                | ast.Call(called, [_, _] as pair, []),
            ) if ast.unparse(called).split(".")[-1] == "l1_loss" and node.lineno < last:
                found.setdefault(ast.unparse(target), []).append((node.value, pair))
    names = [name for name in found if name.lower() in USUAL_L1] or list(found)
    if len(names) == 1:
        trainer.pixel = found[names[0]]
    else:
        trainer.notes.append(
            "no L1 = l1_loss(render, photo) was found: the paper's squared loss needs "
            "phases.pixel_loss(render, photo) in its place, the defaults do not"
        )
