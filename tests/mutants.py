"""Break the arithmetic on purpose, one place at a time, and see the tests notice.

    python tests/mutants.py                    # all of TARGETS; three quarters of an hour on a core
    python tests/mutants.py --only partitions.py  # one module; the others' last result is kept
    python tests/mutants.py --again            # the survivors of the last result, after new tests
    python tests/mutants.py --share 0.1        # a random tenth; writes nothing

A copy of the package is changed in one place, and the module's own tests run on the copy, first
those that have noticed most so far. Every mutant gets a forked process with torch already imported
(Linux, macOS), with a limit on its processor time. The tests must pass on the unchanged copy, in
the same kind of process, before any mutant is tried. The result goes to
docs/results/stability/mutants.json; `mutants_equivalent.json` says why a survivor changes nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import resource
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from mutations import Mutant, mutants  # noqa: E402

PACKAGE = ROOT / "src/opt3dgs_optim"
EQUIVALENT = ROOT / "tests/mutants_equivalent.json"
EXPLAINED = ROOT / "docs/results/stability/mutants_explained.json"
RESULT = ROOT / "docs/results/stability/mutants.json"
ENERGY = ["test_partitions.py", "parts/test_histogram.py", "parts/test_histogram_extremes.py"]
CURVATURE = [
    f"lbfgs/test_{name}.py" for name in ("history", "two_loop", "lqn_direction", "foresight")
]
PARTS = ("annealing", "averaging", "fading", "out_of_view", "own_frame")
STATE = [  # the fast ones of those that are about it
    *(f"test_{name}.py" for name in ("state", "masks", "part", "checkpoints")),
    *(
        f"test_cases_{name}.py"
        for name in ("several_tensors", "moved_rows", "copies", "across_passes")
    ),
]
# Of these tests: those that compile C++, a law that the loop oracle sees sooner, other classes.
CHOSEN = "not slow and not hosts and not compiles and not processes"  # by their markers
LEFT_OUT = "not sanitizers and not mutants and not kernel and not compiles and not power_four"
OPTIONS_OF = ("EnergyHistogram", "IsotropicNoise", "PositionNoise", "Annealing", "Fading")
OPTIONS_OF += ("OwnFrame",)
LEFT_OUT += f" and not (test_options.py and not {' and not '.join(OPTIONS_OF)})"
# Module: the tests that are meant to notice. What energy, curvature and noise are made of included.
TARGETS = {
    "partitions.py": ENERGY,
    "parts/histogram.py": ENERGY,
    "lbfgs/two_loop.py": CURVATURE,
    "lbfgs/pairs.py": CURVATURE,
    "lbfgs/history.py": CURVATURE,
    "parts/noise.py": [
        "parts/test_noise.py",
        "parts/test_noise_covariance.py",
        "test_cases_noise.py",
        "test_options.py",
    ],
    **{f"parts/{name}.py": [f"parts/test_{name}.py", "test_options.py"] for name in PARTS},
    "parts/averaging.py": ["parts/test_averaging.py", "test_cases_strides.py", "test_options.py"],
    "frames.py": ["parts/test_own_frame.py", "parts/test_noise_covariance.py"],
    "removed_rows.py": ["test_removed_rows.py"],
    "state.py": STATE,
}


class Outcome(NamedTuple):
    """What a run of the tests said."""

    status: int  # of the process; pytest's exit code, or minus the signal
    failed: str | None = None  # the first test that failed
    seconds: Mapping[str, float] = MappingProxyType({})  # of every test that passed
    modules: Sequence[str] = ()  # that the run has imported
    package: str = ""  # the file that the package was imported from

    @property
    def killed(self) -> str | None:
        """What noticed, None if nothing did."""
        if self.status == 0:
            return None
        limits = {-signal.SIGXCPU: "processor time", -signal.SIGALRM: "time"}
        return self.failed or limits.get(self.status, f"exit status {self.status}")


class Plugin:
    """Runs the promising tests first and remembers what happened."""

    def __init__(self, kills: Counter[str], seconds: Mapping[str, float]) -> None:
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
        if not said.exists():
            return Outcome(status)
        return Outcome(status, *json.loads(said.read_text()))


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
    os.environ["PYTHONPATH"] = str(package.parent)
    # A mutant of the same second and size would be taken for the one before it.
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    known = set(sys.modules)
    # -n 0: in this process, whatever the project's own options are.
    options = ["-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-k", LEFT_OUT]
    options += ["-m", CHOSEN]
    # Hypothesis is imported before pytest could rewrite its assertions; it has none to rewrite.
    options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
    status = pytest.main([*options, *map(str, tests)], [plugin])
    ours = (str(package), str(tests[0].parent))
    files = {name: getattr(sys.modules[name], "__file__", None) for name in sys.modules}
    modules = [n for n, f in files.items() if n not in known and f and not f.startswith(ours)]
    origin = getattr(sys.modules.get(package.name), "__file__", None) or ""
    said.write_text(json.dumps([plugin.failed, plugin.seconds, modules, origin]))
    return int(status)


def preload(names: Iterable[str]) -> None:
    """Import here what every fork would import."""
    for name in names:
        if name not in sys.modules:
            try:
                __import__(name)
            except Exception as error:
                print(f"not preloaded: {name} ({error})", file=sys.stderr)


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def checked(module: str, outcome: Outcome, package: Path) -> Outcome:
    """The outcome of a run without a mutant, which must be good."""
    if outcome.status:
        raise SystemExit(f"{module}: {outcome.killed} fails without a mutant")
    if not Path(outcome.package).is_relative_to(package):
        raise SystemExit(f"{module}: the tests ran on {outcome.package}, not on {package}")
    return outcome


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
        healthy = checked(module, run_tests(package, tests, Plugin(kills, {}), None), package)
        limit = patience + 3 * int(_children_seconds() - begin)
        preload(healthy.modules)
        again = run_tests(package, tests, Plugin(kills, healthy.seconds), limit)
        checked(module, again, package)
        for mutant in tqdm(chosen, desc=module, mininterval=5):
            (package / module).write_text(mutant.source)
            outcome = run_tests(package, tests, Plugin(kills, healthy.seconds), limit)
            found.append(outcome.killed)
            if outcome.killed is None:
                tqdm.write(f"survived: {module}:{mutant.line}: {mutant.before} -> {mutant.after}")
            else:
                kills[outcome.killed] += 1
    return found


# -- the package's own modules ---------------------------------------------------------------------


def reasons(path: Path = EQUIVALENT) -> dict[tuple[str, str, str, str], str]:
    """Why a survivor changes nothing, by (module, function, before, after)."""
    entries = json.loads(path.read_text())
    return {(e["module"], e["function"], e["before"], e["after"]): e["why"] for e in entries}


def reasons_of_the_committed_run() -> dict[tuple[str, str, str, str], str]:
    """Those, and what was said of survivors whose lines have changed since that run."""
    return reasons() | reasons(EXPLAINED)


def described(mutant: Mutant) -> dict[str, str]:
    """A survivor as it is written down."""
    return {"function": mutant.function, "before": mutant.before, "after": mutant.after}


def survivor_key(one: dict[str, str]) -> tuple[str, str, str]:
    return one["function"], one["before"], one["after"]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--share", type=float, default=1.0, help="of the mutants, at random")
    parser.add_argument("--only", choices=TARGETS, help="one module; the others' result is kept")
    parser.add_argument("--again", action="store_true", help="the last result's survivors only")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    os.environ["HYPOTHESIS_PROFILE"] = "mutants"
    os.environ["OMP_NUM_THREADS"] = "1"
    import torch

    torch.set_num_threads(1)
    chance = random.Random(options.seed)
    last = json.loads(RESULT.read_text())["modules"] if RESULT.exists() else {}
    modules = last if options.only or options.again else {}
    for module in [options.only] if options.only else TARGETS:
        every = list(mutants((PACKAGE / module).read_text()))
        chosen = [m for m in every if chance.random() < options.share]
        if options.again:
            keys = {survivor_key(one) for one in last[module]["survivors"]}
            chosen = [mutant for mutant in every if mutant.key in keys]
        if not chosen:
            continue
        found = examine(PACKAGE, module, chosen, [ROOT / "tests" / t for t in TARGETS[module]])
        alive = [described(m) for m, killer in zip(chosen, found, strict=True) if not killer]
        many = len(every) if options.again else len(chosen)
        modules[module] = {
            "date": date.today().isoformat(),
            "mutants": many,
            "killed": many - len(alive),
            "survivors": alive,
        }
        print(f"{module}: {many - len(alive)} of {many} killed", flush=True)
        if options.share == 1.0:
            write(modules, torch.__version__)
    total = sum(entry["mutants"] for entry in modules.values())
    dead = sum(entry["killed"] for entry in modules.values())
    print(f"all: {dead} of {total} killed ({dead / max(total, 1):.1%})")
    return 0 if dead >= 0.9 * total else 1


def write(modules: dict[str, Any], torch_version: str) -> None:
    about = {
        "command": "python tests/mutants.py",
        "machine": f"{platform.system()} {platform.machine()}, torch {torch_version}",
    }
    ordered = {name: modules[name] for name in TARGETS if name in modules}
    RESULT.write_text(json.dumps({"about": about, "modules": ordered}, indent=1) + "\n")
    print(f"wrote {RESULT}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
