"""The figures of docs/results/stability/stability.md: from the JSON beside it, between its markers.

`stability.py` calls this; nothing is measured here.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from mutants import (  # tests/, where `stability` has put them within reach
    CHOSEN,
    reasons_of_the_committed_run,
    survivor_key,
)

LEAST_COVERAGE = 95.0  # per cent, of branches and of statements; modules below are listed
SLOW = "python -m pytest -m slow --junitxml=build/slow.xml"
COVERAGE = (
    f"python -m pytest -m '{CHOSEN}' "
    "--cov --cov-config=tests/coverage.ini --cov-report=json:build/coverage.json"
)
MARK = "<!-- {}: made by examples/studies/stability/stability.py -->"


def table(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    head = list(header)
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(str(cell) for cell in line) + " |\n" for line in lines)


def slow_result(files: Iterable[Path], machine: str) -> dict[str, Any]:
    """Outcome and seconds of every test of junit files of pytest; a later file's replace."""
    tests: dict[str, dict[str, Any]] = {}
    day = ""
    for xml in files:
        for suite in ElementTree.parse(xml).iter("testsuite"):
            day = max(day, suite.get("timestamp", "").partition("T")[0])
            for case in suite.iter("testcase"):
                kinds = ("failure", "error", "skipped")
                bad = [kind for kind in kinds if case.find(kind) is not None]
                name = f"{case.get('classname', '').removeprefix('tests.')}::{case.get('name')}"
                seconds = round(float(case.get("time", 0)), 1)
                outcome = bad[0] if bad else "passed"
                tests[name] = {"test": name, "seconds": seconds, "outcome": outcome}
    about = {"command": SLOW, "date": day, "machine": machine}
    return {"about": about, "tests": list(tests.values())}


def coverage_result(report: Path, machine: str, note: str = "") -> dict[str, Any]:
    """Lines and branches of every module, of the JSON report of coverage.py."""
    found = json.loads(report.read_text())
    keys = ("num_statements", "covered_lines", "num_branches", "covered_branches")
    modules = {
        path.rpartition("opt3dgs_optim/")[2]: {key: entry["summary"][key] for key in keys}
        for path, entry in sorted(found["files"].items())
    }
    day = found["meta"]["timestamp"].partition("T")[0]
    about = {"command": COVERAGE, "date": day, "machine": machine, "note": note}
    return {"about": about, "modules": modules}


def slow_block(result: dict[str, Any]) -> str:
    tests, about = result["tests"], result["about"]
    passed = sum(test["outcome"] == "passed" for test in tests)
    minutes = sum(test["seconds"] for test in tests) / 60
    said = (
        f"Last run {about['date']} ({about['machine']}, which had other work too): {passed} of "
        f"{len(tests)} passed, in {minutes:.0f} minutes together.\n\n"
    )
    bad = [(f"`{t['test']}`", t["outcome"]) for t in tests if t["outcome"] != "passed"]
    return said + table(("test", "outcome"), bad) if bad else said.rstrip("\n") + "\n"


def share(entry: dict[str, int], kind: str) -> float:
    """Per cent of the "statements" that ran, or of the "branches" that were taken."""
    ran = "covered_lines" if kind == "statements" else "covered_branches"
    return 100.0 * entry[ran] / entry[f"num_{kind}"] if entry[f"num_{kind}"] else 100.0


def total(modules: dict[str, dict[str, int]]) -> dict[str, int]:
    """The sums over all modules."""
    keys = next(iter(modules.values()))
    return {key: sum(entry[key] for entry in modules.values()) for key in keys}


def coverage_block(result: dict[str, Any]) -> str:
    modules, about = result["modules"], result["about"]
    whole = total(modules)
    kinds = ("branches", "statements")
    taken, ran = (f"{share(whole, kind):.1f} % of" for kind in kinds)
    said = (
        f"Last run {about['date']} ({', '.join(filter(None, (about['machine'], about['note'])))}): "
        f"{taken} the {whole['num_branches']} branches of `src` were taken, "
        f"{ran} its {whole['num_statements']} statements ran.\n"
    )
    shares = {name: min(share(e, kind) for kind in kinds) for name, e in modules.items()}
    low = [f"`{name}` {least:.0f} %" for name, least in shares.items() if least < LEAST_COVERAGE]
    return said + (f"Below {LEAST_COVERAGE:.0f} %: {', '.join(low)}.\n" if low else "")


def mutants_block(result: dict[str, Any]) -> str:
    modules, about = result["modules"], result["about"]
    many = sum(entry["mutants"] for entry in modules.values())
    dead = sum(entry["killed"] for entry in modules.values())
    why = reasons_of_the_committed_run()
    gaps = [
        (f"`{name}` {one['function']}", _code(one["before"]), _code(one["after"]))
        for name, entry in modules.items()
        for one in entry["survivors"]
        if not (one.get("why") or why.get((name, *survivor_key(one))))
    ]
    dates = sorted({entry["date"] for entry in modules.values()})  # several, after --only
    when = " to ".join(dates[:: max(len(dates) - 1, 1)])
    text = (
        f"Last run {when} ({about['machine']}): {many} places were changed, one at a "
        f"time, and the tests noticed {dead} ({100 * dead / many:.1f} %). Of the others "
        f"{many - dead - len(gaps)} change nothing that a test could see, {len(gaps)} are gaps.\n"
    )
    return text + ("\n" + table(("where", "was", "became"), gaps) if gaps else "")


def _code(text: str) -> str:
    return "`" + text.partition("  #")[0].replace("|", "\\|") + "`"


BLOCKS: dict[str, Callable[[dict[str, Any]], str]] = {
    "slow": slow_block,
    "coverage": coverage_block,
    "mutants": mutants_block,
}


def texts(folder: Path, tables: str) -> dict[str, str]:
    """What the page says: `tables`, and every block of the JSON of its name in `folder`."""
    made = {"tables": tables}
    for name, make in BLOCKS.items():
        path = folder / f"{name}.json"
        made[name] = make(json.loads(path.read_text())) if path.exists() else "Not run yet.\n"
    return {name: f"\n{text}" for name, text in made.items()}
