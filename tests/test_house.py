"""How the package is built: imports go one way, names are as agreed, files stay readable."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

import opt3dgs_optim
from opt3dgs_optim import EnergyHistogram, LQNAdam, Phase, PhaseScheduler, two_loop
from opt3dgs_optim.names import GAUSSIAN_NAMES
from opt3dgs_optim.parts.noise import covariance_noise

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "opt3dgs_optim"
Function = ast.FunctionDef | ast.AsyncFunctionDef


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT / "src").with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


TEXTS = {
    module_name(path): path.read_text(encoding="utf-8")
    for path in sorted((ROOT / "src" / PACKAGE).rglob("*.py"))
}
TREES = {name: ast.parse(text) for name, text in TEXTS.items()}


def nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """All nodes, without what a type checker alone sees."""
    yield tree
    for child in ast.iter_child_nodes(tree):
        test = child.test if isinstance(child, ast.If) else None
        if not (isinstance(test, ast.Name) and test.id == "TYPE_CHECKING"):
            yield from nodes(child)


def imports(tree: ast.AST) -> set[str]:
    """Names of the imported modules, ours as far as the module itself."""
    found = set()
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in TREES else node.module)
    return found


NEEDS = {name: imports(tree) & set(TREES) for name, tree in TREES.items()}


def reached(name: str) -> set[str]:
    """Modules of ours that `name` needs, directly or not."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        for other in NEEDS[waiting.pop()] - found:
            found.add(other)
            waiting.append(other)
    return found


# -- length ----------------------------------------------------------------------------------------


LENGTHS = {name: len(text.splitlines()) for name, text in TEXTS.items()}


def test_no_file_is_a_giant() -> None:
    """No limit on what is said; a module of more than 700 lines is more than one idea."""
    assert {name: length for name, length in LENGTHS.items() if length > 700} == {}


# -- imports ---------------------------------------------------------------------------------------


def test_imports_never_go_in_a_circle() -> None:
    assert {name for name in TREES if name in reached(name)} == set()


def floors(name: str) -> int:
    """How many modules stand below this one, on the longest way down, itself included."""
    return 1 + max((floors(other) for other in NEEDS[name] if other != name), default=0)


ROOF = ("__main__", "doctor", "hosts", "nerfstudio")  # commands and hosts, which use it all


def test_the_house_has_at_most_eight_floors() -> None:
    roof = tuple(f"{PACKAGE}.{name}" for name in ROOF)
    heights = {name: floors(name) for name in TREES if not name.startswith(roof)}
    del heights[PACKAGE]
    assert {name: height for name, height in heights.items() if height > 8} == {}


@pytest.mark.parametrize(
    "chain",
    [
        "phases upgrading stepadam course part names",
        "presets parts.curvature lbfgs.two_loop",
        "awsgld stepadam checkpoint course state part",
        "lqnadam parts.curvature course",
        "parts.annealing course part",
    ],
)
def test_the_first_stands_on_the_next(chain: str) -> None:
    """The order in which to read them; with no circle, it is never the other way round."""
    names = [f"{PACKAGE}.{name}" for name in chain.split()]
    for above, below in pairwise(names):
        assert below in reached(above), (above, below)


def test_the_numerics_know_no_optimizer() -> None:
    needed = set().union(*(reached(name) for name in TREES if f"{PACKAGE}.lbfgs." in name))
    assert needed & {f"{PACKAGE}.{name}" for name in ("part", "course", "stepadam")} == set()


def test_inheritance_is_one_deep() -> None:
    """Of our own classes: a StepAdam, a Part, a Course, and what is made of them."""
    bases = {
        node.name: {base.id for base in node.bases if isinstance(base, ast.Name)}
        for tree in TREES.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    deep = {n for n, own in bases.items() for base in own if bases.get(base, set()) & set(bases)}
    assert deep == set()


def test_a_report_needs_no_optimizer() -> None:
    reports = [n for n in TREES if n.startswith((f"{PACKAGE}.report", f"{PACKAGE}.runs"))]
    needed = set().union(*(reached(name) for name in reports))
    optimizers = {"awsgld", "lqnadam", "phases", "course", "part", "stepadam"}
    assert reports
    assert needed & {f"{PACKAGE}.{name}" for name in optimizers} == set()


def test_nothing_but_torch_and_numpy_is_imported_at_the_top() -> None:
    """What an extra brings is imported where it is used; some hosts' modules are their users'."""
    allowed = {PACKAGE, "torch", "numpy", *sys.stdlib_module_names}
    for module, tree in TREES.items():
        if module.endswith((".nerfstudio", ".lightning")):
            continue
        functions = [node for node in ast.walk(tree) if isinstance(node, Function)]
        inside = set().union(*(imports(function) for function in functions))
        tops = {name.split(".")[0] for name in imports(tree) - inside}
        assert tops <= allowed, module
        deeper = {name.split(".")[0] for name in inside}
        assert deeper <= {*allowed, "matplotlib"}, module


def test_the_oracles_share_no_code_with_what_they_check() -> None:
    found = imports(
        ast.parse((ROOT / "tests" / "support" / "oracles.py").read_text(encoding="utf-8"))
    )
    assert found
    assert {name for name in found if name.split(".")[0] == PACKAGE} == set()


# -- names -----------------------------------------------------------------------------------------


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def private_names(tree: ast.AST) -> set[str]:
    """Private functions, methods and attributes that a module defines."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            found.add(node.name)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            found |= {node.attr} if own(node.value) else set()
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
    return {name for name in found if is_private(name)}


def own(node: ast.expr) -> bool:
    """Whether it is self, cls or super()."""
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and node.func.id == "super"
    return isinstance(node, ast.Name) and node.id in ("self", "cls")


def test_no_private_name_is_used_across_modules() -> None:
    defined = {module: private_names(tree) for module, tree in TREES.items()}
    ours = set().union(*defined.values())
    used = set()
    for module, tree in TREES.items():
        foreign = ours - defined[module]
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and node.attr in foreign and not own(node.value):
                used.add((module, node.attr))
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE):
                names = [a.name for a in node.names if f"{node.module}.{a.name}" not in TREES]
                used |= {(module, name) for name in names if is_private(name)}
    assert used == set()


# Letters and synonyms, and the words that are used here instead.
GLOSSARY = {
    "tau": "temperature",
    "theta": "weights",
    "nu": "multiplier",
    "k": "history_size",
    "memory": "history_size",
    "history_length": "history_size",
    "num_bins": "num_partitions",
    "bins": "num_partitions",
    "m": "num_partitions",
    "loss_range": "energy_range",
    "max_steps": "total_steps",
    "iterations": "total_steps",
    "xyz": "means",
    "positions": "means",
    "scaling": "scales",
    "rotation": "quats",
    "rotations": "quats",
    "opacity": "opacities",
}
SHORT = {"lr", "s", "y"}  # torch's; a curvature pair's everywhere


def public_signatures() -> dict[str, list[str]]:
    """Parameters of the public classes, their public methods, and the public functions."""
    public = [getattr(opt3dgs_optim, name) for name in opt3dgs_optim.__all__]
    found = {}
    for item in [*public, covariance_noise]:
        if item is Phase or not callable(item):
            continue
        found[item.__name__] = list(inspect.signature(item).parameters)
        for name, method in vars(item).items() if inspect.isclass(item) else ():
            if inspect.isfunction(method) and not name.startswith("_"):
                found[f"{item.__name__}.{name}"] = list(inspect.signature(method).parameters)
    return found


def test_parameters_are_called_as_in_the_glossary() -> None:
    signatures = public_signatures()
    assert len(signatures) > 30
    for call, names in signatures.items():
        for name in names:
            assert name not in GLOSSARY, f"{call}: {name} is called {GLOSSARY.get(name)} here"
            assert len(name) > 2 or name in SHORT, f"{call}: {name} is a letter, not a name"


def test_the_words_of_the_glossary_are_there() -> None:
    def takes(call: object, *names: str) -> bool:
        return set(names) <= set(inspect.signature(call).parameters)  # pyright: ignore

    assert takes(EnergyHistogram, "num_partitions", "energy_range", "zeta", "temperature")
    assert hasattr(EnergyHistogram, "weights")
    assert hasattr(EnergyHistogram, "multiplier")
    assert takes(LQNAdam, "history_size")
    assert takes(two_loop, "grad", "history")
    assert takes(PhaseScheduler, "total_steps", "switch")
    assert [phase.name for phase in Phase] == ["EXPLORATION", "EXPLOITATION"]
    assert list(GAUSSIAN_NAMES) == ["means", "scales", "quats", "opacities", "sh0", "shN"]
