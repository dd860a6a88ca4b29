"""Compare runs from their logs: `opt3dgs report RUN... -o DIR`.

Writes `report.md` and, with matplotlib (the extra `opt3dgs_optim[report]`), `report.png`, or
`report-SCENE.png` for each of several scenes.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from opt3dgs_optim.plateau import WINDOW
from opt3dgs_optim.runs.lines import Run, read_run
from opt3dgs_optim.runs.plot import draw
from opt3dgs_optim.runs.stats import Comparison, Stat, compare, gain_at_end

NO_PICTURE = "report: no picture without matplotlib: pip install matplotlib"
READING = (
    "Mean ± standard error over the seeds; (k of n) where not all n runs have the value. "
    "*seconds to baseline*: until the arm first reaches the baseline's mean final value. "
    "*gain*: difference to the baseline's run of the same seed at the smaller of the two final "
    "times, positive is better; runs without a seed are not paired. Both interpolate linearly "
    "between evaluations."
)


def write_report(
    runs: Sequence[Run], out: str | Path, *, metric: str | None = None, baseline: str | None = None
) -> list[Path]:
    """Write the report on `runs` into the folder `out` and return the files written.

    The picture is left out, and missing in the returned list, if matplotlib is not installed.

    Args:
        runs: of any number of scenes, arms and seeds.
        out: folder, made if it is missing.
        metric: to compare by; None takes psnr if it is logged, else the first whose name says
            whether higher or lower is better.
        baseline: reference arm; None takes "stock" if there, else the first.

    Raises:
        ValueError, OSError: as `stats.compare` raises; `out` cannot be written.

    Examples:
        >>> import tempfile
        >>> from opt3dgs_optim import RunLog
        >>> from opt3dgs_optim.runs import read_run
        >>> from opt3dgs_optim.runs.report import write_report
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for arm, psnr in (("stock", 24.0), ("defaults", 25.5)):
        ...         about = {"arm": arm, "seed": 0}
        ...         with RunLog(f"{folder}/{arm}.jsonl", metadata=about) as log:
        ...             log.evaluation(7_000, psnr=psnr)
        ...     runs = [read_run(f"{folder}/{arm}.jsonl") for arm in ("stock", "defaults")]
        ...     report, *_ = write_report(runs, f"{folder}/report", baseline="stock")
        ...     "| defaults | 1 | 25.50 |" in report.read_text()
        True
    """
    comparisons = compare(runs, metric, baseline)
    said = (
        f"{str(run.origin['time'])[:10]}, {run.origin['machine']}" for run in runs if run.origin
    )
    origin = "; ".join(dict.fromkeys(said))  # usually one
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    parts, written = ["# Error against run time"], [out / "report.md"]
    for comparison in comparisons:
        scene = comparison.scene
        if scene or len(comparisons) > 1:
            parts.append(f"## {_cell(scene) or 'Runs without a scene'}")
        parts += [_table(comparison), *_gains(comparison)]
        if find_spec("matplotlib"):
            tail = f"-{scene}" if len(comparisons) > 1 else ""
            picture = out / (re.sub(r"[^\w.-]+", "_", f"report{tail}")[:60] + ".png")
            draw(comparison, picture, origin)
            parts.append(f"![{comparison.metric} over seconds and iterations]({picture.name})")
            written.append(picture)
    text = "\n\n".join([*parts, READING, origin]).rstrip() + "\n"
    written[0].write_text(text, encoding="utf-8")
    return written


def _gains(comparison: Comparison) -> list[str]:
    """A sentence for each arm whose steps have the loss: whether its last iterations still gain."""
    found = []
    for arm in comparison.arms:
        gains = [gain for run in arm.runs if (gain := gain_at_end(run)) is not None]
        if gains:
            listed = ", ".join(f"{gain:.2f} ± {error:.2f}" for gain, error in gains)
            found.append(
                f"The last {WINDOW:,} iterations of {_cell(arm.name)} gained {listed} dB in the "
                "loss over as many before (± standard error)."
            )
    return found


def _cell(text: str) -> str:
    """`text` in one line and one cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def _table(comparison: Comparison) -> str:
    numbers = list(comparison.arms[0].numbers)
    rows = [["arm", "seeds", *map(_cell, numbers)], ["---", *["---:"] * (len(numbers) + 1)]]
    for arm in comparison.arms:
        *cells, gain = (_shown(stat, len(arm.runs)) for stat in arm.numbers.values())
        gain = "baseline" if arm.name == comparison.baseline else gain
        rows.append([_cell(arm.name), str(len(arm.runs)), *cells, gain])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _shown(stat: Stat | None, runs: int) -> str:
    """Text such as "25.21 ± 0.03" or "0.8312 ± 0.0012 (2 of 3)"."""
    if stat is None:
        return "–"
    digits = 4 if abs(stat.mean) < 1 else 2 if abs(stat.mean) < 100 else 0
    error = "" if stat.error is None else f" ± {stat.error:.{digits}f}"
    return f"{stat.mean:.{digits}f}{error}" + ("" if stat.n == runs else f" ({stat.n} of {runs})")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line: 0, or 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(
        prog="opt3dgs report",
        description="Compare runs from their run logs, by error against run time, with a picture.",
        epilog="A trainer writes them by RunLog; for example: opt3dgs report runs/ -o report",
    )
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN", help="run log, or folder of *.jsonl")
    add("-o", "--out", default="report", metavar="DIR", help="to write into (default: report)")
    add("--metric", help="to compare by (default: psnr if logged, else the first that is known)")
    add("--baseline", metavar="ARM", help="reference arm (default: stock if there, else the first)")
    options = parser.parse_args(arguments)
    try:
        paths = map(Path, options.runs)
        logs = (sorted(p.rglob("*.jsonl")) if p.is_dir() else [p] for p in paths)
        runs = [read_run(path) for found in logs for path in found]
        chosen = {"metric": options.metric, "baseline": options.baseline}
        written = write_report(runs, options.out, **chosen)
    except (OSError, ValueError) as error:
        print(f"report: {error}", file=sys.stderr)
        return 2
    print(*written, sep="\n")
    if len(written) == 1:
        print(NO_PICTURE, file=sys.stderr)
    return 0
