"""Compare runs from their logs: `opt3dgs report RUN... -o DIR`.

Writes `report.md` and, with matplotlib (the extra `opt3dgs_optim[report]`), `report.png`, or
`report-SCENE.png` for each of several scenes.
"""

import argparse
import math
import re
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from opt3dgs_optim.runs.lines import Run, read_run
from opt3dgs_optim.runs.plot import draw, printable
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
    higher_is_better: bool | None = None,
) -> list[Path]:
    """Write the report on `runs` into the folder `out` and return the files written.

    The picture is left out, and missing in the returned list, if matplotlib is not installed.

    Args:
        runs: of any number of scenes, arms and seeds.
        out: folder, made if it is missing.
        metric: to compare by, as the runs log it; None: psnr if there, else the first whose
            direction is known, else the first.
        baseline: reference arm; None: "mcmc" if there, else the first.
        higher_is_better: whether higher values of the metric are better. None: as its name says,
            such as `val1_psnr`, `test/ssim`, `lpips_vgg` or `l1`. Where the name does not say it,
            the report shows the values, says so, and judges nothing.

    Raises:
        ValueError, OSError: no runs, no log with that metric, no run of that arm, a direction that
            is none, or two scenes whose pictures would have one name; `out` cannot be written.
            Nothing is written then.

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
    if not isinstance(higher_is_better, (bool, np.bool_, type(None))):
        raise ValueError(
            f"write_report: higher_is_better={higher_is_better!r}, but True, False or None is "
            "needed"
        )
    comparisons = compare(runs, metric, baseline, higher_is_better)
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


def as_markdown(
    comparisons: Sequence[Comparison], runs: Sequence[Run], pictures: Sequence[str]
) -> str:
    """A section a scene: table and picture (all have one, or none); how to read them."""
    parts = ["# Error against run time"]
    for i, comparison in enumerate(comparisons):
        if comparison.scene is not None:
            parts.append(f"## {escaped(comparison.scene)}")
        elif len(comparisons) > 1:
            parts.append("## Runs without a scene in their metadata")
        parts.append(_table(comparison))
        if pictures:
            metric = escaped(comparison.metric)
            parts.append(f"![{metric} over seconds and iterations]({pictures[i]})")
        if comparison.baseline is None:
            parts.append("The baseline arm did not run on this scene: nothing to compare with.")
        elif comparison.higher_is_better is None:
            parts.append(
                f"Whether higher or lower values of {escaped(comparison.metric)} are better is not "
                "known from its name, so nothing is judged by it: pass `--better higher` or "
                "`--better lower`."
            )
        elif unpaired := _unpaired(comparison):
            parts.append(
                f"No gain is shown for {', '.join(map(escaped, unpaired))}: no run has the `seed` "
                "of one of the baseline's in its metadata."
            )
    return "\n\n".join([*parts, READING, escaped(origin(runs))]).rstrip() + "\n"


def _unpaired(comparison: Comparison) -> list[str]:
    others = [arm for arm in comparison.arms if arm.name != comparison.baseline]
    return [arm.name for arm in others if arm.num_paired == 0]


def escaped(text: str) -> str:
    """`text` on one line, without a meaning in Markdown or HTML; `_` inside a word has none."""
    special = r"[\\`*\[\]<>|~&$#]|(?<![^\W_])_|_(?![^\W_])"
    return re.sub(special, lambda found: f"&#{ord(found[0])};", printable(text))


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
    form = f".{digits}f" if abs(stat.mean) < 1e12 else ".3g"
    text = f"{stat.mean:{form}}" + ("" if stat.std is None else f" ± {stat.std:{form}}")
    return text if stat.n == runs else f"{text} ({stat.n} of {runs})"


def origin(runs: Sequence[Run]) -> str:
    """Command, dates and machines that the logs were written with; no host names, no folders."""
    said = []
    for key in ("command", "time", "machine"):
        found = [(run.origin | run.metadata).get(key) for run in runs]
        texts = dict.fromkeys(str(f)[:10] if key == "time" else str(f) for f in found if f)
        said.append(", ".join(list(texts)[:3]) + (", ..." if len(texts) > 3 else ""))
    return "; ".join(text for text in said if text)


def _named(logs: Sequence[tuple[Path, Run]]) -> list[Run]:
    """Runs of one file name in several folders by the folders, where nothing else says the arm."""
    unnamed = {path: run for path, run in logs if "arm" not in run.metadata}
    folders: dict[str, set[Path]] = {}
    for path, run in unnamed.items():
        folders.setdefault(run.name, set()).add(path.resolve().parent)
    return [
        replace(run, name=path.resolve().parent.name)
        if path in unnamed and len(folders[run.name]) > 1
        else run
        for path, run in logs
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line: 0, or 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(
        prog="opt3dgs report", description="Compare runs from their run logs."
    )
    add = parser.add_argument
    add("runs", nargs="+", metavar="RUN", help="run log, or folder of *.jsonl")
    add("-o", "--out", default="report", metavar="DIR", help="to write into (default: report)")
    add("--metric", help="to compare by (default: psnr if logged, else the first that is known)")
    add("--better", choices=("higher", "lower"), help="direction of the metric (default: its name)")
    add("--baseline", metavar="ARM", help="reference arm (default: mcmc if there, else the first)")
    options = parser.parse_args(arguments)
    try:
        logs = find_logs(options.runs)
        Path(options.out).mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=options.out).close()  # before any work is done
        runs = _named([(path, read_run(path)) for path in logs])
        better = None if options.better is None else options.better == "higher"
        written = write_report(
            runs,
            options.out,
            metric=options.metric,
            baseline=options.baseline,
            higher_is_better=better,
        )
    except (OSError, ValueError) as error:
        print("report:", printable(str(error)), file=sys.stderr)  # names from logs in it
        return 2
    print(*written, sep="\n")
    if not any(path.suffix == ".png" for path in written):
        print(NO_PICTURE, file=sys.stderr)
    return 0
