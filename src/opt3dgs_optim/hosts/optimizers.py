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
from opt3dgs_optim.names import canonical_name

GAUSSIANS = re.compile(r"gauss|splat|primitive|convex", re.I)  # in the name of their model
NO_ADAM = re.compile(  # of torch, and what inherits from no Adam of torch's
    r"(^|\.)(SGD|ASGD|RMSprop|Rprop|Adagrad|Adadelta|Adafactor|LBFGS|SparseAdam|Muon|RAdam|NAdam|"
    r"\w*Adam\w*8bit|FusedAdam|DeepSpeedCPUAdam)$"
)
ADAM = re.compile(r"(^|\.)\w*Adam\w*$")
# Methods of a model that step its own optimizer, in the place of `X.optimizer.step()`.
STEPPING = ("optimizer_step", "step")


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
    tree: ast.Module,
    own: list[Spot],
    loop: ast.stmt,
    steps: list[Step],
    models: list[ast.Module],
) -> Optimizers:
    """The optimizers of the Gaussians among those that a training loop steps.

    Args:
        tree: the file's syntax tree.
        own: every node of the loop's scope.
        loop: the training loop.
        steps: where it steps an optimizer.
        models: of `model_files`.

    Raises:
        ValueError: it is not clear which one is the Gaussians'.
    """
    notes: list[str] = []
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
        _check_names(own, named[0], steps)
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
    if found[0].endswith(".optimizer"):
        _check_set_up(tree, own, models, found[0].removesuffix(".optimizer"), steps)
    setups = find_remade([tree, *models], own, loop, found[0])
    if others := [text for text in stepped if text not in found and not _is_of(own, text, found)]:
        notes.append(f"left alone: {', '.join(others)}")
    if any(_steps_at_times(model) for model in models):
        notes.append(
            "the model steps its optimizer in some iterations only; between these the loss is "
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
    if made and all(_is_no_adam(ast.unparse(call.func)) for call in made):
        raise NothingToAddError(
            f"line {made[0].lineno}: {optimizer} is {ast.unparse(made[0].func)}(...), but "
            "torch.optim.Adam is needed; other optimizers get no parts"
        )


def _is_no_adam(called: str) -> bool:
    """Whether what is called is a class, and no Adam."""
    is_class = called.rsplit(".", maxsplit=1)[-1][:1].isupper()
    return NO_ADAM.search(called) is not None or (is_class and ADAM.search(called) is None)


def _check_set_up(
    tree: ast.Module, own: list[Spot], models: list[ast.Module], owner: str, steps: list[Step]
) -> None:
    """ValueError where the methods that make a model's optimizer make no group of Gaussians.

    As far as they are known: of `self`, all in the file, else those that are called on the model.
    """
    called = set[str]()
    for spot in own:
        match spot.node:
            case ast.Call(ast.Attribute(holder, name)) if ast.unparse(holder) == owner:
                called.add(name)
    trees = [tree] if owner == "self" else [tree, *models]
    setters = [
        inside
        for each in trees
        for function in ast.walk(each)
        if isinstance(function, FUNCTIONS) and (owner == "self" or function.name in called)
        if any(values(inside := [*spots(function)], "self.optimizer"))
    ]
    refusals = list[ValueError]()
    for inside in setters:
        try:
            _check_names(inside, "self.optimizer", steps, f"{owner}.optimizer")
        except ValueError as error:
            refusals.append(error)
    if setters and len(refusals) == len(setters):
        raise refusals[0]


def _check_names(
    own: list[Spot], optimizer: str, steps: list[Step], shown_as: str | None = None
) -> None:
    """ValueError where none of an Adam's groups has a Gaussian parameter's name: poses, say.

    Names that are no constants, as the keys of a dict of parameters, may be any. `shown_as` is how
    the step has the optimizer.
    """
    step = shown_as or optimizer
    given: list[ast.expr | None] = []
    for spot in own:
        match spot.node:
            case ast.Dict(keys, many):
                pairs = zip(keys, many, strict=True)
                given += [v for k, v in pairs if isinstance(k, ast.Constant) and k.value == "name"]
            case ast.Call(ast.Name("dict"), _, keywords):
                given += [each.value for each in keywords if each.arg == "name"]
    for _, value in values(own, optimizer):
        match value:
            case ast.Dict(keys):
                given += keys
            case ast.Call(_, [ast.List(), *_]):
                continue
            case ast.Call(_, [ast.Call(ast.Name("list")), *_]):  # of a network's parameters
                continue
            case ast.Call(_, [ast.Name(name), *_]) if _are_lists(own, name):
                continue
            case _:
                given.append(None)  # made elsewhere
    names = [_constant_of(each) for each in given]
    if None not in names and not any(map(canonical_name, names)):
        shown = ", ".join(sorted({str(name) for name in names})) or "none"
        line = next(each.spot.line for each in steps if each.optimizer == step)
        raise refusal(
            line,
            f"no group of {step} has the name of a Gaussian parameter (its names: {shown}): "
            "it is not clear that it is the Gaussians' optimizer",
        )


def _are_lists(own: list[Spot], name: str) -> bool:
    """Whether a name gets nothing but lists that are written out."""
    given = [value for _, value in values(own, name)]
    return bool(given) and all(isinstance(value, ast.List) for value in given)


def _constant_of(name: ast.expr | None) -> str | None:
    """A group's name, or what is constant of it; None where nothing is."""
    nodes = [*ast.walk(name)] if name else []
    given = [node.value for node in nodes if isinstance(node, ast.Constant)]
    return "".join(each for each in given if isinstance(each, str)) or None


def _is_of(own: list[Spot], name: str, found: list[str]) -> bool:
    """Whether a name gets nothing but items of what is upgraded: `self.optimizers["means"]`."""
    given = [value for _, value in values(own, name) if value is not None]  # a loop's has none
    items = [ast.unparse(v.value) for v in given if isinstance(v, ast.Subscript)]
    return bool(items) and len(items) == len(given) and set(items) <= set(found)


def _is_adam(own: list[Spot], name: str) -> bool:
    """Whether a name gets an Adam, or a dict of such, and nothing else."""
    given = [value for _, value in values(own, name)]
    return bool(given) and all(_makes_adam(value) for value in given)


def _makes_adam(value: ast.expr | None) -> bool:
    match value:
        case ast.Call(called):
            text = ast.unparse(called)
            return ADAM.search(text) is not None and NO_ADAM.search(text) is None
        case ast.DictComp(_, each):
            return _makes_adam(each)
        case ast.Dict(_, many):
            return bool(many) and all(map(_makes_adam, many))
    return False


def read_step(
    tree: ast.Module, spot: Spot, own: list[Spot], models: list[ast.Module]
) -> Step | None:
    """The step that a call makes: of an optimizer, or of each of many.

    Args:
        tree: the file's syntax tree.
        spot: the call.
        own: every node of the scope.
        models: of `model_files`.

    Raises:
        ValueError: it is stepped in a way that is no Adam's.
    """
    loops = loops_around(spot)
    match spot.node:
        case ast.Call(ast.Attribute(owner)) as call if _steps_its_own([tree, *models], call):
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


def _steps_its_own(trees: list[ast.Module], call: ast.Call) -> bool:
    """Whether a call of `X.optimizer_step()` or `X.step()` steps `X.optimizer`.

    By the methods of these names in the files, and by X's name where there are none.
    """
    match call:
        case ast.Call(ast.Attribute(owner, method)) if method in STEPPING:
            name = ast.unparse(owner)
        case _:
            return False
    if not GAUSSIANS.search(name) or name.endswith(("optimizer", "optimizers")):
        return False
    found = [n for tree in trees for n in ast.walk(tree) if isinstance(n, FUNCTIONS)]
    found = [function for function in found if function.name == method]
    if not found:
        return method == "optimizer_step"
    return all(_steps_optimizer(function) for function in found)


def _steps_optimizer(function: ast.AST) -> bool:
    """Whether a method has `self.optimizer.step(...)`."""
    for node in ast.walk(function):
        match node:
            case ast.Call(ast.Attribute(ast.Attribute(ast.Name("self"), "optimizer"), "step")):
                return True
    return False


def _steps_at_times(model: ast.Module) -> bool:
    """Whether it steps its optimizer in every so many iterations, as FastGS's does."""
    for function in ast.walk(model):
        if isinstance(function, FUNCTIONS) and function.name in STEPPING:
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


def model_files(tree: ast.Module, folder: Path) -> list[ast.Module]:
    """The files of `scene/` beside a script that have the model's classes.

    Args:
        tree: the script's syntax tree: of several classes those count that it names, or that
            `scene/__init__.py` imports, and their bases.
        folder: where the script lies.
    """
    scene = folder / "scene"
    read = [_read(path) for path in sorted(scene.glob("*model*.py"))]
    trees = [each for each in read if each is not None]
    classes = {n.name: n for each in trees for n in each.body if isinstance(n, ast.ClassDef)}
    named = [name for name in classes if name in _names(tree)]
    if not named and (package := _read(scene / "__init__.py")):
        imported = {node.name for node in ast.walk(package) if isinstance(node, ast.alias)}
        named = [name for name in classes if name in imported]
    for name in named:  # grows by the bases
        for base in classes[name].bases:
            named += [b for b in classes if b in _names(base) and b not in named]
    for each in trees if named else ():
        kept = [n for n in each.body if not isinstance(n, ast.ClassDef) or n.name in named]
        each.body = kept
    return trees


def _read(path: Path) -> ast.Module | None:
    try:
        return ast.parse(path.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return None


def _names(tree: ast.AST) -> set[str]:
    """The names that are read in a tree, and given nothing there."""
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    given = {node.id for node in found if isinstance(node.ctx, ast.Store)}
    return {node.id for node in found} - given


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
