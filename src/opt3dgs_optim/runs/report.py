"""Compare runs from their logs: `opt3dgs report RUN... -o DIR`.

Writes `report.md` and, with matplotlib (the extra `opt3dgs_optim[report]`), `report.png`, or
`report-SCENE.png` for each of several scenes.
"""

import argparse
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from opt3dgs_optim.runs.lines import Run, read_run
from opt3dgs_optim.runs.plot import draw
from opt3dgs_optim.runs.stats import Comparison, Stat, compare

NO_PICTURE = "report: no picture without matplotlib: pip install 'opt3dgs_optim[report]'"
READING = (
    "Mean ± sample standard deviation over the seeds; (k of n) where not all n runs have the "
    "value. *seconds to baseline*: until the arm first reaches the baseline's mean final value. "
    "*gain*: difference to the baseline's run of the same seed at the smaller of the two final "
    "times, positive is better; runs without a seed are not paired. Both interpolate linearly "
    "between evaluations."
)


def find_logs(paths: Sequence[str | Path]) -> list[Path]:
    """The log files among `paths`, and below those that are folders (`*.jsonl`), each once.

    Raises:
        FileNotFoundError: a path that does not exist, or a folder without a log.
    """
    found: dict[Path, Path] = {}
    for path in map(Path, paths):
        logs = sorted(path.rglob("*.jsonl")) if path.is_dir() else [path]
        if not logs or not path.exists():
            raise FileNotFoundError(f"{str(path)!r}: neither a log nor a folder with *.jsonl in it")
        for log in logs:
            found.setdefault(log.resolve(), log)
    return list(found.values())


def write_report(
    runs: Sequence[Run],
    out: str | Path,
    *,
    metric: str | None = None,
    baseline: str | None = None,
    higher_is_better: bool | None = None,
) -> list[Path]:
    """Write the report on `runs` into the folder `out` and return the files written.

    The picture is left out, and missing in the returned list, if matplotlib is not installed.

    Args:
        runs: of any number of scenes, arms and seeds.
        out: folder, made if it is missing.
        metric, baseline, higher_is_better: as `stats.compare`'s, with its errors.

    Raises:
        ValueError, OSError: there are no runs; `out` cannot be written.

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
    if not runs:
        raise ValueError("write_report: no runs; pass at least one")
    comparisons = compare(runs, metric, baseline, higher_is_better)
    scenes = [re.sub(r"[^\w.-]+", "_", each.scene or "")[:60] for each in comparisons]
    names = ["report.png"] if len(scenes) == 1 else [f"report-{scene}.png" for scene in scenes]
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


def as_markdown(
    comparisons: Sequence[Comparison], runs: Sequence[Run], pictures: Sequence[str]
) -> str:
    """A section a scene: table and picture (all have one, or none); how to read them."""
    parts = ["# Error against run time"]
    for i, comparison in enumerate(comparisons):
        if comparison.scene is not None or len(comparisons) > 1:
            parts.append(f"## {escaped(comparison.scene or 'Runs without a scene')}")
        parts.append(_table(comparison))
        metric = escaped(comparison.metric)
        if pictures:
            parts.append(f"![{metric} over seconds and iterations]({pictures[i]})")
        others = [arm for arm in comparison.arms if arm.name != comparison.baseline]
        unpaired = [escaped(arm.name) for arm in others if arm.num_paired == 0]
        if comparison.baseline is None:
            parts.append("The baseline arm did not run on this scene: nothing to compare with.")
        elif unpaired:
            parts.append(
                f"No gain is shown for {', '.join(unpaired)}: no run has the `seed` of one of the "
                "baseline's in its metadata."
            )
    return "\n\n".join([*parts, READING, escaped(origin(runs))]).rstrip() + "\n"


def escaped(text: str) -> str:
    """`text` without a meaning in Markdown or HTML; `_` inside a word has none."""
    special = r"[\\`*\[\]<>|~&$#\n]|(?<![^\W_])_|_(?![^\W_])"
    return re.sub(special, lambda found: f"&#{ord(found[0])};", text)


def _table(comparison: Comparison) -> str:
    numbers = list(comparison.arms[0].numbers)
    rows = [["arm", "seeds", *map(escaped, numbers)], ["---", *["---:"] * (len(numbers) + 1)]]
    for arm in comparison.arms:
        n = len(arm.runs)
        *cells, gain = (_shown(stat, n) for stat in arm.numbers.values())
        if arm.name == comparison.baseline:
            gain = "baseline"
        rows.append([escaped(arm.name), str(n), *cells, gain])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _shown(stat: Stat | None, runs: int) -> str:
    """Text such as "25.210 ± 0.031": two digits of the deviation, else four of the mean."""
    if stat is None:
        return "–"
    leading, wanted = (stat.std, 2) if stat.std else (stat.mean, 4)
    if not math.isfinite(leading) or leading == 0:
        digits = 0 if stat.mean == round(stat.mean, 6) else 3
    else:
        digits = min(4, max(0, wanted - 1 - math.floor(math.log10(abs(leading)))))
    text = f"{stat.mean:.{digits}f}" + ("" if stat.std is None else f" ± {stat.std:.{digits}f}")
    return text if stat.n == runs else f"{text} ({stat.n} of {runs})"


def origin(runs: Sequence[Run]) -> str:
    """Command, dates and machines that the logs were written with; no host names, no folders."""
    said = []
    for key in ("command", "time", "machine"):
        found = [(run.origin | run.metadata).get(key) for run in runs]
        texts = dict.fromkeys(str(f)[:10] if key == "time" else str(f) for f in found if f)
        said.append(", ".join(list(texts)[:3]) + (", ..." if len(texts) > 3 else ""))
    return "; ".join(text for text in said if text)


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
    add("--better", choices=("higher", "lower"), help="direction of the metric (default: its name)")
    add("--baseline", metavar="ARM", help="reference arm (default: mcmc if there, else the first)")
    if not arguments:
        parser.print_help()
        return 0
    options = parser.parse_args(arguments)
    try:
        logs = find_logs(options.runs)
        runs = [read_run(path) for path in logs]
        if len({run.name for run in runs}) < len(runs):  # A/stock/log.jsonl, A/ours/log.jsonl
            names = [path.resolve().parent.name for path in logs]
            runs = [replace(run, name=name) for run, name in zip(runs, names, strict=True)]
        better = None if options.better is None else options.better == "higher"
        chosen = {"metric": options.metric, "baseline": options.baseline}
        written = write_report(runs, options.out, higher_is_better=better, **chosen)
    except (OSError, ValueError) as error:
        print(f"report: {error}", file=sys.stderr)
        return 2
    print(*written, sep="\n")
    if not any(path.suffix == ".png" for path in written):
        print(NO_PICTURE, file=sys.stderr)
    return 0
