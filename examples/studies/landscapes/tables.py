"""The tables of docs/landscapes.md, from the results' files."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from typing import Any

from studies.pages import table

Results = dict[str, Any]


def spread(values: Sequence[float], digits: int) -> str:
    """Mean and standard deviation over seeds."""
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return f"{statistics.fmean(values):.{digits}f} ± {deviation:.{digits}f}"


def column(seeds: list[Results], name: str, digits: int, unit: float = 1.0) -> str:
    """One figure of every seed; "-" where a seed has none."""
    values = [seed[name] for seed in seeds]
    return "-" if None in values else spread([value / unit for value in values], digits)


def nine(results: Results) -> str:
    """Modes, iterations and KL of every arm on the nine-mode landscape."""
    header = ["method", "steps", "modes of 9", "chains with all 9 (%)"]
    header += ["median steps to all 9 (1,000)", "KL of the visits", "KL, re-weighted", "mean nu"]
    rows = []
    for name, entry in results.items():
        if not name.startswith("nine-"):
            continue
        result, seeds = entry["result"], entry["result"]["seeds"]
        arm = result["arm"]
        weighed = arm["nu"] == "histogram" or (arm["nu"] == "constant" and arm["drift"] == "none")
        rows.append(
            [
                arm["label"],
                f"{entry['settings']['steps']:,}",
                column(seeds, "modes", 2),
                column(seeds, "share_all", 0, 0.01),
                column(seeds, "median_iterations", 1, 1000),
                column(seeds, "kl_raw", 3),
                column(seeds, "kl", 3) if weighed else "",
                f"{result['mean_nu']:.2f}",
            ]
        )
    return table(header, "lr", rows)


def gaussian(results: Results) -> str:
    """Variances of the Gaussian against theory."""
    labels = {"gaussian-sgld": "plain drift", "gaussian-adam": "Adam drift"}
    labels["gaussian-adam-slow"] = "Adam drift"
    rows = []
    for name, label in labels.items():
        if name not in results:
            continue
        betas = results[name]["settings"]["betas"]
        title = label if label == "plain drift" else f"{label}, betas {betas[0]:g}, {betas[1]:g}"
        result = results[name]["result"]
        for row in result["rows"]:
            error = statistics.fmean(row["variance"]) / row["expected"] - 1
            figures = [f"{row['lr']:g}", spread(row["variance"], 4), f"{row['expected']:.4f}"]
            rows.append([title, *figures, f"{100 * error:+.1f} %"])
    header = ["drift", "lr", "variance", "theory", "off theory"]
    return table(header, "lr", rows)


def well(results: Results) -> str:
    """How close the double well's law is, and whether the wells are in balance."""
    rows = []
    for name, entry in results.items():
        if not name.startswith("well-"):
            continue
        result = entry["result"]
        flat = result["arm"] == "awsgld"
        rows.append(
            [
                f"{result['height']:g}",
                "AWSGLD" if flat else "SGLD",
                spread(result["kl_raw"], 4),
                spread(result["kl"], 4) if flat else "",
                spread([100 * share for share in result["left"]], 1),
            ]
        )
    rows.sort(key=lambda row: float(row[0]))
    header = ["h / T", "method", "KL of the visits", "KL, re-weighted", "left well (%; exact 50)"]
    return table(header, "lr", rows)


def escape(results: Results) -> str:
    """Escape rates against Kramers', the exact ones, and what theory says of the multiplier."""
    flat = {row["height"]: row for row in results["escape-awsgld"]["result"]["rows"]}
    rows = []
    for row in results["escape-sgld"]["result"]["rows"]:
        other = flat[row["height"]]
        gain = statistics.fmean(other["rate"]) / row["exact"]
        rows.append(
            [
                f"{row['height']:g}",
                f"{row['exact']:.4f}",
                spread(row["rate"], 4),
                spread(other["rate"], 3),
                f"{gain:.1f}",
                f"{other['mean_nu']:.2f}",
                f"{other['constant']:.3f}",
            ]
        )
    header = ["h / T", "exact", "SGLD", "AWSGLD", "AWSGLD / exact"]
    header += ["mean nu", "constant nu of that mean, exact"]
    return table(header, "lr", rows)


def about(results: Results) -> str:
    """What made the tables, and what it cost."""
    entries = [entry["about"] for entry in results.values()]
    minutes = sum(entry["cpu_seconds"] for entry in entries) / 60
    dates = sorted({entry["date"] for entry in entries})
    when = dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    seeds = {entry["settings"]["seeds"] for entry in results.values()}
    return (
        f"Made by `{entries[0]['command']}` on {when}: {entries[0]['machine']}, "
        f"{minutes:.0f} CPU minutes; ± is the standard deviation over {min(seeds)} seeds."
    )


def sections(results: Results) -> dict[str, str]:
    """Every table by the name of its marker in the page."""
    makers = {"about": about, "nine": nine, "gaussian": gaussian, "well": well, "escape": escape}
    return {name: make(results) for name, make in makers.items()}
