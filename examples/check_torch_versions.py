"""Run the tests that need little but torch with the oldest and the newest torch.

    python examples/check_torch_versions.py            # 2.4.1 and 2.15.0, on Linux about 12 GB
    python examples/check_torch_versions.py --torch 2.6.0 --keep build/torch-versions

Every version gets a virtual environment of its own with torch, numpy, pillow, pytest and
hypothesis, and the package from this folder. Writes `torch_versions.json` and a table beside it
into `build/`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import venv
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from datetime import date
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parent.parent
# Tests that need more than these.
LEFT_OUT = (
    *("examples", "test_docs.py", "test_mutants.py", "cuda/test_kernel_compile.py"),
    *("hosts/test_survey.py", "hosts/test_trainers.py", "hosts/test_cpu_host.py"),
)
OLDEST, NEWEST = "2.4.1", "2.15.0"
# In place of the project's own options: no workers, which would be one more package.
PYTEST = ("-m", "pytest", "-q", "-o", "addopts=--import-mode=importlib", "-p", "no:cacheprovider")
MARKS = "not slow and not hosts and not compiles and not processes and not thorough"
# In a process of its own: what torch 2.4 compiles makes the whole process flush denormal numbers
# to zero, and hypothesis refuses to draw numbers then.
ALONE = "tests/runs/test_log.py"
# (first torch that has it, words in the tests' names, what they need)
NEWER = (
    ((2, 6), ("test_named_parameters_and_groups",), "`named_parameters()` given to an optimizer"),
    (
        (2, 7),
        (
            *("AdamW", "adamw", "Decoupled", "decoupled", "broken_loss_is_dropped_on_a_device_too"),
            *("mask_holds_do_not_decay", "is_of_the_positions_themselves"),
        ),
        "AdamW as a kind of Adam, so `upgrade` refuses it",
    ),
    ((2, 7), ("DCP", "dcp_files"), "distributed checkpoints without processes"),
    (
        (2, 7),
        ("without_parts_a_gpu_runs_the_trainers_own_adam_and_nothing_else",),
        "an operator for `isfinite`, which the tests count",
    ),
)


def environment(version: str, folder: Path) -> Path:
    """Python of a virtual environment with that torch and this package; made if it is missing."""
    python = folder / version / "bin" / "python"
    pip = [str(python), "-m", "pip", "install", "-q"]
    if not python.exists():
        print(f"torch {version}: installing ...", file=sys.stderr)
        venv.create(folder / version, with_pip=True)
        wanted = [f"torch=={version}", "numpy", "pillow", "pytest", "hypothesis"]
        subprocess.run([*pip, "--no-cache-dir", *wanted], check=True)
    subprocess.run([*pip, "--no-deps", "-e", str(ROOT)], check=True)
    return python


def check(version: str, python: Path) -> dict[str, Any]:
    """What pytest says in that environment."""
    ask = "import torch, numpy as n, platform as p; "
    ask += "print(torch.__version__, n.__version__, p.python_version())"
    command = [str(python), "-c", ask]
    answer = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    number = tuple(map(int, version.split(".")[:2]))
    missing = [(words, what) for since, words, what in NEWER if number < since]
    words = " or ".join(word for words, _ in missing for word in words)
    left_out = ["-k", f"not ({words})"] if words else []
    others = [f"--ignore=tests/{name}" for name in LEFT_OUT]
    counts, bad = Counter[str](), []
    for tests in (["tests", f"--ignore={ALONE}", *others], [ALONE]):
        for case in cases(python, ["-m", MARKS, *left_out, *tests]):
            kinds = ("failure", "error", "skipped")
            outcome = next((kind for kind in kinds if case.find(kind) is not None), "passed")
            counts[outcome] += 1
            if outcome in ("failure", "error"):
                bad.append(f"{outcome}: {case.get('classname')}::{case.get('name')}")
    return {
        "torch": answer[0],
        "numpy": answer[1],
        "python": answer[2],
        "passed": counts["passed"],
        "failed": counts["failure"],
        "skipped": counts["skipped"],
        "error": counts["error"],
        "bad": bad,
        "not_in_this_torch": [what for _, what in missing],
    }


def cases(python: Path, arguments: list[str]) -> list[ElementTree.Element]:
    """Every test of a run of pytest, which shows its own progress."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "junit.xml"
        command = [str(python), *PYTEST, f"--junitxml={report}", *arguments]
        code = subprocess.run(
            command, check=False, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"}
        ).returncode
        if code not in (0, 1):  # neither all passed nor some failed
            raise RuntimeError(f"{python}: pytest ended with {code}")
        return [*ElementTree.parse(report).iter("testcase")]


def table(record: dict[str, Any]) -> str:
    """The results as Markdown."""
    results = record["results"]
    rows = [
        f"| {r['torch']} | {r['numpy']} | {r['python']} | {r['passed']:,} | {r['skipped']:,} "
        f"| {r['failed'] + r['error']} |\n"
        for r in results
    ]
    lacks = [f"- torch {r['torch']} lacks {w}.\n" for r in results for w in r["not_in_this_torch"]]
    bad = [f"- torch {r['torch']}: `{line}`\n" for r in results for line in r["bad"]]
    return f"""# Supported torch versions

The oldest that `pyproject.toml` declares and the newest, each with the tests that need torch, \
numpy, pillow, pytest and hypothesis alone.

| torch | numpy | python | passed | skipped | failed |
|---|---|---|---:|---:|---:|
{"".join(rows)}
{"".join(lacks + bad)}
By `{record["command"]}` on {record["date"]}, {record["platform"]}; no GPU.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, or 1 if a test failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--torch", nargs="+", default=[OLDEST, NEWEST], metavar="VERSION")
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="keep the environments, or use them"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "build", metavar="DIR")
    options = parser.parse_args(arguments)
    kept = nullcontext(options.keep) if options.keep else tempfile.TemporaryDirectory()
    with kept as folder:
        results = [check(v, environment(v, Path(folder))) for v in options.torch]
    record = {
        "command": f"python examples/check_torch_versions.py --torch {' '.join(options.torch)}",
        "date": date.today().isoformat(),
        "platform": platform.platform(),
        "left_out": LEFT_OUT,
        "results": results,
    }
    options.out.mkdir(parents=True, exist_ok=True)
    text = table(record)
    (options.out / "torch_versions.json").write_text(json.dumps(record, indent=1) + "\n")
    (options.out / "torch_versions.md").write_text(text)
    print(text)
    return int(any(result["failed"] or result["error"] for result in results))


if __name__ == "__main__":
    raise SystemExit(main())
