"""Compare runs from their logs: `opt3dgs report RUN... -o DIR`.

Writes `report.md` and, with matplotlib (the extra `opt3dgs_optim[report]`), `report.png`, or
`report-SCENE.png` for each of several scenes.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from opt3dgs_optim.runs.plot import draw
from opt3dgs_optim.runs.read import Run, read_run
from opt3dgs_optim.runs.stats import compare
from opt3dgs_optim.runs.table import as_markdown, origin

NO_PICTURE = (
    "report: no picture, since matplotlib is not installed: pip install 'opt3dgs_optim[report]'"
)


def find_logs(paths: Sequence[str | Path]) -> list[Path]:
    """The log files among `paths`, and below those that are folders (`*.jsonl`), each once.

    Raises:
        FileNotFoundError: a path that does not exist, or a folder without a log.
    """
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        if not path.exists():
            raise FileNotFoundError(f"no such file or folder: {str(path)!r}")
        logs = sorted(path.rglob("*.jsonl")) if path.is_dir() else [path]
        if not logs:
            raise FileNotFoundError(f"no *.jsonl file in the folder {str(path)!r}")
        for log in logs:
            found.setdefault(log.resolve(), log)
    return list(found.values())


def write_report(
    runs: Sequence[Run],
    out: str | Path,
    *,
    metric: str | None = None,
    baseline: str | None = None,
) -> list[Path]:
    """Write the report on `runs` into the folder `out` and return the files written.

    The picture is left out, and missing in the returned list, if matplotlib is not installed.

    Args:
        runs: of any number of scenes, arms and seeds.
        out: folder, made if it is missing.
        metric: to compare by, as the runs log it; None takes psnr if there, else the first.
        baseline: reference arm, alike in colour on all scenes; None takes "mcmc" if there, else
            the first arm.

    Raises:
        ValueError: no runs, no log with that metric, no run of that arm, or two scenes whose
            pictures would have one name. Nothing is written then.
        OSError: `out` cannot be written.
    """
    if not runs:
        raise ValueError("write_report: no runs; pass at least one")
    comparisons = compare(runs, metric, baseline)
    names = _picture_names([comparison.scene for comparison in comparisons])
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    try:
        for comparison, name in zip(comparisons, names, strict=True):
            draw(comparison, out / name, origin(runs))
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "matplotlib":
            raise
        names = []
    (out / "report.md").write_text(as_markdown(comparisons, runs, names), encoding="utf-8")
    return [out / name for name in ("report.md", *names)]


def _picture_names(scenes: list[str | None]) -> list[str]:
    if len(scenes) == 1:
        return ["report.png"]
    names = ["report-" + re.sub(r"[^\w.-]+", "_", s or "")[:60] + ".png" for s in scenes]
    if len({name.lower() for name in names}) < len(names):  # as some file systems see them
        raise ValueError(f"two of the scenes {scenes} would be drawn into one of {names}")
    return names


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line: 0, or 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(
        prog="opt3dgs report", description="Compare runs from their run logs."
    )
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN", help="run log, or folder of *.jsonl")
    add("-o", "--out", default="report", metavar="DIR", help="to write into (default: report)")
    add("--metric", help="to compare by (default: psnr if logged, else the first)")
    add("--baseline", metavar="ARM", help="reference arm (default: mcmc if there, else the first)")
    options = parser.parse_args(arguments)
    try:
        logs = find_logs(options.runs)
        Path(options.out).mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=options.out).close()  # before any work is done
        runs = [read_run(path) for path in logs]
        written = write_report(runs, options.out, metric=options.metric, baseline=options.baseline)
    except (OSError, ValueError) as error:
        line = "".join(c if c.isprintable() else " " for c in str(error))  # names from logs in it
        print("report:", line, file=sys.stderr)
        return 2
    for path in written:
        print(path)
    if not any(path.suffix == ".png" for path in written):
        print(NO_PICTURE, file=sys.stderr)
    return 0
