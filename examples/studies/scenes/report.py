"""Tables, plots and decisions: python examples/studies/scenes/report.py [--runs runs/study]

With `--runs`, first adds the finished trainings there to the records of docs/results/study. Then
everything is made from these alone: the plots beside them, `decisions.json`, and the tables between
the markers of docs/evidence.md, docs/results/study/tables.md and the README.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from splatting.stopping import command

from studies.pages import filled
from studies.scenes.analysis import Study
from studies.scenes.arms import (
    ADAPTIVE,
    ADAPTIVE_DEFAULTS,
    ADAPTIVE_OWN_FRAME,
    BASELINE,
    DEFAULTS,
    OWN_FRAME,
    OWN_FRAME_ARM,
    arm_of,
)
from studies.scenes.decisions import (
    FEW_VIEWS_SCENES,
    HALF,
    MANY_VIEWS_SCENES,
    PIECES,
    QUARTER,
    decide,
    every_scene,
    points_of,
    settings_of,
)
from studies.scenes.plots import VIEWS, plot_metrics, plot_one, plot_sizes
from studies.scenes.records import (
    COSTS,
    FOLDER,
    MISPOSED,
    Plain,
    Setting,
    gather,
    load,
    merge,
    read,
    read_costs,
    write,
)
from studies.scenes.tables import (
    arms_table,
    averaging_line,
    costs_table,
    crowd,
    decisions_table,
    differences_table,
    falls_table,
    headline_table,
    machines_line,
    metrics_table,
    paper_table,
    reach_table,
    scenes_gain_table,
    sizes_table,
    tuned_table,
)

REPOSITORY = Path(__file__).resolve().parents[3]
PAGE = REPOSITORY / "docs" / "evidence.md"
PAGES = (PAGE, FOLDER / "tables.md", REPOSITORY / "README.md")  # that have tables
FALLS = FOLDER.parent / "histogram" / "collapse.json"
MARK = "<!-- study:{} -->"
LONG, BRIEF = 30_000, 7_500
SHORTER = (BRIEF, 10_000)  # lengths that may do instead of the baseline's
ADAPTIVE_ARMS = (ADAPTIVE, "adc+annealed+faded", ADAPTIVE_DEFAULTS, ADAPTIVE_OWN_FRAME)
PLUSH = Setting("plush", 4_000, BRIEF, "sfm", rotated=True)  # where other rates were tried, too
LARGEST = Setting("lego", 50_000, LONG, "sfm", rotated=True, size="images_2")  # the README's
FULL_ARMS = (BASELINE, "faded", DEFAULTS, OWN_FRAME_ARM)
UNSEEN_ARMS = (BASELINE, "faded", "faded+out-of-view+averaged")


def the_study() -> Study:
    """All trainings in the committed files, and what their iterations cost."""
    return Study(read(FOLDER), read_costs(FOLDER / COSTS))


def is_open(record: Plain) -> bool:
    """Whether a record is of an open question: an arm of today's list, whole rotating views."""
    archived = record["tiled"] or not record["rotated"] or arm_of(record["arm"]).archived
    return not archived and record["scene"] != MISPOSED


def tables(study: Study) -> dict[str, str]:
    """Every generated piece of the pages, by the name in its marker."""
    rotated = [setting for setting in study.settings() if setting.rotated]
    return conclusions(study, rotated) | appendix(study, rotated)


def conclusions(study: Study, rotated: Sequence[Setting]) -> dict[str, str]:
    """The pieces of README and evidence page: what is concluded, and from what."""
    long, every = settings_of(study, LONG), every_scene(study, LONG)
    quarter = [setting for setting in every if setting.size == QUARTER]
    degrees = [*every, *every_scene(study, LONG, sh_degree=3)]
    few = [setting for setting in quarter if setting.scene in FEW_VIEWS_SCENES]
    half = settings_of(study, LONG, size=HALF)
    full = [s for s in study.settings() if s.rotated and s.size == "images" and not s.views]
    # Quarter, half and full size. Bonsai has its right poses here, as far as it was trained.
    sizes = [
        [s for s in settings if s.scene in MANY_VIEWS_SCENES and s.iterations == LONG]
        for settings in (long, half, full)
    ]
    nine = settings_of(study, LONG, PIECES["OutOfView"])
    trained = [r for r in study.records() if r.setting.rotated]
    brief = [s for s in settings_of(study, BRIEF) if s.scene in MANY_VIEWS_SCENES]
    tuned = [small_trainings(study), brief, *sizes[:2]]
    return {
        "rotated-machines": machines_line(trained),
        "decisions": decisions_table(study, BRIEF),
        "averaging": averaging_line(study),
        "every-scene": scenes_gain_table(study, degrees, DEFAULTS, BASELINE),
        "full": metrics_table(
            study, full, FULL_ARMS, plain=True, head=lambda s: f"{s.scene}, {s.iterations:,}"
        ),
        "own-frame": scenes_gain_table(study, sizes[1], OWN_FRAME_ARM, BASELINE),
        "own-frame-or-not": scenes_gain_table(study, sizes[1], OWN_FRAME_ARM, DEFAULTS),
        "own-frame-few": scenes_gain_table(study, few, OWN_FRAME_ARM, DEFAULTS),
        "headline": headline_table(study, sizes[::-1]),
        "each-size": sizes_table(study, sizes, ("rates-x2", DEFAULTS, OWN_FRAME_ARM)),
        "reach": reach_table(study, sizes[0], DEFAULTS, SHORTER),
        "tuned": tuned_table(study, tuned, PLUSH),
        "tuned-brief": tuned_table(study, tuned, PLUSH, brief=True),
        "paper": paper_table(study, quarter),
        "paper-brief": paper_table(study, quarter, brief=True),
        "adaptive-brief": metrics_table(study, long, ADAPTIVE_ARMS, seed=0, plain=True),
        "unseen-brief": metrics_table(study, nine, UNSEEN_ARMS, plain=True),
    }


def appendix(study: Study, rotated: Sequence[Setting]) -> dict[str, str]:
    """The pieces of `tables.md`: every arm, its metrics, and what it gains over its control."""
    made = {"arms": arms_table(study, study.settings())}
    mcmc = [arm for arm in study.arms(rotated) if not arm.startswith(ADAPTIVE)]
    for count in (LONG, BRIEF):
        settings = settings_of(study, count)
        made[f"whole-{count}"] = metrics_table(study, settings, mcmc)
        made[f"whole-{count}-gains"] = differences_table(study, settings, mcmc)
    whole = [s for s in rotated if s == replace(s, views=0, rates=1.0, tiled=0)]
    plain = [s for s in whole if s.sh_degree == 0]
    shown = {*settings_of(study, LONG), *settings_of(study, BRIEF)}
    sizes = [s for s in plain if s.size != QUARTER or s.points != points_of(s.scene)]
    others = [s for s in plain if s not in shown and s not in sizes]
    made["others"] = metrics_table(
        study, others, mcmc, head=lambda s: f"{s.scene}, {s.iterations:,}"
    )
    sizes = [s for s in sizes if study.runs(s, BASELINE)]
    made["sizes"] = metrics_table(
        study, sizes, mcmc, head=lambda s: f"{s.scene}, {crowd(s)}, {s.iterations:,}"
    )
    half = [s for s in sizes if s.size != QUARTER and s.iterations == LONG]
    made["sizes-gains"] = differences_table(study, half, mcmc)
    adaptive = [arm for arm in study.arms(whole) if arm.startswith(ADAPTIVE)]
    cloned = [s for s in whole if study.runs(s, ADAPTIVE)]
    for seed in (0, 1):
        made[f"adaptive-{seed}"] = metrics_table(
            study, cloned, adaptive, head=lambda s: f"{s.scene}, {crowd(s)}", seed=seed
        )
    rates = like(study, PLUSH, "rates")
    made["rates"] = metrics_table(study, rates, mcmc, head=lambda s: f"times {s.rates:g}")
    views = like(study, Setting(MISPOSED, 10_000, BRIEF, "sfm", rotated=True), "views")
    views.sort(key=lambda s: s.views or VIEWS[s.scene])
    made["views"] = metrics_table(study, views, mcmc, head=lambda s: str(s.views or VIEWS[s.scene]))
    tiled = [s for s in rotated if s.tiled]
    made["tiled"] = metrics_table(
        study, tiled, mcmc, head=lambda s: f"{s.scene}, {s.tiled} pieces, {s.iterations:,}"
    )
    iterated = ("faded", f"{OWN_FRAME}+faded", "paper")  # averaging is a branch of the first two
    made["costs"] = costs_table(read_costs(FOLDER / COSTS), iterated)
    made["collapse"] = falls_table(json.loads(FALLS.read_text("utf-8")))
    fixed = [s for s in study.settings() if not s.rotated]
    few = [s for s in fixed if s.scene == "brighton_beach" and s.iterations == BRIEF]
    made["few-views"] = metrics_table(study, few, study.arms(few))
    made["fixed"] = fixed_views(study, fixed)
    return made


def small_trainings(study: Study) -> list[Setting]:
    """The short trainings of five small scenes, with the same held-out views for every seed."""
    return [s for s in study.settings() if s == Setting(s.scene, points_of(s.scene), 3_000, "sfm")]


def fixed_views(study: Study, fixed: Sequence[Setting]) -> str:
    """What every arm gains in the trainings whose held-out views are the same for every seed."""
    kinds: dict[str, list[Setting]] = defaultdict(list)
    for setting in fixed:
        share = setting.points / points_of(setting.scene)
        kind = f"{setting.iterations:,} iterations"
        kind += ", random points at the start" * (setting.init == "random")
        kind += f", {share:g} of the Gaussians" * (share != 1.0)
        kind += f", harmonics of degree {setting.sh_degree}" * (setting.sh_degree > 0)
        kinds[kind].append(setting)
    made = {
        kind: differences_table(study, settings, study.arms(settings))
        for kind, settings in kinds.items()
    }
    return "\n\n".join(
        f"**{kind}**\n\n{text}" for kind, text in made.items() if len(text.splitlines()) > 2
    )


def like(study: Study, setting: Setting, field: str) -> list[Setting]:
    """The settings that differ from one in that field at most."""
    every = study.settings()
    return [s for s in every if s == replace(setting, **{field: getattr(s, field)})]


def plots(study: Study) -> list[Path]:
    """Draw everything; return the files."""
    arms = (BASELINE, "paper", DEFAULTS)
    posed = [s for s in settings_of(study, LONG) if s.scene in MANY_VIEWS_SCENES]
    plot_metrics(study, posed, arms, FOLDER / "rotated.png", SHORTER)
    plot_sizes(study, FOLDER / "sizes.png")
    plot_one(study, LARGEST, FOLDER / "largest.png")
    return [FOLDER / name for name in ("rotated.png", "sizes.png", "largest.png")]


@command("report")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=Path, metavar="DIR", help="folder of study/run.py")
    args = parser.parse_args(arguments)
    if args.runs is not None:
        found = gather(args.runs)
        if not found:
            raise ValueError(f"--runs {args.runs}: holds no finished training")
        write(merge(load(FOLDER), found), FOLDER, is_open)
    study = the_study()
    made = tables(study)
    for page in PAGES:
        text = filled(page.read_text(encoding="utf-8"), made, MARK, every=False)
        page.write_text(text, encoding="utf-8")
    decisions = {part: decision.on for part, decision in decide(study).items()}
    text = json.dumps(decisions, indent=1) + "\n"
    (FOLDER / "decisions.json").write_text(text, encoding="utf-8")
    print(FOLDER / "decisions.json", *plots(study), *PAGES, sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
