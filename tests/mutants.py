"""Break the arithmetic on purpose, one place at a time, and see the tests notice.

    python tests/mutants.py                       # all of TARGETS
    python tests/mutants.py parts/histogram.py    # one of them
    python tests/mutants.py step.py test_a.py parts/test_b.py   # any module, with its tests
    python tests/mutants.py --share 0.1           # a random tenth

A copy of the package is changed in one place, and the module's tests run on the copy, first those
that have noticed most so far. Every mutant gets a forked process with torch already imported
(Linux, macOS), with a limit on its processor time. The tests must pass on the unchanged copy, in
the same kind of process, before any mutant is tried. Survivors are printed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from mutations import Mutant, mutants  # noqa: E402

PACKAGE = ROOT / "src/opt3dgs_optim"
CHOSEN = "not slow and not hosts and not compiles and not processes and not thorough"
ENERGY = ["test_partitions.py", "parts/test_histogram.py", "parts/test_histogram_extremes.py"]
TARGETS = {  # module: the tests that are meant to notice
    "partitions.py": ENERGY,
    "parts/histogram.py": ENERGY,
    "parts/noise.py": ["parts/test_noise.py"],
    "parts/annealing.py": ["parts/test_annealing.py"],
    "parts/last_phase.py": ["parts/test_last_phase.py"],
    "parts/curvature.py": ["parts/test_curvature.py"],
    "awsgld.py": ["test_awsgld.py"],
    "lqnadam.py": ["test_lqnadam.py"],
}


class Outcome(NamedTuple):
    """What a run of the tests said."""

    status: int  # of the process; pytest's exit code, or minus the signal
    failed: str | None = None  # the first test that failed
    seconds: dict[str, float] = {}  # noqa: RUF012  # of every test that passed
    modules: tuple[str, ...] = ()  # that the run has imported
    package: str = ""  # the file that the package was imported from

    @property
    def killed(self) -> str | None:
        """What noticed, None if nothing did."""
        if self.status == 0:
            return None
        return self.failed or f"exit status {self.status}"


class Plugin:
    """Runs the promising tests first and remembers what happened."""

    def __init__(self, kills: Counter[str], seconds: dict[str, float]) -> None:
        self.kills, self.known = kills, seconds
        self.failed: str | None = None
        self.seconds: dict[str, float] = {}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items.sort(key=lambda i: (-self.kills[i.nodeid], self.known.get(i.nodeid, 0.0)))

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self.failed = f"import of {report.nodeid}"

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and self.failed is None:
            self.failed = report.nodeid
        elif report.when == "call":
            self.seconds[report.nodeid] = report.duration


def run_tests(package: Path, tests: list[Path], plugin: Plugin, limit: int | None) -> Outcome:
    """Run tests on `package`, in a fork of this process; limit is in seconds of processor time."""
    if package.name in sys.modules:
        raise RuntimeError(f"{package.name} is imported already: a fork would not see its mutants")
    with tempfile.TemporaryDirectory() as folder:
        said = Path(folder) / "said.json"
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            status = 1
            try:
                status = _in_child(package, tests, plugin, limit, said)
            finally:
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        return Outcome(status, *(json.loads(said.read_text()) if said.exists() else ()))


def _in_child(
    package: Path, tests: list[Path], plugin: Plugin, limit: int | None, said: Path
) -> int:
    import pytest

    if limit is not None:  # processor time: other work on the machine does not count
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
        signal.alarm(20 * limit)  # and one that waits for ever
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    os.chdir(tests[0].parents[1])
    sys.path.insert(0, str(package.parent))
    sys.dont_write_bytecode = True  # of the same second and size it would be the last mutant's
    known = set(sys.modules)
    options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", CHOSEN]
    # Hypothesis is imported before pytest could rewrite its assertions; it has none to rewrite.
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    status = pytest.main([*options, *map(str, tests)], [plugin])
    ours = (str(package), str(tests[0].parent))
    files = {name: getattr(sys.modules[name], "__file__", None) for name in sys.modules}
    modules = [n for n, f in files.items() if n not in known and f and not f.startswith(ours)]
    origin = getattr(sys.modules.get(package.name), "__file__", None) or ""
    said.write_text(json.dumps([plugin.failed, plugin.seconds, modules, origin]))
    return int(status)


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def examine(
    original: Path, module: str, chosen: list[Mutant], tests: list[Path], patience: int = 10
) -> list[str | None]:
    """What noticed each mutant of a module of the package in the folder `original`.

    `patience` is the time limit, in seconds beyond three times what the tests need.
    """
    from tqdm import tqdm

    found, kills = [], Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / original.name
        shutil.copytree(original, package, ignore=shutil.ignore_patterns("__pycache__"))
        begin = _children_seconds()
        healthy = run_tests(package, tests, Plugin(kills, {}), None)
        if healthy.status:
            raise SystemExit(f"{module}: {healthy.killed} fails without a mutant")
        if not Path(healthy.package).is_relative_to(package):
            raise SystemExit(f"{module}: the tests ran on {healthy.package}, not on {package}")
        limit = patience + 3 * int(_children_seconds() - begin)
        for name in healthy.modules:  # import here what every fork would import
            if name not in sys.modules:
                try:
                    __import__(name)
                except Exception as error:
                    print(f"not preloaded: {name} ({error})", file=sys.stderr)
        for mutant in tqdm(chosen, desc=module, mininterval=5):
            (package / module).write_text(mutant.source)
            outcome = run_tests(package, tests, Plugin(kills, healthy.seconds), limit)
            found.append(outcome.killed)
            if outcome.killed is None:
                tqdm.write(f"survived: {module}:{mutant.line}: {mutant.before} -> {mutant.after}")
            else:
                kills[outcome.killed] += 1
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("module", nargs="?", help="of the package; none: all of TARGETS")
    parser.add_argument("tests", nargs="*", help="that are meant to notice, below tests/")
    parser.add_argument("--share", type=float, default=1.0, help="of the mutants, at random")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ.update(HYPOTHESIS_PROFILE="mutants", OMP_NUM_THREADS="1")
    import torch

    torch.set_num_threads(1)
    chance, total, dead = random.Random(options.seed), 0, 0
    for module in [options.module] if options.module else TARGETS:
        tests = [ROOT / "tests" / test for test in options.tests or TARGETS[module]]
        every = mutants((PACKAGE / module).read_text())
        chosen = [mutant for mutant in every if chance.random() < options.share]
        found = examine(PACKAGE, module, chosen, tests)
        total, dead = total + len(found), dead + len(found) - found.count(None)
        print(f"{module}: {len(found) - found.count(None)} of {len(found)} killed", flush=True)
    print(f"all: {dead} of {total} killed ({dead / max(total, 1):.1%})")
    return 0 if dead >= 0.95 * total else 1


if __name__ == "__main__":
    sys.exit(main())
