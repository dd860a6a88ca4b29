"""Compare runs from their logs: `python -m opt3dgs_optim.report RUN... -o DIR`.

Writes `report.md`, `report.csv`, `report.json` and, with matplotlib (the extra
`opt3dgs_optim[report]`), `report.png`, or `report-SCENE.png` for each of several scenes.
With `--follow` it watches runs that are still training instead; see `opt3dgs_optim.follow`.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from opt3dgs_optim.report_stats import Comparison, compare
from opt3dgs_optim.report_table import as_csv, as_json, as_markdown, origin_lines
from opt3dgs_optim.runread import Run, read_run

__all__ = ["find_logs", "main", "write_report"]

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
        if path.is_dir():
            logs = sorted(path.rglob("*.jsonl"))
            if not logs:
                raise FileNotFoundError(f"no *.jsonl file in the folder {str(path)!r}")
        elif path.exists():
            logs = [path]
        else:
            raise FileNotFoundError(f"no such file or folder: {str(path)!r}")
        for log in logs:
            found.setdefault(log.resolve(), log)
    return list(found.values())


def write_report(
    runs: Sequence[Run], out: str | Path, *, metric: str = "psnr", baseline: str | None = None
) -> list[Path]:
    """Write the report on `runs` into the folder `out` and return the files written.

    The picture is left out, and missing in the returned list, if matplotlib is not installed.

    Args:
        runs: of any number of scenes, arms and seeds.
        out: folder, made if it is missing.
        metric: to compare by, as the runs log it.
        baseline: reference arm; None takes "mcmc" if there, else the first arm.

    Raises:
        ValueError: no runs, or no run of the arm `baseline`.
        OSError: `out` cannot be written.
    """
    if not runs:
        raise ValueError("write_report: no runs; pass at least one")
    comparisons = compare(runs, metric, baseline)
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    pictures = _draw(comparisons, runs, out)
    texts = {
        "report.md": as_markdown(comparisons, runs, [p.name if p else None for p in pictures]),
        "report.csv": as_csv(comparisons),
        "report.json": as_json(comparisons, runs),
    }
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")
    return [out / name for name in texts] + [picture for picture in pictures if picture]


def _draw(comparisons: list[Comparison], runs: Sequence[Run], out: Path) -> list[Path | None]:
    """One picture a comparison, or None for each without matplotlib."""
    from opt3dgs_optim.report_plot import draw

    footer = "   ".join(origin_lines(runs))
    pictures: list[Path | None] = []
    for comparison in comparisons:
        scene = re.sub(r"[^\w.-]+", "_", comparison.scene or "")
        path = out / ("report.png" if len(comparisons) == 1 else f"report-{scene}.png")
        try:
            draw(comparison, path, footer)
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] != "matplotlib":
                raise
            return [None] * len(comparisons)
        pictures.append(path)
    return pictures


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m opt3dgs_optim.report", description="Compare runs from their run logs."
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run log, or folder of *.jsonl")
    parser.add_argument(
        "-o",
        "--out",
        default="report",
        metavar="DIR",
        help="folder to write into (default: report)",
    )
    parser.add_argument("--metric", default="psnr", help="metric to compare (default: psnr)")
    parser.add_argument("--baseline", metavar="ARM", help="reference arm (default: mcmc, or first)")
    live = parser.add_argument_group(
        "live view",
        "DIR/live.html, one file that opens offline, and DIR/live.png; logs may not exist yet. "
        "Ends with 0 when all runs have finished, with 130 after Ctrl-C; the last page stays.",
    )
    live.add_argument("--follow", action="store_true", help="redraw while the runs train")
    live.add_argument(
        "--every", type=float, default=10.0, metavar="SECONDS", help="between looks (default: 10)"
    )
    live.add_argument(
        "--patience",
        type=float,
        default=900.0,
        metavar="SECONDS",
        help="a run that has written nothing for so long counts as over (default: 900)",
    )
    return parser


def _follow(options: argparse.Namespace) -> int:
    from opt3dgs_optim.follow import follow

    for name in ("every", "patience"):
        value = getattr(options, name)
        if not 0 < value < math.inf:
            raise ValueError(f"--{name} {value}: must be a number of seconds above 0")
    print(Path(options.out) / "live.html", flush=True)
    return follow(
        options.runs,
        options.out,
        metric=options.metric,
        every=options.every,
        patience=options.patience,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; 0, 2 after one line that says what is wrong, 130 if a view is stopped."""
    options = _parser().parse_args(arguments)
    try:
        if options.follow:
            return _follow(options)
        runs = [read_run(path) for path in find_logs(options.runs)]
        written = write_report(runs, options.out, metric=options.metric, baseline=options.baseline)
    except (OSError, ValueError) as error:
        print(f"report: {error}", file=sys.stderr)
        return 2
    for path in written:
        print(path)
    if not any(path.suffix == ".png" for path in written):
        print(NO_PICTURE, file=sys.stderr)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
