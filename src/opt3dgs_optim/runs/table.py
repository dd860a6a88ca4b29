"""A report as text, in Markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from opt3dgs_optim.runs.read import Run
from opt3dgs_optim.runs.stats import Comparison, Stat

READING = (
    "Mean ± sample standard deviation over the seeds; (k of n) where not all n runs have the "
    "value. *seconds to baseline*: until the arm first reaches the baseline's mean final value. "
    "*gain*: difference to the baseline's run of the same seed at the smaller of the two final "
    "times, positive is better. Both interpolate linearly between evaluations."
)


def as_markdown(
    comparisons: Sequence[Comparison], runs: Sequence[Run], pictures: Sequence[str]
) -> str:
    """A section a scene: table and picture (all have one, or none); how to read them."""
    parts = ["# Error against run time"]
    for i, comparison in enumerate(comparisons):
        if comparison.scene is not None:
            parts.append(f"## {escaped(comparison.scene)}")
        parts.append(_table(comparison))
        if pictures:
            metric = escaped(comparison.metric)
            parts.append(f"![{metric} over seconds and iterations]({pictures[i]})")
        if comparison.baseline is None:
            parts.append("The baseline arm did not run on this scene: nothing to compare with.")
    return "\n\n".join([*parts, READING, escaped(origin(runs))]).rstrip() + "\n"


def escaped(text: str) -> str:
    """`text` on one line, without a meaning in Markdown or HTML; `_` inside a word has none."""
    text = "".join(c if c.isprintable() else " " for c in text)
    special = r"[\\`*\[\]<>|~&$#]|(?<![^\W_])_|_(?![^\W_])"
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
