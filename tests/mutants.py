"""Break the arithmetic on purpose, one place at a time, and see the tests notice.

    python tests/mutants.py                # all of TARGETS, some 20 minutes on one core
    python tests/mutants.py --share 0.1    # a random tenth

Operators, comparisons, numbers, and `where` arguments are changed in a copy of the package, one
each; the module's own tests run on the copy. Prints the survivors and the share that is killed.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
# Module: the tests that are meant to notice, those that fail fastest first.
TARGETS = {
    "energy.py": [
        "test_energy.py",
        "test_corners.py",
        "test_extreme_energies.py",
        "test_options.py",
    ],
    "_pairs.py": ["test_curvature.py", "test_lqnadam.py", "test_corners.py", "test_stiff.py"],
    "curvature.py": ["test_curvature.py", "test_lqnadam.py", "test_stiff.py"],
    "noise.py": ["test_noise.py", "test_options.py", "test_awsgld.py"],
    "_covariance.py": ["test_noise.py"],
}
SKIPPED = ("__repr__", "__all__")  # what they say is not arithmetic
OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.Mod: ast.Mult,
    ast.FloorDiv: ast.Mult,
}
COMPARISONS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
CALLS = {"amax": "amin", "minimum": "maximum", "maximum": "minimum", "ceil": "floor", "log": "exp"}


class Mutant(NamedTuple):
    """One changed place: its line, what it says now, and the whole module."""

    line: int
    text: str
    source: str


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Every way to change this one node."""
    if isinstance(node, (ast.BinOp, ast.AugAssign)) and type(node.op) in OPERATORS:
        yield replaced(node, op=OPERATORS[type(node.op)]())
    elif isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARISONS:
        yield replaced(node, ops=[COMPARISONS[type(node.ops[0])](), *node.ops[1:]])
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.Invert, ast.Not)):
        yield node.operand
    elif isinstance(node, ast.BoolOp):
        yield replaced(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        yield ast.Constant(node.value + 1)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        yield from changed_calls(node, node.func)


def changed_calls(node: ast.Call, func: ast.Attribute) -> Iterator[ast.AST]:
    if func.attr in CALLS:
        yield replaced(node, func=replaced(func, attr=CALLS[func.attr]))
    elif func.attr == "where" and len(node.args) == 3:
        yield replaced(node, args=[node.args[0], node.args[2], node.args[1]])
    elif func.attr == "clamp":
        yield func.value


def replaced(node: ast.AST, **fields: object) -> ast.AST:
    other = copy.copy(node)
    for name, value in fields.items():
        setattr(other, name, value)
    return other


def places(tree: ast.AST) -> Iterator[tuple[ast.AST, str, int | None, ast.AST]]:
    """(parent, field, index, node) of every node that computes something."""
    for field, value in ast.iter_fields(tree):
        if field in ("annotation", "returns", "decorator_list"):
            continue
        items = list(enumerate(value)) if isinstance(value, list) else [(None, value)]
        for index, item in items:
            if not isinstance(item, ast.AST) or getattr(item, "name", None) in SKIPPED:
                continue
            if isinstance(item, ast.keyword) and item.arg == "strict":
                continue  # of zip: says what is so, changes nothing
            if isinstance(item, (ast.JoinedStr, ast.Raise, ast.Import, ast.ImportFrom)):
                continue  # messages
            yield tree, field, index, item
            yield from places(item)


def mutants(source: str) -> Iterator[Mutant]:
    """All mutants of a module, each as its whole source."""
    tree = ast.parse(source)
    for parent, field, index, node in list(places(tree)):
        for changed in changes(node):
            ast.copy_location(changed, node)
            place(parent, field, index, changed)
            line = getattr(node, "lineno", 0)
            text = ast.unparse(changed) if not isinstance(changed, ast.AugAssign) else "op="
            yield Mutant(line, text, ast.unparse(ast.fix_missing_locations(tree)))
            place(parent, field, index, node)


def place(parent: ast.AST, field: str, index: int | None, node: ast.AST) -> None:
    if index is None:
        setattr(parent, field, node)
    else:
        getattr(parent, field)[index] = node


def killed(copy_of: Path, tests: list[str], seconds: float) -> bool:
    """Whether a test fails on the package in `copy_of`, or does not end."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += ["--hypothesis-seed=0", *(str(ROOT / "tests" / name) for name in tests)]
    paths = {"PYTHONPATH": str(copy_of), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command,
            cwd=ROOT,
            env={**os.environ, **paths},
            capture_output=True,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return True
    return done.returncode != 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="of the mutants, at random")
    parser.add_argument("--only", choices=TARGETS, help="one module")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    total = dead = 0
    for module in [options.only] if options.only else TARGETS:
        path = ROOT / "src/opt3dgs_optim" / module
        chosen = [m for m in mutants(path.read_text()) if chance.random() < options.share]
        gone = 0
        for mutant in chosen:
            with tempfile.TemporaryDirectory() as folder:
                package = Path(folder) / "opt3dgs_optim"
                shutil.copytree(path.parent, package)
                (package / module).write_text(mutant.source)
                found = killed(Path(folder), TARGETS[module], 120)
            gone += found
            if not found:
                print(f"survived: {module}:{mutant.line}: {mutant.text}", flush=True)
        print(f"{module}: {gone} of {len(chosen)} killed", flush=True)
        total, dead = total + len(chosen), dead + gone
    print(f"all: {dead} of {total} killed ({dead / max(total, 1):.0%})")
    return 0 if dead >= 0.9 * total else 1


if __name__ == "__main__":
    sys.exit(main())
