"""What a training script is made of, read from its syntax tree: nothing of it is run.

Looked for is a `for` loop over a `range` with one `loss.backward()` and an optimizer's `step()` in
it: gsplat's `for optimizer in self.optimizers.values()`, or INRIA's `gaussians.optimizer.step()`,
under whatever names the file uses.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

Function = ast.FunctionDef | ast.AsyncFunctionDef
# A second optimizer of Gaussians; any other, as of exposures or networks, is left alone.
SECOND = ("shoptimizer",)


@dataclass
class Trainer:
    """The places and names in a training script.

    Args:
        function: the one that holds the loop.
        loop: the training loop.
        total: how many iterations, as the file writes it.
        shift: what the loop's variable is at its start: 0 or 1; None where it is assigned to.
        resumes: whether the loop may start later.
        backwards: the statements `loss.backward()`; several only in branches of an `if`.
        loss: the name of the loss.
        optimizers: the expressions of the optimizers, the positions' first.
        pixel: the L1 terms: the call to replace and its two arguments.
        setups: statements in the loop that make the model's optimizers anew.
        notes: what a user should know of this file.
    """

    function: Function
    loop: ast.For
    total: str
    shift: int | None
    resumes: bool
    backwards: list[ast.stmt]
    loss: str
    optimizers: list[str]
    pixel: list[tuple[ast.expr, list[ast.expr]]] = field(default_factory=list)
    setups: list[ast.stmt] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_trainer(tree: ast.Module, folder: Path | None = None) -> Trainer:
    """The training loop of a file.

    Args:
        tree: its syntax tree.
        folder: where the file lies: the model is read from `scene/*.py` beside it, if there is one.

    Raises:
        ValueError: there is no such loop, or it is not one that can be read with certainty.
    """
    found = [
        (function, loop, backwards)
        for function in ast.walk(tree)
        if isinstance(function, Function)
        for loop in within(function.body)
        if isinstance(loop, ast.For) and (backwards := _backwards(loop))
    ]
    # A loop inside the training loop is part of it; one around it is not what is meant.
    found = [f for f in found if not any(f[1] in within(g[1].body) for g in found)]
    if len(found) != 1:
        lines = ", ".join(str(loop.lineno) for _, loop, _ in found) or "none"
        raise ValueError(f"one `for` loop with a loss.backward() in it is needed (lines: {lines})")
    function, loop, backwards = found[0]
    start, total = _range(function, loop)
    losses = {ast.unparse(loss) for _, loss in backwards}
    statements = [statement for statement, _ in backwards]
    if len(losses) != 1 or not _exclusive(loop, statements):
        lines = ", ".join(str(s.lineno) for s in statements)
        raise ValueError(f"one loss.backward() an iteration is needed (lines: {lines})")
    shift, total = _shift(start, total)
    counts = isinstance(loop.target, ast.Name) and not _assigned(loop, loop.target.id)
    trainer = Trainer(
        function=function,
        loop=loop,
        total=ast.unparse(total),
        shift=shift if counts else None,
        resumes=not _constant(function, start),
        backwards=statements,
        loss=losses.pop(),
        optimizers=[],
    )
    _find_optimizers(trainer, tree, folder)
    _find_pixel_loss(trainer)
    return trainer


def within(body: list[ast.stmt]) -> Iterator[ast.AST]:
    """Every node below these statements, in the file's order, without nested functions."""
    for node in body:
        yield from _below(node)


def _below(node: ast.AST) -> Iterator[ast.AST]:
    if isinstance(node, (*Function.__args__, ast.ClassDef, ast.Lambda)):
        return
    yield node
    for child in ast.iter_child_nodes(node):
        yield from _below(child)


def _method(node: ast.AST, name: str) -> ast.expr | None:
    """The receiver of a call of that method."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        return node.func.value if node.func.attr == name else None
    return None


def _backwards(loop: ast.For) -> list[tuple[ast.stmt, ast.expr]]:
    """The statements `loss.backward()` and `scaler.scale(loss).backward()`, and their losses."""
    found: list[tuple[ast.stmt, ast.expr]] = []
    for node in within(loop.body):
        receiver = _method(node.value, "backward") if isinstance(node, ast.Expr) else None
        if isinstance(receiver, ast.Call) and _method(receiver, "scale") and receiver.args:
            receiver = receiver.args[0]
        if isinstance(node, ast.Expr) and isinstance(receiver, ast.Name):
            found.append((node, receiver))
    return found


def _range(function: Function, loop: ast.For) -> tuple[ast.expr | None, ast.expr]:
    """Start and end of the range that the loop counts through."""
    source: ast.expr | None = loop.iter
    if isinstance(source, ast.Name):
        source = _bound(function, source.id, loop)
    calls = [n for n in ast.walk(source) if isinstance(n, ast.Call)] if source else []
    ranges = [c for c in calls if ast.unparse(c.func) in ("range", "tqdm.trange", "trange")]
    if len(ranges) != 1 or len(ranges[0].args) not in (1, 2):
        raise ValueError(
            f"the loop in line {loop.lineno} goes over {ast.unparse(loop.iter)}: the number of "
            "iterations cannot be read from it, only from a range(...)"
        )
    bounds = ranges[0].args
    return (bounds[0] if len(bounds) == 2 else None), bounds[-1]


def _bound(function: Function, name: str, before: ast.stmt) -> ast.expr | None:
    """What was assigned to `name` last before a statement."""
    values = [
        node.value
        for node in within(function.body)
        if isinstance(node, ast.Assign)
        and node.lineno < before.lineno
        and any(isinstance(t, ast.Name) and t.id == name for t in node.targets)
    ]
    return values[-1] if values else None


def _shift(start: ast.expr | None, end: ast.expr) -> tuple[int, ast.expr]:
    """(1, n) for a range that ends at n + 1, else (0, n)."""
    if start is None or not isinstance(end, ast.BinOp) or not isinstance(end.op, ast.Add):
        return 0, end
    one = isinstance(end.right, ast.Constant) and end.right.value == 1
    return (1, end.left) if one else (0, end)


def _constant(function: Function, start: ast.expr | None) -> bool:
    """Whether a loop starts where it always starts."""
    if isinstance(start, ast.Name):
        stores = [
            n
            for n in within(function.body)
            if isinstance(n, ast.Name) and n.id == start.id and isinstance(n.ctx, ast.Store)
        ]
        start = _bound(function, start.id, function.body[-1]) if len(stores) == 1 else start
    return start is None or isinstance(start, ast.Constant)


def _assigned(loop: ast.For, name: str) -> bool:
    return any(
        isinstance(n, ast.Name) and n.id == name and isinstance(n.ctx, ast.Store)
        for n in within(loop.body)
    )


def _exclusive(loop: ast.For, statements: list[ast.stmt]) -> bool:
    """Whether at most one of these statements runs in an iteration."""
    for first in statements:
        for second in statements[: statements.index(first)]:
            if not any(_in_both_arms(n, first, second) for n in within(loop.body)):
                return False
    return True


def _in_both_arms(node: ast.AST, first: ast.stmt, second: ast.stmt) -> bool:
    if not isinstance(node, ast.If):
        return False
    arms = [list(within(node.body)), list(within(node.orelse))]
    return any(first in arm and second in other for arm, other in (arms, arms[::-1]))


# -- optimizers ------------------------------------------------------------------------------------


def _find_optimizers(trainer: Trainer, tree: ast.Module, folder: Path | None) -> None:
    """Set `optimizers`, `setups` and what is to be said of them."""
    stepped = list(dict.fromkeys(_stepped(trainer.loop)))
    dicts = [text for text in stepped if text.split(".")[-1] == "optimizers"]
    owners = [text[: -len(".optimizer")] for text in stepped if text.endswith(".optimizer")]
    set_up = [
        ast.unparse(r) for n in within(trainer.function.body) if (r := _method(n, "training_setup"))
    ]
    if len(owners) > 1:
        owners = [owner for owner in owners if owner in set_up]
    if len(dicts) == 1 and not owners:
        trainer.optimizers = dicts
        others = [text for text in stepped if text not in dicts]
    elif len(owners) == 1:
        owner = owners[0]
        groups, made = _model(folder)
        seen = [text.rsplit(".", 1)[-1] for text in stepped if text.startswith(f"{owner}.")]
        second = [name for name in SECOND if name in seen or name in made]
        trainer.optimizers = [f"{owner}.{name}" for name in ("optimizer", *second)]
        others = [text for text in stepped if text not in trainer.optimizers]
        trainer.setups = [
            n
            for n in within(trainer.loop.body)
            if isinstance(n, ast.Expr)
            and (receiver := _method(n.value, "training_setup"))
            and ast.unparse(receiver) == owner
        ]
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
    if others:
        trainer.notes.append(f"left alone: {', '.join(others)}")


def _stepped(loop: ast.For) -> Iterator[str]:
    """Expressions of the optimizers that are stepped in the loop.

    Raises:
        ValueError: one is stepped in a way that is no Adam's.
    """
    for node in within(loop.body):
        receiver = _method(node, "step")
        if isinstance(node, ast.Call) and _method(node, "optimizer_step"):
            yield f"{ast.unparse(node.func.value)}.optimizer"  # pyright: ignore
        if receiver is None or not isinstance(node, ast.Call):
            continue
        name = ast.unparse(receiver)
        if name.endswith("scaler") and node.args:
            name = ast.unparse(node.args[0])
        elif not name.endswith("optimizer"):
            continue
        elif node.keywords or len(node.args) > 2:
            raise ValueError(
                f"line {node.lineno}: {ast.unparse(node)} is no step of an Adam; only step() and "
                "step(mask, ...) are known"
            )
        yield _dict_of(loop, name) or name


def _dict_of(loop: ast.For, name: str) -> str | None:
    """`self.optimizers` for the variable of `for optimizer in self.optimizers.values()`."""
    if "." in name:
        return None
    for node in within(loop.body):
        if isinstance(node, ast.For) and isinstance(node.target, ast.Name):
            values = _method(node.iter, "values")
            steps = [
                n for n in within(node.body) if (r := _method(n, "step")) and name == ast.unparse(r)
            ]
            if values is not None and node.target.id == name and steps:
                return ast.unparse(values)
    return None


def _model(folder: Path | None) -> tuple[set[str], set[str]]:
    """The names of the parameter groups, and of the optimizers, in the classes of `scene/`."""
    groups: set[str] = set()
    made: set[str] = set()
    for path in sorted((folder / "scene").glob("*model*.py")) if folder else []:
        try:
            tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError):
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Dict):
                pairs = zip(node.keys, node.values, strict=True)
                keys = {k.value: v for k, v in pairs if isinstance(k, ast.Constant)}
                name = keys.get("name")
                if "params" in keys and isinstance(name, ast.Constant):
                    groups.add(str(name.value))
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                made.add(node.attr)
    return groups, made


# -- the L1 term -----------------------------------------------------------------------------------


def _find_pixel_loss(trainer: Trainer) -> None:
    """Set `pixel`: `L1 = l1_loss(a, b)`, `F.l1_loss(a, b)` or `l1_loss(a, b).mean()`."""
    last = max(statement.lineno for statement in trainer.backwards)
    found: dict[str, list[tuple[ast.expr, list[ast.expr]]]] = {}
    for node in within(trainer.loop.body):
        if not isinstance(node, ast.Assign) or node.lineno > last:
            continue
        value = node.value
        inner = _method(value, "mean")
        call = value if inner is None else inner
        if not isinstance(call, ast.Call) or len(call.args) != 2 or call.keywords:
            continue
        if ast.unparse(call.func).split(".")[-1] == "l1_loss":
            found.setdefault(ast.unparse(node.targets[0]), []).append((value, call.args))
    usual = [name for name in found if name.lower() in ("ll1", "l1loss", "l1_loss", "ll1_render")]
    names = usual or list(found)
    if len(names) == 1:
        trainer.pixel = found[names[0]]
    else:
        trainer.notes.append(
            "no L1 = l1_loss(render, photo) was found: the paper's squared loss needs "
            "phases.pixel_loss(render, photo) in its place, the defaults do not"
        )
