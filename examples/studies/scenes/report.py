"""Tables, plots and decisions: python examples/studies/scenes/report.py [--runs runs/study]

With `--runs`, first adds the finished trainings to docs/results/study/records.json, those whose
held-out views rotate with the seed to rotated.json. Then everything is made from these files
alone: the plots beside them, `decisions.json`, and the tables between the markers of
docs/evidence.md, docs/results/study/tables.md and the README.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from splatting.stopping import command

from studies.pages import filled, table
from studies.scenes.analysis import Study
from studies.scenes.arms import (
    ANNEALED,
    BASELINE,
    BOTH,
    DEFAULTS,
    FADED,
    GROUPS,
    HELD,
    MORE_AT_ONCE,
    OFTEN_FADED,
    SELDOM_FADED,
    SHARE_KEPT,
    SMALLER_SHARE,
    STABLE,
    STUDY_ARMS,
    UNFADED,
    label,
)
from studies.scenes.decisions import (
    HALF,
    MANY_VIEWS_SCENES,
    PIECES,
    QUARTER,
    decide,
    every_scene,
    settings_of,
)
from studies.scenes.long_tables import (
    averaging_table,
    cells_of,
    difference,
    differences_table,
    falls_table,
    headline_table,
    metrics_table,
    reach_table,
    scenes_gain_table,
    sizes_table,
)
from studies.scenes.plan import RATES_ARMS, SIZE_ARMS, UNSEEN_ARMS, UNSEEN_LONG_ARMS
from studies.scenes.plots import VIEWS, plot_curves, plot_gains, plot_metrics, plot_sizes
from studies.scenes.records import COSTS, FOLDER, Setting, gather, merge, read, read_costs, write
from studies.scenes.tables import (
    front_table,
    gains_table,
    goals_table,
    machines_line,
    scenes_table,
)

REPOSITORY = Path(__file__).resolve().parents[3]
PAGE = REPOSITORY / "docs" / "evidence.md"
PAGES = (PAGE, FOLDER / "tables.md", REPOSITORY / "README.md")  # that have tables
MARK = "<!-- study:{} -->"
FRONT = (  # what it is, arm, control
    ("annealing of all parameters, and fading", ANNEALED, BASELINE),
    ("the paper's preset, all parts", "paper", BASELINE),
    ("AW-SGLD against a constant multiplier of its mean", "awsgld", "constant"),
    ("L-BFGS against the same last phase without", "l2+reset+lqn@1/30", "l2+reset@1/30"),
)
PAPER = (  # what the pages say of the paper's parts: what, arm, control
    ("AW-SGLD as here, less a constant of its mean", STABLE, f"{STABLE}-constant"),
    ("AW-SGLD as in the paper, likewise", "paper", "paper-constant"),
    ("L2 in the last thirtieth", "l2@1/30", BASELINE),
    ("fresh moments there", "l1+reset@1/30", BASELINE),
    ("L-BFGS directions with both", "l2+reset+lqn@1/30", "l2+reset@1/30"),
    ("the whole preset", "paper", BASELINE),
)
ALL_ANNEALED, POOLED = "annealed-4-0.4+faded", f"{ANNEALED}+pooled"  # retired
UNFADED_OPACITIES = f"{ANNEALED}-opacities-unfaded"  # retired
SHORT = 3_000
LONG_ARMS = (
    *("mcmc", "faded", "annealed-4-0.4", "annealed-8-0.4"),
    *(ALL_ANNEALED, ANNEALED, UNFADED_OPACITIES, POOLED),
)
FEW_VIEWS_SCENES = ("brighton_beach", "plush")  # fewest views to speak of over-fitting, and most
FEW_VIEWS_ARMS = (
    "mcmc",
    *(f"{ALL_ANNEALED}{x}" for x in ("", "-means-1", "+decoupled", "+regularisers-0")),
    *(f"{ANNEALED}+eps-{x}-0.1" for x in ("opacities", "all")),
    *(f"{arm}+regularisers-0" for arm in (ANNEALED, POOLED)),
    *(UNFADED_OPACITIES, ANNEALED, POOLED),
)
CURVE_ARMS = ("mcmc", "awsgld", "constant", "rates-x2", "faded", "annealed-8-0.4", ANNEALED)
ROTATED = "rotated.json"  # records whose held-out views rotate with the seed
LONG, BRIEF = 30_000, 7_500
SHORTER = (BRIEF, 10_000)  # lengths that may do instead of stock's
ASIDE = ("explorations", "unseen", "adaptive", "never-reset")  # groups with a table of their own
NU_ARMS = (BASELINE, STABLE, f"{STABLE}-constant", "paper", "paper-constant")
OFTEN_ARMS = (
    *(BASELINE, SHARE_KEPT, SMALLER_SHARE, SELDOM_FADED, OFTEN_FADED, MORE_AT_ONCE),
    *(*UNFADED.values(), BOTH),
)
ADAPTIVE_ARMS = ("adc", "adc+defaults", "adc+defaults-but-scales+averaged")


def tables(study: Study) -> dict[str, str]:
    """Every generated piece of the page, by the name in its marker."""
    short = study.settings(SHORT)
    long = {
        "7,500 iterations": study.settings(BRIEF),
        "30,000 iterations": study.settings(LONG),
    }
    few = [s for s in long["7,500 iterations"] if s.scene in FEW_VIEWS_SCENES]
    made = {
        "core": gains_table(study.gains(short, names("core"))),
        "long": goals_table(study, {"3,000 iterations": short, **long}, ANNEALED, BASELINE),
        "pooled": goals_table(study, {"3,000 iterations": short, **long}, POOLED, BASELINE),
        "few-views": scenes_table(study, few, FEW_VIEWS_ARMS),
        "full-scenes": scenes_table(study, long["30,000 iterations"], LONG_ARMS),
        "front": front_table(study, {n: study.settings(n) for n in (SHORT, BRIEF, LONG)}, FRONT),
    }
    for kind, settings in (
        ("random", study.settings(SHORT, "random")),
        ("small", study.settings(SHORT, share=0.25)),
        ("harmonics", study.settings(SHORT, sh_degree=3)),
    ):
        made[kind] = goals_table(study, {"3,000 iterations": settings}, ANNEALED, BASELINE)
    return made


def rotating_study() -> Study:
    """The trainings with rotating views, and what their iterations cost."""
    return Study(read(FOLDER / ROTATED), read_costs(COSTS))


def rotated_tables(study: Study) -> dict[str, str]:
    """The pieces that are made from the trainings with rotating views."""
    made = {
        "rotated-machines": machines_line(study.records()),
        "decisions": decisions_table(study),
    }
    long, brief = settings_of(study, LONG), settings_of(study, BRIEF)
    every = every_scene(study, LONG)
    quarter = [setting for setting in every if setting.size == QUARTER]
    degrees = [*every, *every_scene(study, LONG, sh_degree=3)]
    made["every-scene"] = scenes_gain_table(study, degrees, DEFAULTS, BASELINE)
    made["headline"] = headline_table(study, long, BRIEF)
    made["reach"] = reach_table(study, long, DEFAULTS, SHORTER)
    made["paper"] = paper_table(study, quarter)
    made["paper-brief"] = paper_table(study, quarter, brief=True)
    half = [setting for setting in every if setting.size == HALF]
    averaged = [arm for arm, each in STUDY_ARMS.items() if each.averages]
    ends = [*every_scene(study, BRIEF), *every]
    made["averaging"] = averaging_table(study, ends, averaged)
    paper = BASELINE, "paper", "paper-constant", DEFAULTS
    made["paper-half"] = metrics_table(study, half, paper, seed=0)
    aside = {arm for kind in ASIDE for arm in names(kind)}
    shown = [arm for arm in STUDY_ARMS if arm not in aside]
    for count, settings in ((LONG, long), (BRIEF, brief)):
        made[f"rotated-{count}"] = metrics_table(study, settings, shown)
        made[f"rotated-{count}-gains"] = differences_table(study, settings, shown)
    made["collapse"] = (FOLDER.parent / "histogram" / "collapse.md").read_text("utf-8").strip()
    made["falls"] = falls_table(study, quarter, NU_ARMS)
    often = [s for s in study.all_settings() if s.rotated and not s.tiled and not s.views]
    made["often"] = sizes_table(study, often, OFTEN_ARMS)
    made["explorations"] = differences_table(study, brief, (STABLE, *names("explorations")))
    made["adaptive-brief"] = metrics_table(study, long, ADAPTIVE_ARMS, seed=0)
    made["adaptive"] = metrics_table(study, long, names("adaptive"), seed=0)
    made["adaptive-again"] = metrics_table(study, long, names("adaptive"), seed=1)
    made["never-reset"] = metrics_table(study, long, names("never-reset"), seed=0)
    rates = of_kind(study, Setting("plush", 4_000, BRIEF, "sfm", rotated=True), "rates")
    made["rates"] = metrics_table(study, rates, RATES_ARMS, head=lambda s: f"x{s.rates:g}")
    views = of_kind(study, Setting("bonsai", 10_000, BRIEF, "sfm", rotated=True), "views")
    views.sort(key=lambda s: s.views or VIEWS[s.scene])
    made["views"] = metrics_table(
        study, views, SIZE_ARMS, head=lambda s: str(s.views or VIEWS[s.scene])
    )
    tiled = [s for s in study.all_settings() if s.tiled]
    cut = dict.fromkeys((*UNSEEN_ARMS, *UNSEEN_LONG_ARMS, "kept"))
    made["unseen"] = metrics_table(study, tiled, cut, head=pieces)
    nine = [s for s in tiled if s.tiled == PIECES["OutOfView"] and s.iterations == LONG]
    made["unseen-brief"] = metrics_table(study, nine, (BASELINE, FADED, f"{HELD}+averaged"))
    return made


def pieces(setting: Setting) -> str:
    """Of a training on views that were cut up."""
    return f"{setting.scene}, {setting.tiled} pieces, {setting.iterations:,}"


def of_kind(study: Study, like: Setting, field: str) -> list[Setting]:
    """The settings that differ from one in that field at most."""
    every = study.all_settings()
    return [s for s in every if s == replace(like, **{field: getattr(s, field)})]


def names(kind: str) -> list[str]:
    """The arms of a group."""
    return [arm.name for arm in GROUPS[kind]]


def decisions_table(study: Study) -> str:
    """One line per part: what it was judged by, and whether it is on."""
    rows = []
    for part, decision in decide(study).items():
        by = f"`{label(decision.arm)}` against `{label(decision.control)}`"
        found, shown = decision.found, ["-"] * 5
        if found is not None:
            count = f"{len(found.pairs)}, {found.count}"
            shown = [f"{decision.iterations:,}", count, *cells_of(found)]
        on = "on" if decision.on else "off"
        brief = settings_of(study, BRIEF, PIECES.get(part, 0))
        beside = difference(study, brief, decision.arm, decision.control)
        short = cells_of(beside)[0] if len(beside.pairs) == len(MANY_VIEWS_SCENES) else "-"
        rows.append((part, by, *shown, f"{on} ({decision.verdict})", short))
    heads = (
        "part",
        "decided by",
        "iterations",
        "scenes, trainings",
        "PSNR",
        "SSIM",
        "LPIPS",
        "default",
        f"PSNR at {BRIEF:,}",
    )
    return table(heads, "llrlrrrlr", rows)


def paper_table(study: Study, settings: Sequence[Setting], *, brief: bool = False) -> str:
    """One line per part of the paper: what it gains over the same training without it.

    Args:
        brief: the PSNR alone, for the README.
    """
    rows = []
    for what, arm, control in PAPER:
        found = difference(study, settings, arm, control)
        if found.count:
            psnr, *others = cells_of(found)
            counts = f"{len(found.pairs)}, {found.count}"
            rows.append((what, psnr) if brief else (what, counts, psnr, *others))
    if brief:
        return table(("part", "PSNR, dB"), "lr", rows)
    return table(("part", "scenes, trainings", "PSNR, dB", "SSIM", "LPIPS"), "llr", rows)


def plots(study: Study, rotating: Study) -> list[Path]:
    """Draw everything; return the files."""
    short, long, full = (study.settings(length) for length in (SHORT, BRIEF, LONG))
    pooled, drawn = ("mcmc", ANNEALED, POOLED), []
    for name, settings, arms in (
        ("curves.png", short, CURVE_ARMS),
        ("curves_long.png", long, ("mcmc", "faded", "annealed-8-0.4", *pooled[1:])),
        ("curves_full.png", full, pooled),
    ):
        plot_curves(study, settings, arms, FOLDER / name)
        drawn.append(FOLDER / name)
    for name, kinds in (
        ("gains.png", ("core", "with-nu")),
        ("gains_tails.png", ("tails", "on-top")),
        ("gains_leads.png", ("leads",)),
    ):
        gains = [gain for kind in kinds for gain in study.gains(short, names(kind))]
        scenes = sorted({scene for gain in gains for scene in gain.scenes})
        ends = [
            r.final for s in short if s.scene in scenes for r in study.runs(s, BASELINE).values()
        ]
        title = f"{', '.join(scenes)}\n{SHORT:,} iterations; {BASELINE} {fmean(ends):.2f} dB"
        plot_gains(gains, FOLDER / name, title)
        drawn.append(FOLDER / name)
    arms = (BASELINE, "paper", DEFAULTS)
    plot_metrics(rotating, settings_of(rotating, LONG), arms, FOLDER / "rotated.png", SHORTER)
    plot_sizes(rotating, FOLDER / "sizes.png")
    return [*drawn, FOLDER / "rotated.png", FOLDER / "sizes.png"]


@command("report")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=Path, metavar="DIR", help="folder of study/run.py")
    args = parser.parse_args(arguments)
    records = FOLDER / "records.json"
    if args.runs is not None:
        found = gather(args.runs)
        if not found:
            raise ValueError(f"--runs {args.runs}: holds no finished training")
        for path, rotated in ((records, False), (FOLDER / ROTATED, True)):
            old = json.loads(path.read_text(encoding="utf-8"))["records"]
            new = [record for record in found if record.get("rotated", False) == rotated]
            if new:
                write(merge(old, new), path)
    study, rotating = Study(read(records)), rotating_study()
    made = tables(study) | rotated_tables(rotating)
    for page in PAGES:
        text = filled(page.read_text(encoding="utf-8"), made, MARK, every=False)
        page.write_text(text, encoding="utf-8")
    decisions = {part: decision.on for part, decision in decide(rotating).items()}
    text = json.dumps(decisions, indent=1) + "\n"
    (FOLDER / "decisions.json").write_text(text, encoding="utf-8")
    print(records, FOLDER / "decisions.json", *plots(study, rotating), *PAGES, sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
