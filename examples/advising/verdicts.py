"""From the pilots' results to gains, verdicts, a table and the settings to paste."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from opt3dgs_optim.annealing import Annealing

PAYS, DOES_NOT, UNDECIDED = "pays", "does not pay", "undecided"
TOO_SHORT = 2.0  # dB: annealing that gains more than this shows how short the pilot was
SMALLEST_GAIN = 0.05  # dB: less is not worth having, however certain


@dataclass(frozen=True)
class Row:
    """One part against its own control, paired by seed."""

    part: str
    control: str
    gain: float  # dB on the held-out views, mean over the seeds
    spread: float | None  # standard deviation over the seeds; None for one seed
    gains: tuple[float, ...]
    milliseconds: float  # per iteration in which it is on, beyond its control's
    bytes_per_point: float  # beyond its control's
    verdict: str


def verdict(gain: float, spread: float | None) -> str:
    """Whether a gain exceeds twice its spread, or is certainly too small to be worth having."""
    if spread is None:
        return UNDECIDED
    if gain > 2 * spread and gain >= SMALLEST_GAIN:
        return PAYS
    return DOES_NOT if gain + 2 * spread < SMALLEST_GAIN else UNDECIDED


def compare(
    part: str,
    control: str,
    runs: Sequence[Mapping[str, Any]],
    controls: Sequence[Mapping[str, Any]],
    *,
    last_phase: bool = False,
) -> Row:
    """One row of the table; `runs` and `controls` in the order of the seeds."""
    gains = [a["psnr"] - b["psnr"] for a, b in zip(runs, controls, strict=True)]
    spread = statistics.stdev(gains) if len(gains) > 1 else None
    keys = ("ms_after_switch",) if last_phase else ("ms_before_switch", "ms_after_switch")

    def extra(key: str) -> float:
        # The median: a machine that does other work as well slows single runs.
        return statistics.median(a[key] - b[key] for a, b in zip(runs, controls, strict=True))

    return Row(
        part,
        control,
        statistics.mean(gains),
        spread,
        tuple(round(gain, 4) for gain in gains),
        statistics.mean(extra(key) for key in keys),
        extra("state_bytes_per_point"),
        verdict(statistics.mean(gains), spread),
    )


def best_peak(rows: Mapping[float, Row]) -> float:
    """The peak with the largest gain among those that pay; 0 where none does."""
    paying = {peak: row.gain for peak, row in rows.items() if row.verdict == PAYS}
    return max(paying, key=lambda peak: paying[peak]) if paying else 0.0


def too_short(peak: float, rows: Sequence[Row]) -> bool:
    """Whether stock rates do not get far enough in the pilot for it to choose a peak."""
    return any(row.part == f"annealing, peak {peak:g}" and row.gain > TOO_SHORT for row in rows)


def settings(peak: float, rows: Sequence[Row], total_steps: int = 30_000) -> str:
    """The call to paste: on is what pays."""
    on = {row.part for row in rows if row.verdict == PAYS}
    last = on & {"reset", "squared loss", "curvature"}
    lines = [f"total_steps={total_steps:_},"]
    # "reset" is the control of the other two: neither was tried without it.
    lines.append("switch=29 / 30," if last else "switch=1.0,  # no last phase")
    lines.append('multiplier="histogram",' if "multiplier" in on else "multiplier=None,")
    lines.append("curvature=CurvatureOptions()," if "curvature" in last else "curvature=None,")
    lines.append(f"squared_loss={'squared loss' in last},")
    lines.append(f"reset_moments={bool(last)},")
    if peak and too_short(peak, rows):
        lines.append("annealing=Annealing(),  # the pilot was too short to choose a peak")
    elif peak:
        lines.append(f"annealing=Annealing(peak={peak:g}, final={Annealing().final:g}),")
    else:
        lines.append("annealing=None,")
    lines.append("fading=Fading()," if "fading" in on else "fading=None,")
    lines.append("pooling=Pooling()," if "pooling" in on else "pooling=None,")
    if {"multiplier", "curvature"} & on:
        lines.append("adaptive=True,")
    imports = ["from opt3dgs_optim import PhaseScheduler"]
    for name, module in (
        ("Annealing", "annealing"),
        ("Fading", "fading"),
        ("CurvatureOptions", "lqnadam"),
        ("Pooling", "pooling"),
    ):
        if any(f"{name}(" in line for line in lines):
            imports.append(f"from opt3dgs_optim.{module} import {name}")
    return "\n".join([*imports, "", "phases = PhaseScheduler(", *(f"    {x}" for x in lines), ")"])


def table(rows: Sequence[Row]) -> str:
    """Markdown."""
    head = (
        "| part | against | gain, dB | spread | ms/iteration | bytes/point | verdict |\n"
        "|---|---|---:|---:|---:|---:|---|"
    )
    return "\n".join([head, *(_line(row) for row in rows)])


def _line(row: Row) -> str:
    spread = "" if row.spread is None else f"{row.spread:.2f}"
    return (
        f"| {row.part} | {row.control} | {row.gain:+.2f} | {spread} | {row.milliseconds:+.2f} | "
        f"{row.bytes_per_point:+.0f} | {row.verdict} |"
    )


def caveats(advice: Mapping[str, Any]) -> list[str]:
    """What the pilots cannot say."""
    options, seeds, views = advice["options"], advice["seeds"], advice["views"]
    said = [
        f"A pilot of {options['iterations']:,} iterations is not a training of 30,000: longer "
        "steps pay most in short trainings. Take the peak as a first guess for a long one.",
        f"{seeds} seeds and {views} held-out views; the spread is the standard deviation over the "
        "seeds of the difference to the control of the same seed.",
        "All parts but the annealing were tried on top of "
        + (f"annealing from {advice['peak']:g}." if advice["peak"] else "stock learning rates."),
    ]
    if too_short(advice["peak"], [as_row(row) for row in advice["rows"]]):
        said.append(
            f"Annealing gained more than {TOO_SHORT:g} dB: in so few iterations stock rates do not "
            "get far, so this shows that the pilot was short, not which peak a long training "
            "needs; the settings take the default. Repeat with more --iterations to choose one."
        )
    elif advice["peak"] == max(advice["peaks"]):
        said.append("The largest peak that was tried won: a larger one may be better still.")
    if any(row["part"] == "noise" and row["verdict"] != PAYS for row in advice["rows"]):
        said.append(
            "The noise acts on nearly transparent Gaussians, of which a pilot has few: leave it "
            "as your trainer has it."
        )
    return said


def as_row(row: Mapping[str, Any]) -> Row:
    """A row from its JSON."""
    return Row(**{**row, "gains": tuple(row["gains"])})


def as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Rows as plain data."""
    return [asdict(row) for row in rows]
