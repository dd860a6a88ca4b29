"""The study's tables, as Markdown: PSNR, SSIM and LPIPS side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from statistics import fmean

from studies.pages import table
from studies.scenes.analysis import METRICS, Difference, Study, difference
from studies.scenes.arms import (
    ADAPTIVE,
    ADAPTIVE_DEFAULTS,
    ADAPTIVE_OWN_FRAME,
    BASELINE,
    DEFAULTS,
    OWN_FRAME_ARM,
    arm_of,
)
from studies.scenes.decisions import (
    FULL,
    HALF,
    MANY_VIEWS_SCENES,
    PIECES,
    QUARTER,
    decide,
    settings_of,
)
from studies.scenes.records import MISPOSED, Costs, Plain, Record, Setting

SIZES = {QUARTER: "quarter", HALF: "half", FULL: "full"}
# How pages that are read without the list of variants name them.
LABELS = {
    BASELINE: "3DGS-MCMC",
    DEFAULTS: "the defaults",
    "paper": "the paper's preset",
    "faded": "3DGS-MCMC with `Fading`",
    OWN_FRAME_ARM: "with `OwnFrame`",
    "faded+out-of-view+averaged": "the defaults",
    ADAPTIVE: "gsplat's `DefaultStrategy`",
    "adc+annealed+faded": "with `Annealing` and `Fading`",
    ADAPTIVE_DEFAULTS: "with `DEFAULTS_ADC`",
    ADAPTIVE_OWN_FRAME: "with `OwnFrame` and `Averaging`",
}
CONSTANT = "a constant multiplier of equal mean"
PAPER = (  # what the pages say of the paper's parts: the part, what without it, and their arms
    ("AW-SGLD, this package's form", CONSTANT, "awsgld-stable", "awsgld-stable-constant"),
    ("AW-SGLD, the paper's settings", CONSTANT, "paper", "paper-constant"),
    ("L2 loss in the last thirtieth", "3DGS-MCMC", "l2@1/30", BASELINE),
    ("fresh moments in the last thirtieth", "3DGS-MCMC", "l1+reset@1/30", BASELINE),
    ("L2 loss and fresh moments there", "3DGS-MCMC", "l2+reset@1/30", BASELINE),
    (
        "L-BFGS directions in the last thirtieth",
        "L2 loss and fresh moments there",
        "l2+reset+lqn@1/30",
        "l2+reset@1/30",
    ),
    ("all of them, the paper's preset", "3DGS-MCMC", "paper", BASELINE),
)
LOOKS = 60  # at the training PSNR, of each record of `falls_table`
FACTORS = (0.1, 0.3, 1.5, 2.0, 3.0, 10.0)  # on learning rates, of `tuned_table`
TUNED = {
    **{f"rates-x{k:g}": f"3DGS-MCMC, all steps times {k:g}" for k in FACTORS},
    **{f"positions-x{k:g}": f"3DGS-MCMC, the positions' steps times {k:g}" for k in FACTORS},
}
OURS = {  # the last lines of `tuned_table`
    "**`Fading` alone**, learning rates as published": "faded",
    "**the defaults**, learning rates as published": DEFAULTS,
    "with `OwnFrame`, learning rates as published": OWN_FRAME_ARM,
}


def label(arm: str) -> str:
    """What an arm is called beside text that explains it; its own name where it has no other."""
    return LABELS.get(arm) or TUNED.get(arm, f"`{arm}`")


def counted(count: int, what: str) -> str:
    """As "1 seed" or "1,000 seeds"."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def machines_line(records: Sequence[Record]) -> str:
    """How many trainings ran on which machine, and when."""
    days: dict[str, list[str]] = {}
    for record in records:
        days.setdefault(record.machine, []).append(record.date)
    said = []
    for machine, dates in days.items():
        first, last = min(dates), max(dates)
        when = first if first == last else f"{first} to {last}"
        said.append(f"{counted(len(dates), 'training')}, {when}: {machine}, one thread each.")
    return "\n".join(said)


def arms_table(study: Study, settings: Sequence[Setting]) -> str:
    """One line per arm: what it is, against what it is measured, and in how many trainings."""
    rows = []
    for name in study.arms(settings):
        arm, count = arm_of(name), sum(len(study.runs(setting, name)) for setting in settings)
        rows.append((f"`{name}`", arm.what, f"`{arm.control}`", count))
    return table(("variant", "what it is", "compared with", "trainings"), "lllr", rows)


def differences_table(study: Study, settings: Sequence[Setting], arms: Iterable[str]) -> str:
    """One line per arm that has been trained: what it gains over its control."""
    rows = []
    for found in (difference(study, settings, arm) for arm in arms):
        if found.count and found.arm != found.control:
            names = f"`{found.arm}`", f"`{found.control}`"
            cost = _cost_of(study, found)
            rows.append((*names, counts_of(found), *cells_of(found), cost, found.verdict))
    names, metrics = ("variant", "compared with"), ("PSNR", "SSIM", "LPIPS")
    heads = (*names, "scenes, trainings", *metrics, "time of an iteration, ratio", "by the rule")
    return table(heads, "lllrrrrl", rows)


def costs_table(costs: Costs, arms: Sequence[str]) -> str:
    """One line per kind of training: the time of an iteration of each arm, as the baseline's share.

    `arms` are shown as far as they were measured anywhere.
    """
    shown = [arm for arm in arms if any(key[-1] == arm for key in costs)]
    rows = []
    for scene, size, iterations, pieces, degree in sorted({key[:-1] for key in costs}):
        found = [costs.get((scene, size, iterations, pieces, degree, arm)) for arm in shown]
        about = f"{SIZES[size]}{f', degree {degree}' * (degree > 0)}"
        about += f", {pieces} pieces" * (pieces > 0)
        cells = ["-" if share is None else f"{share:.2f}" for share in found]
        if any(share is not None for share in found):
            rows.append((scene, about, f"{iterations:,}", *cells))
    return table(("scene", "images", "iterations", *map(label, shown)), "llr", rows)


def _cost_of(study: Study, found: Difference) -> str:
    """The time of an iteration, as the control's share; a dash where it was not measured."""
    every = [pair[0].setting for pairs in found.pairs.values() for pair in pairs]
    known = [study.measured_cost(setting, found.arm, found.control) for setting in every]
    return "-" if None in known else f"{found.cost:.2f}"


def counts_of(found: Difference) -> str:
    """Scenes and trainings, with a mark where bonsai has its wrong poses."""
    return f"{len(found.pairs)}, {found.count}{' †' * (MISPOSED in found.pairs)}"


def cells_of(found: Difference) -> list[str]:
    """What is gained in the three metrics when the first of the two has finished."""
    return [_signed(*found.of(metric), digits) for metric, (_, digits) in METRICS.items()]


def metrics_table(
    study: Study,
    settings: Sequence[Setting],
    arms: Iterable[str],
    *,
    head: Callable[[Setting], str] = lambda setting: setting.scene,
    seed: int | None = None,
    plain: bool = False,
) -> str:
    """PSNR / SSIM / LPIPS of every arm in every setting that has one of them.

    Args:
        head: what stands above a setting's column.
        seed: of this one, with the last number of Gaussians, which differs; None: means over all.
        plain: name the arms by `LABELS`.
    """
    named = [*arms]  # read for every setting
    columns = {
        setting: [
            [r for key, r in study.runs(setting, arm).items() if seed in (None, key)]
            for arm in named
        ]
        for setting in settings
    }
    columns = {setting: found for setting, found in columns.items() if any(found)}
    rows = []
    for arm, *found in zip(named, *columns.values(), strict=True):
        if any(found):
            cells = [_cell(records, gaussians=seed is not None) for records in found]
            rows.append((label(arm) if plain else f"`{arm}`", *cells))
    first = "training" if plain else "variant"
    return table([first, *map(head, columns)], "l", rows)


def averaging_line(study: Study) -> str:
    """In how many trainings of the baseline, and of all variants, the last iterates' mean gained.

    A training and the same one with its mean have the first 29/30 in common, bit for bit.
    """
    found = [
        (trunk, [sign * (a.curve[m][-1] - b.curve[m][-1]) for m, (sign, _) in METRICS.items()])
        for setting in study.settings()
        for arm in study.arms([setting])
        if (trunk := arm_of(arm).averages) is not None
        for pairs in difference(study, [setting], arm, trunk).pairs.values()
        for a, b, _ in pairs
    ]
    alone = [gains for name, gains in found if name == BASELINE]
    psnr = [gains[0] for _, gains in found]
    return (
        f"Added to 3DGS-MCMC alone it gained PSNR, SSIM and LPIPS in "
        f"{sum(min(gains) > 0 for gains in alone)} of {len(alone)} trainings. Added to any variant "
        f"it gained PSNR in {sum(gain > 0 for gain in psnr)} of {len(psnr)}, "
        f"and changed it by {min(psnr):+.2f} dB at worst."
    )


def headline_table(study: Study, sizes: Iterable[Sequence[Setting]]) -> str:
    """The baseline beside the defaults at each size: what a reader sees first.

    Means over the seeds that both have, since a seed has held-out views of its own. Other arms
    stand beside where they have all of these trainings: the best of other learning rates, OwnFrame.

    Args:
        sizes: the settings at each size. Those of the last have all scenes; a scene that another
            size lacks has a dash there.
    """
    every = [list(settings) for settings in sizes]
    rows, scenes = [], [setting.scene for setting in every[-1]] if every else []
    for settings in every:
        seeds = {
            setting: sorted(study.runs(setting, BASELINE).keys() & study.runs(setting, DEFAULTS))
            for setting in settings
        }
        both = [setting for setting, of in seeds.items() if of]
        found = {
            arm: {
                setting.scene: [runs[seed] for seed in seeds[setting] if seed in runs]
                for setting in both
                for runs in [study.runs(setting, arm)]
            }
            for arm in (BASELINE, *TUNED, DEFAULTS, OWN_FRAME_ARM)
        }
        count = sum(len(seeds[setting]) for setting in both)
        whole = [arm for arm, of in found.items() if count and sum(map(len, of.values())) == count]
        tuned = [arm for arm in whole if arm in TUNED]
        psnr = {
            arm: fmean(fmean(r.final for r in of) for of in found[arm].values()) for arm in tuned
        }
        best = max(tuned, key=psnr.__getitem__, default=None)
        about = _size_of(both, [len(seeds[setting]) for setting in both]) if both else ""
        for arm in whole:
            if arm not in TUNED or arm == best:
                what = label(arm)
                cells = [_cell(found[arm].get(scene, []), seeds=False) for scene in scenes]
                rows.append((about, f"**{what}**" if arm == DEFAULTS else what, *cells))
                about = about.partition(":")[0]
    return table(["size", "training", *scenes], "l", rows)


def _size_of(settings: Sequence[Setting], seeds: Sequence[int]) -> str:
    """As "half: 50,000 Gaussians, 3 seeds"."""
    first, count = settings[0], _each(seeds)
    about = f"{SIZES.get(first.size, first.size)}: {_each(s.points for s in settings)} Gaussians"
    about += f", degree {first.sh_degree}" * (first.sh_degree > 0)
    return f"{about}, {count} {'seed' if count == '1' else 'seeds'}"


def _each(numbers: Iterable[int]) -> str:
    """A number, or those of each scene, in the columns' order, where they differ."""
    every = [f"{number:,}" for number in numbers]
    return every[0] if len(set(every)) == 1 else " / ".join(every)


def scenes_gain_table(study: Study, settings: Sequence[Setting], arm: str, control: str) -> str:
    """One line per scene and size: control and arm at their ends, and the gain at equal seconds.

    All over the seeds that both have.
    """
    rows = []
    for setting in settings:
        found = difference(study, [setting], arm, control)
        for pairs in found.pairs.values():
            stock, ours = _cell([b for _, b, _ in pairs]), _cell([a for a, _, _ in pairs])
            rows.append((setting.scene, crowd(setting), stock, ours, cells_of(found)[0]))
    names = label(control), label(arm)
    return table(("scene", "Gaussians, images", *names, "gain in PSNR, dB"), "llllr", rows)


def sizes_table(study: Study, sizes: Sequence[Sequence[Setting]], arms: Iterable[str]) -> str:
    """One line per scene and arm: what it gains over the baseline at its end, at every size.

    PSNR / SSIM / LPIPS, means over the seeds that both have.

    Args:
        sizes: the settings at each size, smallest first.
    """
    named = [*arms]  # read for every scene
    rows = []
    for scene in MANY_VIEWS_SCENES:
        for arm in named:
            cells = [
                _gain_at_end(
                    difference(study, [s for s in size if s.scene == scene], arm, BASELINE)
                )
                for size in sizes
            ]
            if any(cell != "-" for cell in cells):
                rows.append((scene, label(arm), *cells))
    names = [SIZES[QUARTER], SIZES[HALF], SIZES[FULL]]
    return table(("scene", "training", *names), "llrrr", rows)


def _gain_at_end(found: Difference) -> str:
    pairs = [pair for pairs in found.pairs.values() for pair in pairs]
    if not pairs:
        return "-"
    gains = [
        _signed(fmean(a.curve[m][-1] - b.curve[m][-1] for a, b, _ in pairs), math.nan, digits)
        for m, digits in (("psnr", 2), ("ssim", 3), ("lpips", 3))
    ]
    return f"{' / '.join(gains)} ({counted(len(pairs), 'seed')})"


def reach_table(study: Study, long: Sequence[Setting], arm: str, shorter: Sequence[int]) -> str:
    """When an arm has the PSNR that the baseline has after its last iteration, in its time.

    Args:
        shorter: lengths of trainings that were that long from their start, whose last PSNR stands
            beside; all at the first length's cost of an iteration.
    """
    total, rows = long[0].iterations if long else 0, []
    for setting in long:
        base, runs = study.runs(setting, BASELINE), study.runs(setting, arm)
        found = difference(study, [setting], arm, BASELINE)
        for pairs in found.pairs.values():
            # The iterates, of an arm that ends at their mean.
            reached = [runs[ours.seed].reached(theirs.final) for ours, theirs, _ in pairs]
            known = [iteration for iteration in reached if iteration is not None]
            said, beside = "never", []
            if len(known) == len(reached):
                said = f"{fmean(known) * found.cost / total:.0%} of the time"
            cost = study.cost(replace(setting, iterations=shorter[0]), arm)
            for count in shorter:
                quick = study.runs(replace(setting, iterations=count), arm)
                gains = [quick[s].final - base[s].final for s in quick.keys() & base.keys()]
                share = count / total * cost
                text = f"{fmean(gains):+.2f} dB in {share:.0%} of the time" if gains else "-"
                beside.append(text)
            seeds = counted(len(pairs), "seed")
            ends = f"{fmean(theirs.final for _, theirs, _ in pairs):.2f} dB ({seeds})"
            rows.append((setting.scene, ends, said, *beside))
    first = f"{LABELS[BASELINE]}, {total:,} iterations"
    heads = ["scene", first, f"{label(arm)} have that PSNR after"]
    return table([*heads, *(f"trained for {n:,} iterations only" for n in shorter)], "l", rows)


def tuned_table(
    study: Study, columns: Sequence[Sequence[Setting]], own: Setting, *, brief: bool = False
) -> str:
    """What 3DGS-MCMC gains in PSNR by a factor on its learning rates, beside this package.

    At equal seconds; other rates are taken to cost the same.

    Args:
        columns: the settings of a column each, where a factor multiplies the steps; those without
            such trainings are left out.
        own: one of which other rates of the trainer itself were tried: the last column.
        brief: only factors above 1, for the README.
    """
    factors = [k for k in FACTORS if k > 1 or not brief]
    every = {what: arm for arm, what in TUNED.items() if float(arm.partition("-x")[2]) in factors}
    found, base = [], study.runs(own, BASELINE)
    for settings in columns:
        if settings:
            kind = "scene" if settings[0].rotated else "small scene"
            tuned = {
                what: difference(study, settings, arm, BASELINE) for what, arm in every.items()
            }
            found.append(_tuned_column(study, settings, kind, tuned))
    pairs = {}
    for k in factors:
        runs = study.runs(replace(own, rates=k), BASELINE)
        both = [(runs[seed], base[seed], 1.0) for seed in sorted(runs.keys() & base.keys())]
        same = Difference(BASELINE, BASELINE, {own.scene: both} if both else {})
        pairs[TUNED[f"rates-x{k:g}"]] = same
    found = [column for column in [*found, _tuned_column(study, [own], own.scene, pairs)] if column]
    rows = [("3DGS-MCMC as published", *["0"] * len(found))]
    for what in (*every, *OURS):
        cells = [cells.get(what, "-") for _, cells in found]
        if set(cells) != {"-"}:
            rows.append((what, *cells))
    return table(["training", *(head for head, _ in found)], "l" + "r" * len(found), rows)


def _tuned_column(
    study: Study, settings: Sequence[Setting], kind: str, tuned: dict[str, Difference]
) -> tuple[str, dict[str, str]] | None:
    """Head and cells of a column of `tuned_table`; None where nothing was tried.

    Those trainings count whose scene and seed were tried with other rates. A cell that has fewer
    of them than its column says how many.
    """
    every = [found.pairs.items() for found in tuned.values()]
    tried = {(scene, p[0].seed) for found in every for scene, pairs in found for p in pairs}
    ours = {what: difference(study, settings, arm, BASELINE) for what, arm in OURS.items()}
    cells = {}
    for what, found in (tuned | ours).items():
        of = {s: [p for p in pairs if (s, p[0].seed) in tried] for s, pairs in found.pairs.items()}
        kept = replace(found, pairs={scene: pairs for scene, pairs in of.items() if pairs})
        if kept.count:
            fewer = f" ({counted(kept.count, 'training')})" * (kept.count < len(tried))
            cells[what] = cells_of(kept)[0] + fewer
    scenes = len({scene for scene, _ in tried})
    what = kind if len(settings) == 1 and kind == settings[0].scene else counted(scenes, kind)
    if settings[0].size == "images_2":
        what += ", half size"
    head = f"{what}, {settings[0].iterations:,} iterations, {counted(len(tried), 'training')}"
    return (head, cells) if tried else None


def falls_table(records: Sequence[Plain]) -> str:
    """How far trainings fall with two forms of nu and without: the worst of a scene's seeds.

    Args:
        records: of docs/results/histogram/collapse.json, whose code is gone.
    """
    forms = {
        "stock": "3DGS-MCMC, no ν",
        "frozen": "range measured once (until 2026-11-22)",
        "default": "range follows the energy (today)",
    }
    by_scene: dict[str, list[Plain]] = {}
    for record in sorted(records, key=lambda r: (r["scene"], r["seed"])):
        by_scene.setdefault(record["scene"], []).append(record)
    rows = []
    for scene, every in by_scene.items():
        cells, ends = [], []
        for form in forms:
            of = [record for record in every if record["arm"] == form]
            fall, looks = (max(r[key] for r in of) for key in ("largest_fall", "looks_below_1_db"))
            clamped = [r["at_clamp"] for r in of if "at_clamp" in r]
            share = f", {max(clamped):.1%}" if clamped else ""
            seeds = f" ({counted(len(of), 'seed')})" * (len(of) > 1)
            cells.append(f"{fall:.2f} dB, {looks} of {LOOKS}{share}{seeds}")
            ends.append(f"{of[0]['psnr']:.2f}")
        rows.append((f"{scene}, {every[0]['iterations']:,}", *cells, " / ".join(ends)))
    return table(("scene, iterations", *forms.values(), "test PSNR, seed 0"), "l", rows)


def decisions_table(study: Study, beside: int) -> str:
    """One line per part: what it was judged by, whether it is on; the PSNR of shorter trainings.

    Args:
        beside: length of these.
    """
    rows = []
    for part, decision in decide(study).items():
        by = f"`{decision.arm}` and `{decision.control}`"
        found, shown = decision.found, ["-"] * 6
        if found is not None:
            size = SIZES[decision.size]
            shown = [size, f"{decision.iterations:,}", counts_of(found), *cells_of(found)]
        on = "on" if decision.on else "off"
        brief = settings_of(study, beside, PIECES.get(part, 0))
        shorter = difference(study, brief, decision.arm, decision.control)
        short = cells_of(shorter)[0] if len(shorter.pairs) == len(MANY_VIEWS_SCENES) else "-"
        rows.append((part, f"{on} ({decision.verdict})", by, *shown, short))
    heads = (
        "part",
        "default",
        "decided by comparing",
        "images",
        "iterations",
        "scenes, trainings",
        "PSNR",
        "SSIM",
        "LPIPS",
        f"PSNR at {beside:,}",
    )
    return table(heads, "llllrlrrrr", rows)


def paper_table(study: Study, settings: Sequence[Setting], *, brief: bool = False) -> str:
    """One line per part of the paper: what it gains over the same training without it.

    Args:
        brief: the PSNR alone, for the README.
    """
    rows = []
    for part, without, arm, control in PAPER:
        found = difference(study, settings, arm, control)
        if found.count:
            psnr, *others = cells_of(found)
            rows.append((part, without, counts_of(found), psnr, *([] if brief else others)))
    heads = ("part", "compared with", "scenes, trainings", "PSNR, dB")
    return table(heads if brief else (*heads, "SSIM", "LPIPS"), "lllr", rows)


def _cell(records: Sequence[Record], *, gaussians: bool = False, seeds: bool = True) -> str:
    if not records:
        return "-"
    values = [fmean(float(r.curve[m][-1]) for r in records) for m in METRICS]
    psnr, ssim, lpips = values
    of = f" ({len(records)} seeds)" if seeds and len(records) > 1 else ""
    if seeds and len(records) == 1 and records[0].seed:
        of = f" (seed {records[0].seed})"
    count = fmean(float(r.curve["num_points"][-1]) for r in records)
    beside = f", {count:,.0f} Gaussians" if gaussians else ""
    return f"{psnr:.2f} / {ssim:.3f} / {lpips:.3f}{beside}{of}"


def crowd(setting: Setting) -> str:
    """The most Gaussians, the images' size, and the harmonics' degree."""
    degree = f", degree {setting.sh_degree}" * (setting.sh_degree > 0)
    return f"{setting.points:,}, {SIZES.get(setting.size, setting.size)}{degree}"


def _signed(mean: float, spread: float, digits: int) -> str:
    if math.isnan(mean):
        return "-"
    around = "" if math.isnan(spread) else f" ± {spread:.{digits}f}"
    text = f"{mean:+.{digits}f}"
    return f"{text if float(text) else text[1:]}{around}"  # zero has no sign
