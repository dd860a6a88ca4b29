"""The study's tables, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, stdev

from studies.scenes.analysis import Gain, Study
from studies.scenes.arms import STUDY_ARMS, label
from studies.scenes.records import Record, Setting


def machines_line(records: Sequence[Record]) -> str:
    """How many trainings ran on which machine, and when."""
    days: dict[str, list[str]] = {}
    for record in records:
        days.setdefault(record.machine, []).append(record.date)
    said = []
    for machine, dates in days.items():
        first, last = min(dates), max(dates)
        when = first if first == last else f"{first} to {last}"
        count = "1 training" if len(dates) == 1 else f"{len(dates):,} trainings"
        said.append(f"{count}, {when}: {machine}, one thread each.")
    return "\n".join(said)


def gains_table(gains: Sequence[Gain]) -> str:
    """One line per arm: what it gains over its control, and the rule's verdict."""
    lines = [
        "| arm | what it is | against | scenes, seeds | dB at equal iterations "
        "| dB at equal seconds | dB on training views | seconds | verdict |",
        "|---|---|---|---|---:|---:|---:|---:|---|",
    ]
    for g in gains:
        lines.append(
            f"| `{label(g.arm)}` | {STUDY_ARMS[g.arm].what} | `{label(g.control)}` "
            f"| {len(g.scenes)}, {g.seeds} | {g.equal_iterations:+.2f} | {_gain_and_spread(g)} "
            f"| {g.train:+.2f} | x{g.seconds:.2f} | {g.verdict} |"
        )
    return "\n".join(lines)


def scenes_table(study: Study, settings: Sequence[Setting], arms: Sequence[str]) -> str:
    """Test PSNR of every arm on every scene; the last columns are means over the scenes."""
    names = [setting.scene for setting in settings]
    lines = [
        f"| arm | {' | '.join(names)} | SSIM | LPIPS | state, bytes per point | peak memory, MB |",
        f"|---|{'---:|' * (len(names) + 4)}",
    ]
    for arm in arms:
        runs = [list(study.runs(setting, arm).values()) for setting in settings]
        if not any(runs):
            continue
        cells = [_mean_and_spread([r.final for r in of_scene]) for of_scene in runs]
        every = [record for of_scene in runs for record in of_scene]
        complete = all(runs)
        ssim = f"{fmean(r.curve['ssim'][-1] for r in every):.4f}" if complete else "-"
        lpips = [r.lpips for r in every if r.lpips is not None]
        shown = f"{fmean(lpips):.4f}" if complete and len(lpips) == len(every) else "-"
        state = fmean(r.state_bytes / r.curve["num_points"][-1] for r in every)
        peak = f"{fmean(r.peak_rss_bytes for r in every) / 1e6:.0f}"
        row = [f"`{label(arm)}`", *cells, ssim, shown, f"{state:.0f}", peak]
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


def goals_table(study: Study, kinds: dict[str, list[Setting]], arm: str, control: str) -> str:
    """The gain in long trainings, and when the control's last PSNR is reached."""
    lines = [
        "| training | scenes, seeds | control, dB | gain at equal iterations "
        "| gain at equal seconds | seconds until the control's last PSNR |",
        "|---|---|---:|---:|---:|---:|",
    ]
    for name, settings in kinds.items():
        gain = study.gain(settings, arm, control)
        if gain is None:
            continue
        reach = "not on every scene" if gain.reach is None else f"x{gain.reach:.2f}"
        lines.append(
            f"| {name} | {', '.join(gain.scenes)}; {gain.seeds} "
            f"| {gain.psnr - gain.equal_iterations:.2f} | {gain.equal_iterations:+.2f} "
            f"| {_gain_and_spread(gain)} | {reach} |"
        )
    return "\n".join(lines)


def front_table(
    study: Study, kinds: dict[int, list[Setting]], rows: Sequence[tuple[str, str, str]]
) -> str:
    """The README's: gains at equal seconds by length of the training, and scenes below the control.

    Args:
        kinds: the settings of each length, by its iterations.
        rows: (what it is, arm, control); the first one's scenes are counted.
    """
    lines = [
        f"| iterations | {' | '.join(f'{n:,}' for n in kinds)} |",
        f"|---|{'---:|' * len(kinds)}",
    ]
    for what, arm, control in rows:
        gains = [study.gain(settings, arm, control) for settings in kinds.values()]
        cells = ["-" if gain is None else f"{_gain_and_spread(gain)} dB" for gain in gains]
        lines.append(f"| {what} | {' | '.join(cells)} |")
    what, arm, control = rows[0]
    shares = [[study.gain([s], arm, control) for s in settings] for settings in kinds.values()]
    behind = [
        f"{sum(g.equal_seconds < 0 for g in found if g)} of {sum(g is not None for g in found)}"
        for found in shares
    ]
    lines.insert(3, f"| scenes on which they end below stock | {' | '.join(behind)} |")
    return "\n".join(lines)


def _gain_and_spread(gain: Gain) -> str:
    """At equal seconds; one seed has no spread."""
    spread = f" ± {gain.spread:.2f}" if gain.seeds > 1 else ""
    return f"{gain.equal_seconds:+.2f}{spread}"


def _mean_and_spread(values: Sequence[float]) -> str:
    if not values:
        return "-"
    spread = f" ± {stdev(values):.2f}" if len(values) > 1 else ""
    return f"{fmean(values):.2f}{spread}"
