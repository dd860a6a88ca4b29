"""The study's tables, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, stdev

from studies.pages import table
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
    heads = ["arm", "what it is", "against", "scenes, seeds", "dB at equal iterations"]
    heads += ["dB at equal seconds", "dB on training views", "seconds", "verdict"]
    rows = [
        (
            *(f"`{label(g.arm)}`", STUDY_ARMS[g.arm].what, f"`{label(g.control)}`"),
            *(f"{len(g.scenes)}, {g.seeds}", f"{g.equal_iterations:+.2f}", _gain_and_spread(g)),
            *(f"{g.train:+.2f}", f"x{g.seconds:.2f}", g.verdict),
        )
        for g in gains
    ]
    return table(heads, "llllrrrrl", rows)


def scenes_table(study: Study, settings: Sequence[Setting], arms: Sequence[str]) -> str:
    """Test PSNR of every arm on every scene; the last columns are means over the scenes."""
    rows = []
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
        rows.append((f"`{label(arm)}`", *cells, ssim, shown, f"{state:.0f}", peak))
    names = (setting.scene for setting in settings)
    more = ("SSIM", "LPIPS", "state, bytes per point", "peak memory, MB")
    return table(["arm", *names, *more], "lr", rows)


def goals_table(study: Study, kinds: dict[str, list[Setting]], arm: str, control: str) -> str:
    """The gain in long trainings, and when the control's last PSNR is reached."""
    rows = []
    for name, settings in kinds.items():
        gain = study.gain(settings, arm, control)
        if gain is None:
            continue
        reach = "not on every scene" if gain.reach is None else f"x{gain.reach:.2f}"
        before = f"{gain.psnr - gain.equal_iterations:.2f}"
        gains = f"{gain.equal_iterations:+.2f}", _gain_and_spread(gain)
        rows.append((name, f"{', '.join(gain.scenes)}; {gain.seeds}", before, *gains, reach))
    heads = ["training", "scenes, seeds", "control, dB", "gain at equal iterations"]
    heads += ["gain at equal seconds", "seconds until the control's last PSNR"]
    return table(heads, "llr", rows)


def front_table(
    study: Study, kinds: dict[int, list[Setting]], rows: Sequence[tuple[str, str, str]]
) -> str:
    """Gains at equal seconds by length of the training, and scenes below the control.

    Args:
        kinds: the settings of each length, by its iterations.
        rows: (what it is, arm, control); the first one's scenes are counted.
    """
    made = []
    for what, arm, control in rows:
        gains = [study.gain(settings, arm, control) for settings in kinds.values()]
        made.append((what, *("-" if g is None else f"{_gain_and_spread(g)} dB" for g in gains)))
    _, arm, control = rows[0]
    shares = [[study.gain([s], arm, control) for s in settings] for settings in kinds.values()]
    behind = [
        f"{sum(g.equal_seconds < 0 for g in found if g)} of {sum(g is not None for g in found)}"
        for found in shares
    ]
    made.insert(1, ("scenes on which they end below stock", *behind))
    return table(["iterations", *(f"{n:,}" for n in kinds)], "lr", made)


def _gain_and_spread(gain: Gain) -> str:
    """At equal seconds; one seed has no spread."""
    spread = f" ± {gain.spread:.2f}" if gain.seeds > 1 else ""
    return f"{gain.equal_seconds:+.2f}{spread}"


def _mean_and_spread(values: Sequence[float]) -> str:
    if not values:
        return "-"
    spread = f" ± {stdev(values):.2f}" if len(values) > 1 else ""
    return f"{fmean(values):.2f}{spread}"
