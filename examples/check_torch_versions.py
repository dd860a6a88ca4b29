"""Run the tests that need nothing but torch with the oldest and the newest torch.

    python examples/check_torch_versions.py            # 2.4.1 and 2.15.0, on Linux about 12 GB
    python examples/check_torch_versions.py --torch 2.6.0 --keep build/torch-versions

Every version gets a virtual environment of its own with torch, numpy, pytest and hypothesis, and
the package from this folder. Writes `docs/torch_versions.json` and a table beside it.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
TESTS, EXAMPLES = ROOT / "tests", ROOT / "examples"
PRESENT = {"torch", "numpy", "pytest", "hypothesis", "opt3dgs_optim"}
OLDEST, NEWEST = "2.4.1", "2.15.0"
PROGRESS = re.compile(r"\[\s*(\d+)%\]")
COUNTS = re.compile(r"(\d+) (passed|failed|skipped|errors?)\b")
# In a process of its own: what torch 2.4 compiles makes the whole process flush denormal numbers
# to zero, and hypothesis refuses to draw numbers then.
ALONE = "test_log.py"
# (first torch that has it, test, what it needs)
NEWER = (
    (
        (2, 6),
        "tests/test_corners.py::test_named_parameters_and_groups",
        "`named_parameters()` given to an optimizer",
    ),
    (
        (2, 7),
        "tests/test_phases.py::test_adamw_is_upgraded_with_its_decay",
        "AdamW as a kind of Adam, so `upgrade` refuses it",
    ),
)
# A time, which says something of the machine rather than of the version.
NOT_ASKED = "tests/test_import_cost.py::test_import_costs_less_than_50_ms_beyond_torch"


def needs_only_torch(test: Path) -> bool:
    """Whether a test file, with all of ours that it imports, needs no other package."""
    seen: set[Path] = set()
    waiting = [test]
    while waiting:
        path = waiting.pop()
        if path in seen:
            continue
        seen.add(path)
        for name in imported(path):
            ours = local_files(name)
            waiting += ours
            top = name.split(".")[0]
            if not ours and top not in PRESENT and top not in sys.stdlib_module_names:
                return False
    return True


def imported(path: Path) -> set[str]:
    """Names of the modules that a file imports, at its top or inside a function."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return names


def local_files(name: str) -> list[Path]:
    """The files of a module of the tests or the examples; none for any other module."""
    stem = name.replace(".", "/")
    found = [folder / f"{stem}.py" for folder in (TESTS, EXAMPLES)]
    found += [folder / stem / "__init__.py" for folder in (TESTS, EXAMPLES)]
    return [path for path in found if path.exists()]


def suitable_tests() -> list[Path]:
    """The test files that need torch, numpy, pytest and hypothesis alone.

    That of the documentation starts the examples' commands, which need the extras.
    """
    found = sorted(TESTS.rglob("test_*.py"))
    return [path for path in found if path.name != "test_docs.py" and needs_only_torch(path)]


def environment(version: str, folder: Path) -> Path:
    """Python of a virtual environment with that torch and this package; made if it is missing."""
    python = folder / version / "bin" / "python"
    pip = [str(python), "-m", "pip", "install", "-q"]
    if not python.exists():
        print(f"torch {version}: installing ...", file=sys.stderr)
        venv.create(folder / version, with_pip=True)
        wanted = [f"torch=={version}", "numpy", "pytest", "hypothesis"]
        subprocess.run([*pip, "--no-cache-dir", *wanted], check=True)
    subprocess.run([*pip, "--no-deps", "-e", str(ROOT)], check=True)
    return python


def check(version: str, python: Path, tests: Sequence[Path]) -> dict[str, Any]:
    """What pytest says of `tests` in that environment."""
    ask = "import torch, numpy as n, platform as p; "
    ask += "print(torch.__version__, n.__version__, p.python_version())"
    command = [str(python), "-c", ask]
    answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    missing = [(test, what) for since, test, what in NEWER if numbers(version) < since]
    left_out = [argument for test, _ in missing for argument in ("--deselect", test)]
    parts = [[p for p in tests if (p.name == ALONE) is alone] for alone in (False, True)]
    lines: list[str] = []
    for part in filter(None, parts):
        names = [str(path.relative_to(ROOT)) for path in part]
        options = ["-q", "-p", "no:cacheprovider", "--deselect", NOT_ASKED, *left_out]
        lines += pytest(version, [str(python), "-m", "pytest", *options, *names])
    counts = dict.fromkeys(("passed", "failed", "skipped", "error"), 0)
    for line in lines:
        if re.search(r" in [\d.]+s", line):  # pytest's last
            for number, what in COUNTS.findall(line):
                counts[what.removesuffix("s")] += int(number)
    return {
        "torch": answer[0],
        "numpy": answer[1],
        "python": answer[2],
        **counts,
        "bad": [line for line in lines if line.startswith(("FAILED", "ERROR"))],
        "not_in_this_torch": [what for _, what in missing],
    }


def numbers(version: str) -> tuple[int, int]:
    """Major and minor version."""
    major, minor = version.split(".")[:2]
    return int(major), int(minor)


def pytest(version: str, command: list[str]) -> list[str]:
    """The lines that a test run prints, its progress shown on the way."""
    environ = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, cwd=ROOT, env=environ, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    lines = []
    for line in process.stdout or []:
        lines.append(line.rstrip())
        found = PROGRESS.search(line)
        if found and sys.stderr.isatty():
            print(f"\rtorch {version}: {found[1]:>3} % of the tests", end="", file=sys.stderr)
    if process.wait() not in (0, 1):  # neither all passed nor some failed
        raise RuntimeError(
            f"torch {version}: pytest ended with {process.returncode}: {lines[-20:]}"
        )
    if sys.stderr.isatty():
        print(file=sys.stderr)
    return lines


def table(record: dict[str, Any]) -> str:
    """The results as Markdown."""
    rows = [
        f"| {r['torch']} | {r['numpy']} | {r['python']} | {r['passed']:,} | {r['skipped']:,} "
        f"| {r['failed'] + r['error']} |"
        for r in record["results"]
    ]
    notes = [
        f"- torch {r['torch']} lacks {what}."
        for r in record["results"]
        for what in r["not_in_this_torch"]
    ]
    bad = [f"- torch {r['torch']}: `{line}`" for r in record["results"] for line in r["bad"]]
    return "\n".join(
        [
            "# Supported torch versions",
            "",
            "The oldest that `pyproject.toml` declares and the newest, each with the tests that "
            "need torch, numpy, pytest and hypothesis alone.",
            "",
            "| torch | numpy | python | passed | skipped | failed |",
            "|---|---|---|---:|---:|---:|",
            *rows,
            "",
            *notes,
            *bad,
            "",
            f"By `{record['command']}` on {record['date']}, {record['platform']}; no GPU.",
            "",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, or 1 if a test failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--torch", nargs="+", default=[OLDEST, NEWEST], metavar="VERSION")
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="keep the environments, or use them"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "docs", metavar="DIR")
    options = parser.parse_args(arguments)
    folder = options.keep or Path(tempfile.mkdtemp(prefix="torch-versions-"))
    tests = suitable_tests()
    try:
        results = [check(v, environment(v, folder), tests) for v in options.torch]
    finally:
        if options.keep is None:
            shutil.rmtree(folder)
    record = {
        "command": f"python examples/check_torch_versions.py --torch {' '.join(options.torch)}",
        "date": date.today().isoformat(),
        "platform": platform.platform(),
        "test_files": [path.name for path in tests],
        "results": results,
    }
    text = table(record)
    (options.out / "torch_versions.json").write_text(json.dumps(record, indent=1) + "\n")
    (options.out / "torch_versions.md").write_text(text)
    print(text)
    return int(any(result["failed"] or result["error"] for result in results))


if __name__ == "__main__":
    raise SystemExit(main())
