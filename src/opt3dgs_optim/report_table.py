"""A report as text: Markdown for people, CSV and JSON for programs."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from typing import Any

from opt3dgs_optim.report_stats import Arm, Comparison, Stat, higher_is_better, memory_of
from opt3dgs_optim.runfile import plain
from opt3dgs_optim.runread import Run

__all__ = ["as_csv", "as_json", "as_markdown", "origin_lines"]

LABELS = {
    "iterations_per_second": "iterations/s",
    "peak_memory_bytes": "peak memory",
    "mean_nu": "mean nu",
    "accepted_share": "accepted share",
}
GIB = 2.0**30


def as_json(comparisons: Sequence[Comparison], runs: Sequence[Run]) -> str:
    """The whole report; statistics are {mean, std, n} or null, NaN is the string "nan"."""
    report = {
        "format": 1,
        "origin": origin_lines(runs),
        "scenes": [
            {
                "scene": c.scene,
                "metric": c.metric,
                "higher_is_better": higher_is_better(c.metric),
                "baseline": c.baseline,
                "baseline_final": c.target,
                "arms": [_arm_object(arm) for arm in c.arms],
                "notes": c.notes,
            }
            for c in comparisons
        ],
    }
    return json.dumps(plain("report", report), indent=2, allow_nan=False) + "\n"


def _arm_object(arm: Arm) -> dict[str, Any]:
    return {
        "arm": arm.name,
        "runs": [{"name": run.name, "seed": run.metadata.get("seed")} for run in arm.runs],
        "final": {name: _stat_object(stat) for name, stat in arm.finals.items()},
        **{name: _stat_object(stat) for name, stat in arm.numbers.items()},
        "seconds_to_baseline": _stat_object(arm.to_baseline),
        "gain_at_equal_seconds": _stat_object(arm.gain),
        "gain_paired_by_seed": arm.paired,
    }


def _stat_object(stat: Stat | None) -> dict[str, Any] | None:
    return None if stat is None else {"mean": stat.mean, "std": stat.std, "n": stat.n}


def as_csv(comparisons: Sequence[Comparison]) -> str:
    """One row an arm, three columns (mean, std, n) a statistic; an empty cell is "none"."""
    rows = []
    for comparison in comparisons:
        for arm in comparison.arms:
            row: dict[str, Any] = {"scene": comparison.scene or "", "arm": arm.name}
            row["seeds"] = len(arm.runs)
            for name, stat in _statistics(arm).items():
                mean, std, n = (stat.mean, stat.std, stat.n) if stat else (None, None, 0)
                row |= {f"{name}_mean": mean, f"{name}_std": std, f"{name}_n": n}
            rows.append(row)
    text = io.StringIO()
    columns = list(dict.fromkeys(key for row in rows for key in row))
    writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _statistics(arm: Arm) -> dict[str, Stat | None]:
    finals = {f"final_{name}": stat for name, stat in arm.finals.items()}
    compared = {"seconds_to_baseline": arm.to_baseline, "gain_at_equal_seconds": arm.gain}
    return finals | arm.numbers | compared


def as_markdown(
    comparisons: Sequence[Comparison], runs: Sequence[Run], pictures: Sequence[str | None]
) -> str:
    """A section a scene: table, picture (where there is a file), how to read it, notes."""
    parts = ["# Error against run time"]
    for comparison, picture in zip(comparisons, pictures, strict=True):
        if comparison.scene is not None:
            parts.append(f"## {comparison.scene}")
        parts.append(_table(comparison))
        if picture:
            parts.append(f"![{comparison.metric} over seconds and iterations]({picture})")
        if comparison.notes:
            parts.append("\n".join(f"- {note}" for note in comparison.notes))
        if comparison.baseline is None:
            parts.append("The baseline arm did not run on this scene: nothing to compare with.")
    parts.append(
        "Mean ± sample standard deviation over the seeds; (k of n) where not all n runs have the "
        "value. *seconds to baseline*: until the arm first reaches the baseline's mean final "
        "value. *gain*: difference to the baseline at the smaller of the two final times, "
        "positive is better; by pairs of equal seeds where every run has its partner, else (~) "
        "between means. Both interpolate linearly between evaluations."
    )
    parts.append("  \n".join(origin_lines(runs)))
    return "\n\n".join(part for part in parts if part) + "\n"


def _table(comparison: Comparison) -> str:
    metric = comparison.metric
    used = [
        name
        for name in comparison.arms[0].numbers
        if any(arm.numbers[name] is not None for arm in comparison.arms)
    ]
    head = ["arm", "seeds", *(f"final {name}" for name in comparison.arms[0].finals)]
    head += [_heading(name, comparison) for name in used]
    head += [f"seconds to baseline {metric}", f"{metric} gain at equal seconds"]
    rows = [[_cell(text) for text in head], ["---", *["---:"] * (len(head) - 1)]]
    for arm in comparison.arms:
        n = len(arm.runs)
        gain = "baseline" if arm.name == comparison.baseline else _shown(arm.gain, n, sign="+")
        if arm.gain is not None and not arm.paired:
            gain += " (~)"
        rows.append(
            [_cell(arm.name), str(n)]
            + [_shown(stat, n) for stat in arm.finals.values()]
            + [_shown(arm.numbers[x], n, GIB if x == "peak_memory_bytes" else 1.0) for x in used]
            + [_shown(arm.to_baseline, n), gain]
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _heading(name: str, comparison: Comparison) -> str:
    unit = ""
    if name == "peak_memory_bytes":
        kinds = {m[0] for arm in comparison.arms for m in map(memory_of, arm.runs) if m}
        unit = f" ({'/'.join(sorted(kinds))}, GiB)"
    return LABELS.get(name, name) + unit


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _shown(stat: Stat | None, runs: int, unit: float = 1.0, sign: str = "") -> str:
    """Text such as "25.210 ± 0.031": two digits of the deviation; a dash for nothing."""
    if stat is None:
        return "–"
    mean, std = stat.mean / unit, None if stat.std is None else stat.std / unit
    digits = _digits(mean, std)
    text = f"{mean:{sign}.{digits}f}"
    if std is not None:
        text += f" ± {std:.{digits}f}"
    return text if stat.n == runs else f"{text} ({stat.n} of {runs})"


def _digits(mean: float, std: float | None) -> int:
    """Decimals: two digits of the deviation, else four of the mean, at most 4."""
    leading, wanted = (std, 2) if std else (mean, 4)
    if not math.isfinite(leading) or leading == 0:
        return 0 if mean == round(mean, 6) else 3
    return min(4, max(0, wanted - 1 - math.floor(math.log10(abs(leading)))))


def origin_lines(runs: Sequence[Run]) -> list[str]:
    """Command, dates and machines the logs were written with; no host names, no folders."""
    commands = _distinct(run.metadata.get("command") or run.origin.get("command") for run in runs)
    dates = sorted(_distinct(str(run.origin.get("time") or "")[:10] for run in runs))
    machines = _distinct(_machine(run.origin.get("machine")) for run in runs)
    more = f" (and {len(commands) - 1} others)" if len(commands) > 1 else ""
    span = dates[:1] + dates[-1:] if len(dates) > 1 else dates
    lines = [f"Command: {commands[0]}{more}"] if commands else []
    lines += [f"Date: {' to '.join(span)}"] if span else []
    return lines + [f"Machine: {'; '.join(machines)}"] * bool(machines)


def _distinct(texts: Any) -> list[str]:
    return list(dict.fromkeys(str(text) for text in texts if text))


def _machine(machine: Any) -> str:
    if not isinstance(machine, dict):
        return ""
    parts = [machine.get("platform"), machine.get("gpu")]
    return ", ".join([str(part) for part in parts if part] + [f"{machine.get('cpus')} CPUs"])
