"""A report as text: Markdown for people, JSON for programs."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from itertools import repeat
from typing import Any

from opt3dgs_optim.runs.lines import plain
from opt3dgs_optim.runs.read import Run
from opt3dgs_optim.runs.stats import Arm, Comparison, Stat, higher_is_better

HEADINGS = {
    "iterations_per_second": "iterations/s",
    "peak_cuda_bytes": "peak memory (cuda, GiB)",
    "peak_host_bytes": "peak memory (host, GiB)",
}
READING = (
    "Mean ± sample standard deviation over the seeds; (k of n) where not all n runs have the "
    "value. *seconds to baseline*: until the arm first reaches the baseline's mean final value. "
    "*gain*: difference to the baseline at the smaller of the two final times, positive is better; "
    "by pairs of equal seeds where every run has its partner, else (~) between means. Both "
    "interpolate linearly between evaluations."
)


def as_json(comparisons: Sequence[Comparison], runs: Sequence[Run]) -> str:
    """The whole report; statistics are {mean, std, n} or null, NaN is the string "nan"."""
    scenes = []
    for c in comparisons:
        scene = {"scene": c.scene, "metric": c.metric, "baseline": c.baseline, "notes": c.notes}
        scene |= {"higher_is_better": higher_is_better(c.metric), "baseline_final": c.target}
        scenes.append(scene | {"arms": [_arm_object(arm) for arm in c.arms]})
    report = {"format": 1, "origin": origin_lines(runs), "scenes": scenes}
    return json.dumps(plain("report", report), indent=2, allow_nan=False) + "\n"


def _arm_object(arm: Arm) -> dict[str, Any]:
    others = {**arm.numbers, "seconds_to_baseline": arm.to_baseline}
    others["gain_at_equal_seconds"] = arm.gain
    return {
        "arm": arm.name,
        "runs": [{"name": run.name, "seed": run.metadata.get("seed")} for run in arm.runs],
        "final": {name: stat and asdict(stat) for name, stat in arm.finals.items()},
        **{name: stat and asdict(stat) for name, stat in others.items()},
        "gain_paired_by_seed": arm.paired,
    }


def as_markdown(
    comparisons: Sequence[Comparison], runs: Sequence[Run], pictures: Sequence[str]
) -> str:
    """A section a scene: table, picture (all have one, or none), notes; how to read them."""
    parts = ["# Error against run time"]
    for comparison, picture in zip(comparisons, pictures or repeat(None), strict=False):
        if comparison.scene is not None:
            parts.append(f"## {escaped(comparison.scene)}")
        parts.append(_table(comparison))
        if picture:
            metric = escaped(comparison.metric)
            parts.append(f"![{metric} over seconds and iterations]({picture})")
        if comparison.notes:
            parts.append("\n".join(f"- run {escaped(note)}" for note in comparison.notes))
        if comparison.baseline is None:
            parts.append("The baseline arm did not run on this scene: nothing to compare with.")
    parts += [READING, "  \n".join(map(escaped, origin_lines(runs)))]
    return "\n\n".join(part for part in parts if part) + "\n"


def escaped(text: str) -> str:
    """`text` on one line, without a meaning in Markdown or HTML; `_` inside a word has none."""
    text = "".join(c if c.isprintable() else " " for c in text)
    special = r"[\\`*\[\]<>|~&$#]|(?<![^\W_])_|_(?![^\W_])"
    return re.sub(special, lambda found: f"&#{ord(found[0])};", text)


def _table(comparison: Comparison) -> str:
    arms, metric = comparison.arms, comparison.metric
    finals = list(arms[0].finals)
    numbers = dict.fromkeys(name for arm in arms for name, stat in arm.numbers.items() if stat)
    head = ["arm", "seeds", *(f"final {name}" for name in finals)]
    head += [HEADINGS.get(name, re.sub("^mean_", "mean ", name)) for name in numbers]
    head += [f"seconds to baseline {metric}", f"{metric} gain at equal seconds"]
    rows = [[escaped(text) for text in head], ["---", *["---:"] * (len(head) - 1)]]
    for arm in arms:
        n = len(arm.runs)
        gain = "baseline" if arm.name == comparison.baseline else _shown(arm.gain, n, sign="+")
        if arm.gain is not None and not arm.paired:
            gain += " (~)"
        row = [escaped(arm.name), str(n), *(_shown(arm.finals[name], n) for name in finals)]
        for name in numbers:
            unit = 2.0**30 if name.endswith("_bytes") else 1.0
            row.append(_shown(arm.numbers.get(name), n, unit))
        rows.append([*row, _shown(arm.to_baseline, n), gain])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _shown(stat: Stat | None, runs: int, unit: float = 1.0, sign: str = "") -> str:
    """Text such as "25.210 ± 0.031": two digits of the deviation, else four of the mean."""
    if stat is None:
        return "–"
    mean, std = stat.mean / unit, None if stat.std is None else stat.std / unit
    leading, wanted = (std, 2) if std else (mean, 4)
    if not math.isfinite(leading) or leading == 0:
        digits = 0 if mean == round(mean, 6) else 3
    else:
        digits = min(4, max(0, wanted - 1 - math.floor(math.log10(abs(leading)))))
    form = f".{digits}f" if abs(mean) < 1e12 else ".3g"
    text = f"{mean:{sign}{form}}" + ("" if std is None else f" ± {std:{form}}")
    return text if stat.n == runs else f"{text} ({stat.n} of {runs})"


def origin_lines(runs: Sequence[Run]) -> list[str]:
    """Command, dates and machines the logs were written with; no host names, no folders."""
    commands = _distinct(run.metadata.get("command") or run.origin.get("command") for run in runs)
    dates = sorted(_distinct(str(run.origin.get("time") or "")[:10] for run in runs))
    machines = _distinct(_machine(run.origin.get("machine")) for run in runs)
    more = f" (and {len(commands) - 1} others)" if len(commands) > 1 else ""
    said = {
        "Command": "".join(commands[:1]) + more,
        "Date": " to ".join(dates[:1] + dates[1:][-1:]),
    }
    said["Machine"] = "; ".join(machines)
    return [f"{name}: {what}" for name, what in said.items() if what]


def _distinct(texts: Iterable[Any]) -> list[str]:
    return list(dict.fromkeys(str(text) for text in texts if text))


def _machine(machine: Any) -> str:
    parts = [machine.get("platform"), machine.get("gpu")] if isinstance(machine, dict) else []
    cpus = [f"{machine['cpus']} CPUs"] if parts and "cpus" in machine else []
    return ", ".join([str(part) for part in parts if part] + cpus)
