"""Which optimizers a training loop steps, and which of them are the Gaussians'."""

import ast
import re
from pathlib import Path
from typing import NamedTuple

from opt3dgs_optim.hosts.remade import SECOND, find_remade, set_ups
from opt3dgs_optim.hosts.syntax import (
    COMPREHENSIONS,
    FUNCTIONS,
    NothingToAddError,
    Spot,
    is_reference,
    loops_around,
    refusal,
    spots,
    values,
)

GAUSSIANS = re.compile(r"gauss|splat|primitive|convex", re.I)  # in the name of their model
NO_ADAM = re.compile(
    r"(^|\.)(SGD|ASGD|RMSprop|Rprop|Adagrad|Adadelta|Adafactor|LBFGS|SparseAdam|Muon)$"
)
ADAM = re.compile(r"(^|\.)\w*Adam\w*$")


class Step(NamedTuple):
    """A place where an optimizer steps."""

    optimizer: str  # the expression of the optimizer, or of all of them
    spot: Spot
    loops: list[ast.AST]  # around it, without the one over the optimizers


class Optimizers(NamedTuple):
    """What is upgraded."""

    expressions: list[str]  # the positions' first
    setups: list[ast.stmt]  # statements in the loop that make them anew
    notes: list[str]  # what a user should know


def find_optimizers(
    tree: ast.Module, own: list[Spot], loop: ast.stmt, steps: list[Step], folder: Path
) -> Optimizers:
    """The optimizers of the Gaussians among those that a training loop steps.

    Args:
        tree: the file's syntax tree.
        own: every node of the loop's scope.
        loop: the training loop.
        steps: where it steps an optimizer.
        folder: where the file lies: the model is read from `scene/*.py` beside it.

    Raises:
        ValueError: it is not clear which one is the Gaussians'.
    """
    notes: list[str] = []
    models = _model_files(folder)
    stepped = list(dict.fromkeys(step.optimizer for step in steps))
    for step in steps:
        if not is_reference(ast.parse(step.optimizer, mode="eval").body):
            raise refusal(
                step.spot.line,
                f"{step.optimizer} steps here, of which it is not clear what are the Gaussians' "
                "optimizers; a loop over these alone is needed",
            )
    dicts = [text for text in stepped if text.split(".")[-1] == "optimizers"]
    owners = [text[: -len(".optimizer")] for text in stepped if text.endswith(".optimizer")]
    named = [text for text in stepped if _is_adam(own, text)]
    others = [text for text in stepped if text not in dicts and text.endswith("optimizers")]
    if len(owners) > 1:
        owners = _of_gaussians(owners, own)
    if len(dicts) == 1 and not owners and not any(map(GAUSSIANS.search, others)):
        found = dicts
    elif len(owners) == 1 and not dicts:
        (owner,) = owners
        groups, made = _model(models)
        seconds = [name for name in SECOND if name in made or f"{owner}.{name}" in stepped]
        found = [f"{owner}.{name}" for name in ("optimizer", *seconds)]
        if groups and not groups & {"xyz", "means"}:
            notes.append(
                "no group of its optimizer is named xyz or means; those with a Gaussian "
                f"parameter's name are acted on (all: {', '.join(sorted(groups))})"
            )
    elif len(named) == 1 and not owners and not dicts:
        found = named
    else:
        lines = ", ".join(f"{step.optimizer} in line {step.spot.line}" for step in steps)
        raise refusal(
            loop,
            "the optimizer of the Gaussians is not clear: one `for optimizer in "
            "X.optimizers.values()` or one `X.optimizer.step()` is needed "
            f"(stepped in the loop: {lines or 'nothing'})",
        )
    _check_adam([tree, *models], found[0])
    setups = find_remade([tree, *models], own, loop, found[0])
    if others := [text for text in stepped if text not in found]:
        notes.append(f"left alone: {', '.join(others)}")
    if any(_steps_at_times(model) for model in models):
        notes.append(
            "the model's optimizer_step() steps in some iterations only; between these the loss is "
            "observed, but the mean of the last thirtieth has as few iterates as there are steps"
        )
    return Optimizers(found, setups, notes)


def _of_gaussians(owners: list[str], own: list[Spot]) -> list[str]:
    """Which of several models are the Gaussians': by its name, or as the one that is set up here.

    One that comes from elsewhere may be set up there.
    """
    named = [owner for owner in owners if GAUSSIANS.search(owner)]
    if len(named) == 1:
        return named
    here = [owner for owner in owners if any(value for _, value in values(own, owner))]
    set_up = [owner for owner in owners if set_ups(own, owner)]
    return set_up if len(here) == len(owners) else []


def _check_adam(trees: list[ast.Module], optimizer: str) -> None:
    """NothingToAddError where all that the files make under a name is no Adam."""
    name = optimizer.rsplit(".", maxsplit=1)[-1]
    made: list[ast.Call] = []
    for node in [node for tree in trees for node in ast.walk(tree)]:
        match node:
            case ast.Assign([ast.Name(known) | ast.Attribute(_, known)], ast.Call() as call):
                made += [call] if known == name else []
    if made and all(NO_ADAM.search(ast.unparse(call.func)) for call in made):
        raise NothingToAddError(
            f"line {made[0].lineno}: {optimizer} is {ast.unparse(made[0].func)}(...), but "
            "torch.optim.Adam is needed; other optimizers get no parts"
        )


def _is_adam(own: list[Spot], name: str) -> bool:
    """Whether a name gets an Adam, or a dict of such, and nothing else."""
    given = [value for _, value in values(own, name)]
    return bool(given) and all(_makes_adam(value) for value in given)


def _makes_adam(value: ast.expr | None) -> bool:
    match value:
        case ast.Call(called):
            return ADAM.search(ast.unparse(called)) is not None
        case ast.DictComp(_, each):
            return _makes_adam(each)
        case ast.Dict(_, many):
            return bool(many) and all(map(_makes_adam, many))
    return False


def read_step(tree: ast.Module, spot: Spot, own: list[Spot]) -> Step | None:
    """The step that a call makes: of an optimizer, or of each of many.

    Raises:
        ValueError: it is stepped in a way that is no Adam's.
    """
    loops = loops_around(spot)
    match spot.node:
        case ast.Call(ast.Attribute(owner, "optimizer_step")):
            return Step(f"{ast.unparse(owner)}.optimizer", spot, loops)
        case ast.Call(ast.Attribute(owner, "step"), given, options) as call:
            name = ast.unparse(owner)
        case _:
            return None
    scaled = name.endswith("scaler") and bool(given)
    if scaled:
        name = ast.unparse(given[0])
    around = [(loop, text) for loop in loops if (text := _goes_over_optimizers(loop, name))]
    if around:
        loop, name = around[-1]
        loops = [each for each in loops if each is not loop]
    elif not name.endswith("optimizer") and not _is_adam(own, name):
        return None
    if not scaled and (
        options or len(given) > 2 or any(_is_closure(tree, each, own) for each in given)
    ):
        raise NothingToAddError(
            f"line {call.lineno}: {ast.unparse(call)} is no step of an Adam; only step() and "
            "step(mask, ...) are known, and other optimizers get no parts"
        )
    return Step(name, spot, loops)


def _steps_at_times(model: ast.Module) -> bool:
    """Whether its `optimizer_step` steps in every so many iterations, as FastGS's does."""
    for function in ast.walk(model):
        if isinstance(function, FUNCTIONS) and function.name == "optimizer_step":
            for spot in spots(function):
                match spot.node:
                    case ast.Call(ast.Attribute(ast.Attribute(_, "optimizer"), "step")):
                        tests = [n.test for n in spot.above if isinstance(n, ast.If)]
                        if any(isinstance(n, ast.Mod) for test in tests for n in ast.walk(test)):
                            return True
    return False


def _goes_over_optimizers(loop: ast.AST, name: str) -> str:
    """What a loop goes over, where it steps one optimizer after another in this name; else ""."""
    pairs: list[tuple[ast.expr, ast.expr]] = []
    if isinstance(loop, ast.For):
        pairs = [(loop.target, loop.iter)]
    elif isinstance(loop, COMPREHENSIONS):
        pairs = [(each.target, each.iter) for each in loop.generators]
    for target, source in pairs:
        text = re.sub(r"\.(values|items)\(\)$", "", ast.unparse(source))
        names = {node.id for node in ast.walk(target) if isinstance(node, ast.Name)}
        if name in names and text.lower().endswith(("optimizers", "optims")):
            return text
    return ""


def _is_closure(tree: ast.Module, node: ast.expr, own: list[Spot]) -> bool:
    """Whether an argument of `step` is a function, which would compute the loss itself."""
    match node:
        case ast.Lambda():
            return True
        case ast.Call(ast.Name(name) | ast.Attribute(_, name)):
            return "partial" in name or "closure" in name
        case ast.Name(name) | ast.Attribute(_, name):
            functions = [n.name for n in ast.walk(tree) if isinstance(n, FUNCTIONS)]
            given = [value for _, value in values(own, ast.unparse(node)) if value]
            computed = any(_is_closure(tree, v, own) for v in given if not is_reference(v))
            return name in functions or "closure" in name or computed
    return False


def _model_files(folder: Path) -> list[ast.Module]:
    """The files of `scene/` that have the model's classes."""
    trees = []
    for path in sorted((folder / "scene").glob("*model*.py")):
        try:
            trees.append(ast.parse(path.read_bytes()))
        except (OSError, SyntaxError, ValueError):
            continue
    return trees


def _model(trees: list[ast.Module]) -> tuple[set[str], set[str]]:
    """The names of the parameter groups, and of all attributes set, in these files' classes."""
    groups: set[str] = set()
    made: set[str] = set()
    for tree in trees:
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
