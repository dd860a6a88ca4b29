"""The mutation runner itself: it tells a change from none, and refuses to start on broken tests."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest
from mutants import PACKAGE, TARGETS
from mutations import mutants

pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="the runner forks"),
    pytest.mark.processes,
]
TESTS = Path(__file__).parent

SOURCE = '''
"""A module."""
LIMIT = 10


def squares(n: int = 2) -> float:
    """Halves the way there; é is two bytes."""
    é, total = 0, 0
    while é < n:
        é += 1
        total += é * é
    return abs(total)


class Child(dict):
    def __init__(self):
        super().__init__()
'''
GOOD = """
from little.sums import Child, squares

def test_small():
    assert squares() == 5

def test_none():
    assert squares(0) == 0

def test_class():
    assert isinstance(Child(), Child)
"""
# In a process of its own: the runner forks, and pytest runs in it.
PROGRAM = """
import json, sys
sys.path[:0] = [{tests!r}, {root!r}]
import mutants
from mutations import Mutant
from pathlib import Path
root = Path({root!r})
mutants.PACKAGE = root / "little"
source = (root / "little/sums.py").read_text()
chosen = [Mutant(0, "", a, b, source.replace(a, b)) for a, b in {changes!r}]
found = mutants.examine(root / "little/sums.py", chosen, [root / "tests/test_sums.py"], 2)
print(json.dumps(found))
"""


def examined(
    folder: Path, changes: list[tuple[str, str]], test: str = GOOD
) -> subprocess.CompletedProcess[str]:
    """Run the runner on a package of one module."""
    for name, text in {
        "little/__init__.py": "",
        "little/sums.py": SOURCE,
        "tests/test_sums.py": test,
        "pytest.ini": "[pytest]\naddopts = -n 2\n",  # as the project's: in workers if it could
    }.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    program = PROGRAM.format(tests=str(TESTS), root=str(folder), changes=changes)
    command = [sys.executable, "-X", "utf8", "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)


def test_a_sign_is_noticed_a_rewording_is_not_and_a_loop_ends(tmp_path: Path) -> None:
    changes = [
        ("total += é * é", "total -= é * -é"),  # the same sum
        ("return abs(total)", "return -total"),
        ("é += 1", "é -= 1"),  # never arrives at n
        ("return abs(total)", "return nothing"),
        ("return abs(total)", "import os; os._exit(7)"),
        ("LIMIT = 10", "LIMIT = 11"),  # nobody reads it
        ("super().__init__()", "super().__init__(1)"),
    ]
    done = examined(tmp_path, changes)
    assert done.returncode == 0, done.stderr
    small, none = (f"tests/test_sums.py::test_{name}" for name in ("small", "none"))
    noticed = json.loads(done.stdout.splitlines()[-1])
    assert noticed[:4] == [None, small, "exit status -24", small]
    assert noticed[4:6] == ["exit status 7", None]
    assert noticed[6] == "tests/test_sums.py::test_class"
    assert none not in noticed


def test_it_does_not_start_where_the_tests_fail_anyway(tmp_path: Path) -> None:
    done = examined(tmp_path, [], GOOD.replace("== 5", "== 6"))
    assert done.returncode == 1
    assert "test_sums.py::test_small fails without a mutant" in done.stderr + done.stdout


def test_mutants_differ_from_the_source_in_one_place() -> None:
    found = list(mutants(SOURCE))
    changed = {(m.before, m.after) for m in found}
    assert changed == {
        ("LIMIT = 10", "LIMIT = 11"),
        ("def squares(n: int = 2) -> float:", "def squares(n: int = 3) -> float:"),
        ("é, total = 0, 0", "é, total = 1, 0"),
        ("é, total = 0, 0", "é, total = 0, 1"),
        ("while é < n:", "while (é <= n):"),
        ("while é < n:", "while (é >= n):"),
        ("é += 1", "é -= 1"),
        ("é += 1", "é += 2"),
        ("total += é * é", "total -= é * é"),
        ("total += é * é", "total += (é / é)"),
        ("super().__init__()", "pass"),
    }
    assert len(changed) == len(found)
    for mutant in found:
        lines = zip(SOURCE.splitlines(), mutant.source.splitlines(), strict=True)
        differing = [k for k, (old, new) in enumerate(lines, start=1) if old != new]
        assert differing == [mutant.line]
    assert {m.function for m in found} == {"", "squares", "Child.__init__"}


@pytest.mark.parametrize("module", TARGETS)
def test_every_mutant_of_the_package_is_a_program(module: str) -> None:
    source = (PACKAGE / module).read_text(encoding="utf-8")
    found = list(mutants(source))
    assert len(found) > 1
    before = ast.dump(ast.parse(source))
    assert all(ast.dump(ast.parse(mutant.source)) != before for mutant in found)
    assert all((TESTS / name).is_file() for name in TARGETS[module])
