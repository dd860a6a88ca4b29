"""Break the arithmetic on purpose, one place at a time, and see the tests notice.

    python tests/mutants.py                       # all of TARGETS
    python tests/mutants.py parts/histogram.py    # one of them
    python tests/mutants.py step.py test_a.py parts/test_b.py   # any module, with its tests
    python tests/mutants.py --share 0.1           # a random tenth

The tests are collected once. For every mutant a forked process (Linux, macOS) puts the changed
functions in the place of the module's own, in memory, and runs the tests, first those that have
noticed most so far, with a limit on its processor time. Before that, all of them must pass.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path
from types import FunctionType, MemberDescriptorType
from typing import Any

import pytest
from mutations import Mutant, mutants

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src/opt3dgs_optim"
KERNELS = PACKAGE / "triton/kernels.py"
CHOSEN = "not slow and not hosts and not compiles and not processes and not thorough"
ENERGY = ["test_partitions.py", "parts/test_histogram.py", "parts/test_histogram_extremes.py"]
LBFGS = ["lbfgs/test_history.py", "lbfgs/test_two_loop.py", "lbfgs/test_lqn_direction.py"]
STEP = ["test_step.py", "parts/test_own_frame.py", "parts/test_fading.py"]
STEP += ["parts/test_averaging.py", "parts/test_out_of_view.py", "test_moments.py", "test_adam.py"]
STEP += ["test_reference_step.py"]
TARGETS = {  # module: the tests that are meant to notice
    "partitions.py": ENERGY,
    "parts/histogram.py": ENERGY,
    "parts/noise.py": ["parts/test_noise.py"],
    "parts/annealing.py": ["parts/test_annealing.py"],
    "parts/switch.py": ["parts/test_last_phase.py"],
    "parts/curvature.py": ["parts/test_curvature.py"],
    "parts/fading.py": ["parts/test_fading.py"],
    "parts/averaging.py": ["parts/test_averaging.py"],
    "parts/out_of_view.py": ["parts/test_out_of_view.py"],
    "parts/own_frame.py": ["parts/test_own_frame.py"],
    "awsgld.py": ["test_awsgld.py"],
    "lqnadam.py": ["test_lqnadam.py"],
    "lbfgs/pairs.py": LBFGS,
    "lbfgs/history.py": LBFGS,
    "lbfgs/two_loop.py": LBFGS,
    "moments.py": ["test_moments.py", "test_step.py"],
    "step.py": STEP,
    "triton/kernels.py": ["triton/test_kernels.py", "triton/test_simulated_training.py"],
}


def change_module(module: Any, source: str) -> None:
    """Have a module that others have imported from do what `source` says.

    Its functions and classes stay the objects that they are, with what the new ones have.
    """
    before = {n: v for n, v in vars(module).items() if isinstance(v, (type, FunctionType))}
    exec(compile(source, str(module.__file__), "exec"), vars(module))
    for name, old in before.items():
        new = vars(module)[name]
        if new is old:
            continue  # imported
        if isinstance(old, FunctionType):
            old.__code__, old.__defaults__ = new.__code__, new.__defaults__
            old.__kwdefaults__ = new.__kwdefaults__
        else:
            _change_class(old, new)
        setattr(module, name, old)


def change_kernels(source: str) -> None:
    """Have the tests load kernels that do what `source` says: Triton reads them from a file."""
    name, found = "opt3dgs_optim.triton.kernels", importlib.util.find_spec
    file = Path(tempfile.mkdtemp(), "kernels.py")
    file.write_text(source)

    def find_spec(asked: str, package: str | None = None) -> Any:
        if asked != name:
            return found(asked, package)
        return importlib.util.spec_from_file_location(name, file)

    importlib.util.find_spec = find_spec


def _change_class(old: type, new: type) -> None:
    for key, value in vars(new).items():
        # Slots lie in the old class as they did.
        if key not in ("__dict__", "__weakref__") and not isinstance(value, MemberDescriptorType):
            setattr(old, key, value)
        for cell in getattr(value, "__closure__", None) or ():
            if cell.cell_contents is new:  # super()'s
                cell.cell_contents = old


class Runner:
    """A pytest plugin that runs the tests once for every mutant.

    Attributes:
        found: what noticed each mutant, None if nothing did.
    """

    def __init__(self, path: Path, chosen: list[Mutant], patience: int) -> None:
        self.path, self.chosen, self.patience = path, chosen, patience
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        self.name = ".".join(parts)
        self.found: list[str | None] = []
        self._kills: Counter[str] = Counter()
        self._seconds: dict[str, float] = {}

    def pytest_runtestloop(self, session: Any) -> bool:
        module, source = importlib.import_module(self.name), self.path.read_text()
        if Path(str(module.__file__)) != self.path:
            raise pytest.UsageError(f"{self.name} is imported from {module.__file__}")
        change = change_kernels if self.path == KERNELS else partial(change_module, module)
        begin = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        failed = self._run(session.items, lambda: change(source), None)
        if failed is not None:
            raise pytest.UsageError(f"{self.name}: {failed} fails without a mutant")
        used = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - begin
        for count, mutant in enumerate(self.chosen, 1):
            order = sorted(
                session.items, key=lambda i: (-self._kills[i.nodeid], self._seconds[i.nodeid])
            )
            killer = self._run(
                order, lambda m=mutant: change(m.source), self.patience + 3 * int(used)
            )
            self.found.append(killer)
            if killer is None:
                place = f"{self.name}:{mutant.line}"
                self._say(f"survived: {place}: {mutant.before} -> {mutant.after}")
            else:
                self._kills[killer] += 1
            if count % 10 == 0:
                self._say(f"{count} of {len(self.chosen)}")
        return True

    def _say(self, line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    def _run(self, items: list[Any], prepare: Any, limit: int | None) -> str | None:
        """The first of the tests that fails, in a fork of this process."""
        from _pytest.runner import runtestprotocol
        from _pytest.warnings import catch_warnings_for_item

        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            silent = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silent, 1)
            os.dup2(silent, 2)
            if limit is not None:
                resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
                resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
            failed = "import"
            try:
                prepare()
                failed = None
                for item in items:
                    begin = time.perf_counter()
                    with catch_warnings_for_item(item.config, item.ihook, "runtest", item=item):
                        reports = runtestprotocol(item, nextitem=None, log=False)
                    if any(report.failed for report in reports):
                        failed = item.nodeid
                        break
                    os.write(writing, f"{time.perf_counter() - begin} {item.nodeid}\n".encode())
            finally:
                os.write(writing, f"- {failed or ''}\n".encode())
                os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            said = [line.rstrip("\n").split(" ", 1) for line in pipe]
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        for seconds, test in said:
            if seconds != "-":
                self._seconds[test] = float(seconds)
        if not said or said[-1][0] != "-":
            return f"exit status {status}"
        return said[-1][1] or None


def examine(
    path: Path, chosen: list[Mutant], tests: list[Path], patience: int = 10
) -> list[str | None]:
    """What noticed each mutant of a module of the package.

    `patience` is the time limit, in seconds beyond three times what the tests need.
    """
    runner = Runner(path, chosen, patience)
    options = ["-q", "-s", "-n", "0", "-p", "no:cacheprovider", "-m", CHOSEN]
    # Hypothesis is imported before pytest could rewrite its assertions; it has none to rewrite.
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    status = pytest.main([*options, *map(str, tests)], [runner])
    if status != pytest.ExitCode.OK:
        raise SystemExit(f"{path}: pytest ends with {status!r}")
    return runner.found


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("module", nargs="?", help="of the package; none: all of TARGETS")
    parser.add_argument("tests", nargs="*", help="that are meant to notice, below tests/")
    parser.add_argument("--share", type=float, default=1.0, help="of the mutants, at random")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ.update(HYPOTHESIS_PROFILE="mutants", OMP_NUM_THREADS="1")
    sys.path.insert(0, str(PACKAGE.parent))
    chance, total, dead = random.Random(options.seed), 0, 0
    for module in [options.module] if options.module else TARGETS:
        tests = [ROOT / "tests" / test for test in options.tests or TARGETS[module]]
        every = mutants((PACKAGE / module).read_text())
        chosen = [mutant for mutant in every if chance.random() < options.share]
        found = examine(PACKAGE / module, chosen, tests)
        total, dead = total + len(found), dead + len(found) - found.count(None)
        print(f"{module}: {len(found) - found.count(None)} of {len(found)} killed", flush=True)
    print(f"all: {dead} of {total} killed ({dead / max(total, 1):.1%})")
    return 0 if dead >= 0.95 * total else 1


if __name__ == "__main__":
    sys.exit(main())
