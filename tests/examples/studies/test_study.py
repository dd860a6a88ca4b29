"""The study: its page equals its records, its rule the defaults, and its trainings can resume."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splatting.fit import Fit, FitOptions
from splatting.scenes import load_scene
from studies.pages import filled
from studies.scenes import arms, plots, report
from studies.scenes.analysis import Study, difference, same_start
from studies.scenes.arms import (
    ADAPTIVE_DEFAULTS,
    BASELINE,
    LIST,
    OWN_FRAME_ARM,
    TRAINED,
    StudyArm,
    archive,
    arm_of,
    find_study_arm,
)
from studies.scenes.arms import DEFAULTS as DEFAULT_ARM
from studies.scenes.decisions import (
    COMPARISONS,
    MANY_VIEWS_SCENES,
    decide,
    every_scene,
    points_of,
    settings_of,
)
from studies.scenes.plan import plan, stages
from studies.scenes.records import (
    ARCHIVE,
    COLUMNS,
    MISPOSED,
    RIGHT,
    Record,
    Setting,
    gather,
    load,
    merge,
    read,
    write,
)
from studies.scenes.run import main as run_study
from studies.scenes.tables import (
    averaging_line,
    headline_table,
    machines_line,
    metrics_table,
    paper_table,
    reach_table,
    scenes_gain_table,
    sizes_table,
    tuned_table,
)
from studies.scenes.training import Spec, fit_of, machine, train

from opt3dgs_optim import DEFAULTS, DEFAULTS_ADC

STUDY = cache(report.the_study)


def record(arm: str, scene: str, seed: int, psnr: float, seconds: float = 10.0) -> Record:
    """A straight curve from 10 dB at 0 s."""
    curve = {name: np.array([0.0, 1.0]) for name in COLUMNS}
    curve["iteration"] = np.array([0.0, 3000.0])
    curve["seconds"] = np.array([0.0, seconds])
    curve["psnr"] = np.array([10.0, psnr])
    setting = Setting(scene, 100, 3000, "sfm")
    return Record(setting, arm, seed, curve, None, 1, 1, "a machine", f"2026-01-0{seed + 1}")


def test_the_defaults_are_what_the_page_concludes() -> None:
    decided = {part: decision.on for part, decision in decide(STUDY()).items()}
    committed = json.loads((report.FOLDER / "decisions.json").read_text(encoding="utf-8"))
    assert committed == decided
    assert {type(part).__name__ for part in DEFAULTS} == {
        part for part, on in decided.items() if on
    }


def test_the_pages_are_made_from_the_records() -> None:
    made = report.tables(STUDY())
    for path in report.PAGES:
        page = path.read_text(encoding="utf-8")
        assert "<!-- study:" in page
        assert filled(page, made, report.MARK, every=False) == page, path


def test_every_open_record_is_of_the_plan() -> None:
    planned = {replace(spec, seed=0) for specs in stages().values() for spec in specs}
    trunks = {replace(s, arm=str(find_study_arm(s.arm).trunk)) for s in planned}
    for entry in load(report.FOLDER):
        if report.is_open(entry):
            kind = {name: entry[name] for name in ("rotated", "size", "views", "rates")}
            kind |= {"sh_degree": entry["sh_degree"], "init": entry["init"]}
            spec = Spec(
                entry["scene"], entry["arm"], 0, entry["iterations"], entry["points"], **kind
            )
            assert spec in planned | trunks, spec


def test_the_defaults_are_the_measured_arms() -> None:
    for name, defaults in ((DEFAULT_ARM, DEFAULTS), (ADAPTIVE_DEFAULTS, DEFAULTS_ADC)):
        measured = find_study_arm(name).parts
        assert measured is not None
        assert measured(300, None) == list(defaults)


def rotated_record(arm: str, scene: str, seed: int, **metrics: float) -> Record:
    """As `record`; the metrics are those after the last iteration."""
    made = record(arm, scene, seed, metrics.pop("psnr", 20.0))
    for name, value in ({"ssim": 0.7, "lpips": 0.2} | metrics).items():
        made.curve[name] = np.array([0.0, value])
    made.curve["iteration"][1] = 7_500
    setting = Setting(scene, points_of(scene), 7_500, "sfm", rotated=True)
    return replace(made, setting=setting)


WITH, WITHOUT = COMPARISONS["Fading"]


@pytest.mark.parametrize(
    ("better", "verdict"),
    [
        ({"psnr": 20.5}, "pays"),
        ({"psnr": 20.5, "ssim": 0.69}, "loses SSIM"),
        ({"psnr": 20.5, "lpips": 0.21}, "loses LPIPS"),
        ({"lpips": 0.19}, "pays"),
        ({"psnr": 20.5, "cost": 2.0}, "loses PSNR, SSIM"),
        ({}, "no difference"),
    ],
)
def test_a_part_is_on_if_one_metric_gains_and_none_loses(
    better: dict[str, float], verdict: str
) -> None:
    costs = {
        (scene, "images_4", 7_500, 0, 0, "faded"): better.get("cost", 1.0)
        for scene in MANY_VIEWS_SCENES
    }
    better = {name: value for name, value in better.items() if name != "cost"}
    records = [
        rotated_record(arm, scene, seed, **(better if arm == WITH else {}))
        for scene in MANY_VIEWS_SCENES
        for seed in (0, 1)
        for arm in (WITHOUT, WITH)
    ]
    decision = decide(Study(records, costs))["Fading"]
    assert (decision.iterations, decision.verdict) == (7_500, verdict)
    assert decision.on == (verdict == "pays")
    crowded = [replace(r, setting=replace(r.setting, points=40_000)) for r in reversed(records)]
    assert decide(Study([*records, *crowded], costs))["Fading"] == decision
    two = decide(Study(records[:8]))["Fading"]
    assert (two.iterations, two.verdict, two.on) == (None, "too few", False)
    once = decide(Study(records[:-2], costs))["Fading"]
    assert not once.on
    assert once.verdict == (f"{verdict}, one seed" if verdict == "pays" else verdict)


def test_a_part_for_views_that_see_little_is_judged_on_those() -> None:
    arms = COMPARISONS["OutOfView"]
    whole = [
        rotated_record(arm, scene, seed, psnr=20.0 + (arm == arms[0]))
        for arm in arms
        for scene in MANY_VIEWS_SCENES
        for seed in (0, 1)
    ]
    cut = [replace(r, setting=replace(r.setting, tiled=9)) for r in whole]
    assert decide(Study(whole))["OutOfView"].verdict == "too few"
    assert decide(Study(cut))["OutOfView"].verdict == "pays"
    assert decide(Study(cut))["Fading"].verdict == "too few"


def test_a_cost_that_was_not_measured_is_the_controls() -> None:
    setting = rotated_record("faded", "plush", 0).setting
    study = Study([], {("plush", "images_4", 7_500, 0, 0, "faded"): 1.25})
    assert study.cost(setting, "faded") == 1.25
    assert study.cost(replace(setting, sh_degree=3), "faded") == 1.0
    assert study.cost(setting, "annealed", "faded") == 1.0
    assert study.cost(setting, "annealed") == 1.0


def test_what_averaging_adds_in_the_end_counts_at_equal_seconds() -> None:
    """At 4/5 of the iterations, where its own curve is that of the iterates yet."""
    arms = {"faded": 22.0, DEFAULT_ARM: 22.4, BASELINE: 20.0, "mcmc+averaged": 20.1}
    records = [rotated_record(arm, "plush", 0, psnr=psnr) for arm, psnr in arms.items()]
    setting = records[0].setting
    study = Study(records, {("plush", "images_4", 7_500, 0, 0, "faded"): 1.25})
    found = difference(study, [setting], DEFAULT_ARM, "mcmc+averaged")
    assert found.cost == 1.25
    assert found.of("psnr")[0] == pytest.approx(0.2 * 10.0 + 0.8 * 22.0 + 0.4 - 20.1)
    found = difference(study, [setting], DEFAULT_ARM, "faded")
    assert found.of("psnr")[0] == pytest.approx(0.4)


def test_a_branch_is_not_compared_with_a_trunk_that_was_trained_again() -> None:
    branch, trunk = (rotated_record(arm, "plush", 0) for arm in ("l2@1/30", BASELINE))
    again = replace(trunk, curve=trunk.curve | {"psnr": trunk.curve["psnr"] + 0.1})
    assert difference(Study([branch, trunk]), [trunk.setting], branch.arm).count == 1
    assert difference(Study([branch, again]), [trunk.setting], branch.arm).count == 0


def test_wrong_poses_count_only_where_nothing_was_trained_with_the_right_ones() -> None:
    psnr = {RIGHT: 30.0, MISPOSED: 25.0, "lego": 20.0}
    records = [
        rotated_record(arm, scene, 0, psnr=end + (arm != BASELINE))
        for scene, end in psnr.items()
        for arm in (BASELINE, DEFAULT_ARM, "faded")
        if (scene, arm) != (RIGHT, "faded")
    ]
    study = Study(records)
    settings = settings_of(study, 7_500)
    for arm, scenes in ((DEFAULT_ARM, {RIGHT, "lego"}), ("faded", {MISPOSED, "lego"})):
        assert set(difference(study, settings, arm, BASELINE).pairs) == scenes
    assert not any(report.is_open(r) for r in load(report.FOLDER) if r["scene"] == MISPOSED)


def test_a_scene_without_any_of_the_arms_has_no_column() -> None:
    records = [rotated_record(BASELINE, "lego", 0), rotated_record("faded", "plush", 0)]
    study = Study(records)
    (_, _, row), (_, _, seed) = (
        metrics_table(study, study.settings(), (arm, "annealed"), seed=seed).splitlines()
        for arm, seed in ((BASELINE, None), ("faded", 0))
    )
    assert row == "| `mcmc` | 20.00 / 0.700 / 0.200 |"
    assert seed.startswith("| `faded` | 20.00 / 0.700 / 0.200, ")


def test_means_of_iterates_are_of_the_trunks_in_the_records() -> None:
    study = STUDY()
    for ours in study.records():
        if trunk := arm_of(ours.arm).averages:
            assert same_start(ours, study.runs(ours.setting, trunk)[ours.seed]), ours


def test_the_longest_trainings_decide() -> None:
    records = [
        rotated_record(arm, scene, 0, psnr=20.0 + (arm == WITH))
        for scene in MANY_VIEWS_SCENES
        for arm in (WITHOUT, WITH)
    ]
    longer = [
        replace(r, setting=replace(r.setting, iterations=30_000), arm=arm)
        for r, arm in zip(records, 3 * [WITH, WITHOUT], strict=True)
    ]
    decision = decide(Study([*records, *longer]))["Fading"]
    assert (decision.iterations, decision.verdict) == (30_000, "loses PSNR")


@pytest.mark.parametrize("seeds", [1, 2])
def test_half_size_decides_where_it_was_trained_with_two_seeds(seeds: int) -> None:
    small = [
        rotated_record(arm, scene, seed, psnr=20.0 + (arm == WITH))
        for scene in MANY_VIEWS_SCENES
        for seed in (0, 1)
        for arm in (WITHOUT, WITH)
    ]
    half = [
        replace(r, setting=replace(r.setting, size="images_2", points=50_000, iterations=30_000))
        for r in small
    ]
    half = [replace(r, arm=WITH if r.arm == WITHOUT else WITHOUT) for r in half if r.seed < seeds]
    decision = decide(Study([*small, *half]))["Fading"]
    expected = ("images_4", "pays") if seeds == 1 else ("images_2", "loses PSNR")
    assert (decision.size, decision.verdict) == expected


UNCONFIRMED, REFUTED = "pays, not confirmed at full size", "pays, but not at full size"
FULL_SIZE: dict[str, Any] = {"size": "images", "points": 200_000, "sh_degree": 3}


@pytest.mark.parametrize(
    ("full", "of_a_new_part", "of_an_old_one"),
    [
        ((), UNCONFIRMED, "pays"),  # never trained
        (({"psnr": 25.0},), UNCONFIRMED, "pays"),  # one scene says nothing
        (({"psnr": 15.0},), UNCONFIRMED, "pays"),
        (({}, {}), "pays", "pays"),  # as good as without it
        (({"psnr": 20.2}, {"psnr": 19.9}), "pays", "pays"),
        (({"psnr": 20.1}, {"psnr": 19.8}), REFUTED, "pays"),  # behind in the mean
        (({"ssim": 0.7001}, {"ssim": 0.6998}), REFUTED, "pays"),
        (({"psnr": 21.0, "lpips": 0.2001}, {"psnr": 21.0, "lpips": 0.2002}), REFUTED, REFUTED),
    ],
)
@pytest.mark.parametrize("iterations", [15_000, 30_000])
def test_full_size_has_the_last_word(
    iterations: int, full: tuple[dict[str, float], ...], of_a_new_part: str, of_an_old_one: str
) -> None:
    for part, verdict in (("OwnFrame", of_a_new_part), ("Fading", of_an_old_one)):
        arm, control = COMPARISONS[part]
        records = [
            rotated_record(name, scene, seed, psnr=20.0 + (name == arm))
            for scene in MANY_VIEWS_SCENES
            for seed in (0, 1)
            for name in (arm, control)
        ]
        others = {**FULL_SIZE, "iterations": iterations}
        for scene, better in zip(MANY_VIEWS_SCENES, full, strict=False):
            for name, metrics in ((arm, better), (control, {})):
                made = rotated_record(name, scene, 0, **metrics)
                records.append(replace(made, setting=replace(made.setting, **others)))
        decision = decide(Study(records))[part]
        assert decision.verdict == verdict
        assert decision.on == (verdict == "pays")


@pytest.mark.parametrize(("brief", "long"), [(19.0, 21.0), (21.0, 19.0)])
def test_at_full_size_the_longest_training_of_a_scene_counts(brief: float, long: float) -> None:
    arm, control = COMPARISONS["OwnFrame"]
    records = []
    for iterations, psnr in ((30_000, long), (15_000, brief), (7_500, 0.0)):
        setting = {**FULL_SIZE, "iterations": iterations}
        for name, found in ((arm, psnr), (control, 20.0)):
            made = rotated_record(name, "lego", 0, psnr=found)
            records.append(replace(made, setting=replace(made.setting, **setting)))
    gain, _ = decide(Study(records))["OwnFrame"].full.of("psnr")
    assert gain == long - 20.0


def test_every_scene_and_size_has_its_line() -> None:
    arms = ((BASELINE, 20.0), ("annealed", 20.5))
    quarter = [rotated_record(arm, "banana", 0, psnr=psnr) for arm, psnr in arms]
    half = [replace(r, setting=replace(r.setting, size="images_2", points=5_000)) for r in quarter]
    other = rotated_record(BASELINE, "plush", 0)  # has no pair
    unpaired = rotated_record("annealed", "banana", 1, psnr=30.0)
    study = Study([*quarter, *half, other, unpaired])
    table = scenes_gain_table(study, every_scene(study, 7_500), "annealed", BASELINE)
    assert table.startswith("| scene | Gaussians, images | 3DGS-MCMC | `annealed` | gain in PSNR")
    ends = "20.00 / 0.700 / 0.200 | 20.50 / 0.700 / 0.200 | +0.50"
    assert table.splitlines()[2:] == [
        f"| banana | 4,000, quarter | {ends} |",
        f"| banana | 5,000, half | {ends} |",
    ]


def test_every_size_of_a_scene_stands_in_one_line() -> None:
    quarter = [
        rotated_record(arm, "bonsai", seed, psnr=20.0 + (arm == DEFAULT_ARM), ssim=0.7 + seed / 10)
        for arm in (BASELINE, DEFAULT_ARM)
        for seed in (0, 1)
    ]
    full = [replace(r, setting=replace(r.setting, size="images")) for r in quarter if r.seed == 0]
    study = Study([*quarter, *full, rotated_record(DEFAULT_ARM, "lego", 0)])
    sizes = [[r.setting for r in records[:1]] for records in (quarter, [], full)]
    said = sizes_table(study, sizes, (DEFAULT_ARM, "annealed"))
    gain = "+1.00 / 0.000 / 0.000"
    line = f"| bonsai | the defaults | {gain} (2 seeds) | - | {gain} (1 seed) |"
    assert said.splitlines()[2:] == [line]


def test_trainings_that_the_mean_did_not_help_are_counted() -> None:
    ends = {"mcmc": 20.0, "mcmc+averaged": 20.2, "faded": 21.0, "faded+averaged": 20.9}
    made = [rotated_record(arm, "bonsai", 0, psnr=psnr) for arm, psnr in ends.items()]
    for each in made:
        better = each.arm.endswith("+averaged")
        each.curve["ssim"][-1] += better / 100
        each.curve["lpips"][-1] -= better / 100
    said = averaging_line(Study([*made, rotated_record("faded+averaged", "lego", 0)]))
    assert "PSNR, SSIM and LPIPS in 1 of 1 trainings" in said
    assert "PSNR in 1 of 2, and changed it by -0.10 dB at worst" in said


def test_when_the_baselines_quality_is_reached_over_the_seeds_of_both() -> None:
    runs = (BASELINE, 0, 20.0), ("annealed", 0, 30.0), (BASELINE, 1, 28.0)
    study = Study([rotated_record(arm, "a", seed, psnr=psnr) for arm, seed, psnr in runs])
    said = reach_table(study, study.settings(), "annealed", [3_000, 5_000])
    assert "| 20.00 dB (1 seed) | 50% of the time | - | - |" in said
    shorter = rotated_record("annealed", "a", 0, psnr=21.0)
    shorter = replace(shorter, setting=replace(shorter.setting, iterations=5_000))
    costs = {("a", "images_4", 3_000, 0, 0, "annealed"): 1.2}
    both = Study([*study.records(), shorter], costs)
    said = reach_table(both, study.settings(), "annealed", [3_000, 5_000])
    assert "| 50% of the time | - | +1.00 dB in 80% of the time |" in said


def test_the_headline_is_of_the_seeds_that_both_have() -> None:
    runs = (BASELINE, 0, 20.0), (BASELINE, 1, 28.0), (DEFAULT_ARM, 0, 30.0), (DEFAULT_ARM, 1, 31.0)
    quarter = [rotated_record(arm, "a", seed, psnr=psnr) for arm, seed, psnr in runs]
    setting = replace(quarter[0].setting, size="images_2")
    half = [replace(r, setting=setting) for r in quarter if (r.arm, r.seed) != (BASELINE, 1)]
    half += [replace(r, arm=OWN_FRAME_ARM) for r in half if r.arm == DEFAULT_ARM]
    rest, points = " / 0.700 / 0.200 |", f"{setting.points:,}"
    study = Study([*quarter, *half])
    assert headline_table(study, [[setting], [quarter[0].setting]]).splitlines()[2:] == [
        f"| half: {points} Gaussians, 1 seed | 3DGS-MCMC | 20.00{rest}",
        f"| half | **the defaults** | 30.00{rest}",
        f"| half | with `OwnFrame` | 30.00{rest}",
        f"| quarter: {points} Gaussians, 2 seeds | 3DGS-MCMC | 24.00{rest}",
        f"| quarter | **the defaults** | 30.50{rest}",
    ]


def test_the_headline_shows_a_size_that_one_of_its_scenes_was_trained_at() -> None:
    both = (BASELINE, 20.0), (DEFAULT_ARM, 21.0)
    quarter = [rotated_record(arm, scene, 0, psnr=p) for arm, p in both for scene in "ab"]
    setting = replace(quarter[0].setting, size="images", sh_degree=3)
    full = [replace(r, setting=setting) for r in quarter if r.setting.scene == "a"]
    alone = [replace(r, setting=replace(setting, scene="b")) for r in full if r.arm == BASELINE]
    study = Study([*quarter, *full, *alone])
    sizes = [[s for s in study.settings() if s.size == size] for size in ("images", "images_4")]
    points, rest = f"{setting.points:,} Gaussians", " / 0.700 / 0.200 |"
    assert headline_table(study, sizes).splitlines() == [
        "| size | training | a | b |",
        "|---|---|---|---|",
        f"| full: {points}, degree 3, 1 seed | 3DGS-MCMC | 20.00{rest} - |",
        f"| full | **the defaults** | 21.00{rest} - |",
        f"| quarter: {points}, 1 seed | 3DGS-MCMC | 20.00{rest} 20.00{rest}",
        f"| quarter | **the defaults** | 21.00{rest} 21.00{rest}",
    ]


def test_tuned_rates_stand_beside_the_defaults_of_the_same_seeds() -> None:
    """Of the seeds that other rates were trained with: seed 1 has no other."""
    own = rotated_record(BASELINE, "plush", 0, psnr=20.0)
    tuned = replace(own, setting=replace(own.setting, rates=3.0))
    tuned = replace(tuned, curve=tuned.curve | {"psnr": tuned.curve["psnr"] + 0.5})
    other = rotated_record(BASELINE, "plush", 1, psnr=20.0)
    ours = [rotated_record(DEFAULT_ARM, "plush", s, psnr=21.0 + s) for s in (0, 1)]
    small = [record(arm, "a", 0, psnr) for arm, psnr in ((BASELINE, 20.0), ("rates-x3", 20.25))]
    study = Study([own, tuned, other, *ours, *small])
    lines = tuned_table(study, [[small[0].setting], []], own.setting).splitlines()
    columns = "1 small scene, 3,000 iterations, 1 training | plush, 7,500 iterations, 1 training"
    assert lines[0] == f"| training | {columns} |"
    assert "| 3DGS-MCMC as published | 0 | 0 |" in lines
    assert "| 3DGS-MCMC, all steps times 3 | +0.25 | +0.50 |" in lines
    assert not any("times 10" in line for line in lines)  # which nobody has trained
    assert "| **the defaults**, learning rates as published | - | +1.00 |" in lines


def test_a_column_of_tuned_rates_appears_with_its_trainings() -> None:
    """And counts the defaults only on the scenes and seeds that were tried with other rates."""
    trained = [(BASELINE, 20.0), ("rates-x2", 20.5), ("positions-x3", 20.2), (DEFAULT_ARM, 21.0)]
    records = [rotated_record(arm, "a", 0, psnr=psnr) for arm, psnr in trained]
    records += [rotated_record(arm, "b", 0, psnr=psnr + 1) for arm, psnr in trained[:2]]
    records += [rotated_record(DEFAULT_ARM, "b", 0, psnr=23.0)]
    records += [rotated_record(arm, "c", 0, psnr=10.0) for arm in (BASELINE, DEFAULT_ARM)]
    study = Study(records)
    nowhere = Setting("plush", 4_000, 7_500, "sfm", rotated=True)
    lines = tuned_table(study, [study.settings()], nowhere, brief=True).splitlines()
    assert lines[0] == "| training | 2 scenes, 7,500 iterations, 2 trainings |"
    assert lines[2:] == [
        "| 3DGS-MCMC as published | 0 |",
        "| 3DGS-MCMC, all steps times 2 | +0.50 ± 0.00 |",
        "| 3DGS-MCMC, the positions' steps times 3 | +0.20 (1 training) |",
        "| **the defaults**, learning rates as published | +1.50 ± 0.50 |",
    ]


def test_the_headline_has_the_best_tuned_rates_where_every_training_has_them() -> None:
    arms = {BASELINE: 20.0, "rates-x2": 20.5, "positions-x3": 20.8, DEFAULT_ARM: 21.0}
    long = [rotated_record(arm, "a", s, psnr=psnr) for arm, psnr in arms.items() for s in (0, 1)]
    without = [r for r in long if (r.arm, r.seed) != ("positions-x3", 1)]
    rest = " / 0.700 / 0.200 |"
    for records, best in ((long, "positions' steps times 3"), (without, "steps times 2")):
        study = Study(records)
        lines = headline_table(study, [study.settings()]).splitlines()[2:5]
        psnr = max(p for arm, p in arms.items() if arm.endswith(best[-1]) and "-x" in arm)
        about = f"quarter: {long[0].setting.points:,} Gaussians, 2 seeds"
        assert lines[0] == f"| {about} | 3DGS-MCMC | 20.00{rest}"
        assert lines[1].endswith(f"{best} | {psnr:.2f}{rest}")
        assert lines[2] == f"| quarter | **the defaults** | 21.00{rest}"


def test_zero_has_no_sign() -> None:
    ends = {BASELINE: 20.0, "l2@1/30": 20.0 - 1e-4}
    study = Study([rotated_record(arm, "a", 0, psnr=psnr) for arm, psnr in ends.items()])
    (row,) = paper_table(study, study.settings(), brief=True).splitlines()[2:]
    assert row == "| L2 loss in the last thirtieth | 3DGS-MCMC | 1, 1 | 0.00 |"


def test_tables_that_a_reader_meets_first_have_plain_names() -> None:
    """Those of README and evidence page; the list of variants explains the names of the others."""
    study = STUDY()
    rotated = [setting for setting in study.settings() if setting.rotated]
    for name, text in report.conclusions(study, rotated).items():
        assert not re.search(r"\bstock\b|\barms?\b|less |likewise|\bx\d\.", text), name
        if name != "decisions":  # whose second column names the variants that were compared
            names = set(re.findall(r"`([^`]+)`", text))
            known = {
                "Annealing",
                "Averaging",
                "DEFAULTS_ADC",
                "DefaultStrategy",
                "Fading",
                "OwnFrame",
            }
            assert names <= known, name


def test_dots_are_the_ends_of_shorter_trainings_of_every_seed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    long = [rotated_record(arm, "a", seed) for arm in (BASELINE, DEFAULT_ARM) for seed in (0, 1)]
    short = replace(long[0].setting, iterations=3_000)
    others = [
        replace(rotated_record(DEFAULT_ARM, "a", s, psnr=20 + s), setting=short) for s in (0, 1)
    ]
    panels: list[Any] = []
    monkeypatch.setattr(plots, "_finish", lambda figure, _path: panels.append(figure.axes[0]))
    costs = {("a", "images_4", 3_000, 0, 0, "faded"): 1.5}
    for known in (others, others[:1]):  # the second without one of the seeds
        study = Study([*long, *known], costs)
        plots.plot_metrics(study, [long[0].setting], (BASELINE, DEFAULT_ARM), tmp_path, [3_000])
    dots = [
        [line.get_xydata() for line in panel.lines if line.get_marker() == "o"] for panel in panels
    ]
    assert np.array(dots[0]).tolist() == [[[0.4 * 1.5, 20.5]]]
    assert dots[1] == []


def test_the_plan_names_known_arms_and_puts_what_is_needed_first() -> None:
    trainings = plan(Path("scenes"), Path("runs"))
    seen: set[Path] = set()
    for training in trainings:
        assert not find_study_arm(training.spec.arm).archived
        assert set(training.needs) <= seen, training
        seen.add(training.folder)
    assert len(seen) == len(trainings)
    known = {*TRAINED, *archive(), DEFAULT_ARM}
    assert all(arm.control in known for arm in (*LIST, *archive().values()))
    with pytest.raises(ValueError, match="nonsense"):
        plan(Path("scenes"), Path("runs"), ["nonsense"])


def test_a_training_resumes_and_branches(tmp_path: Path) -> None:
    spec = Spec("embedded", BASELINE, 0, 120, 120)
    whole = train(spec, _made(tmp_path / "whole"), None, None)
    # Stopped after a later evaluation: the record is ahead of the checkpoint, as when killed.
    stopped = _made(tmp_path / "stopped")
    train(spec, stopped, None, None)
    cut = json.loads((stopped / "record.json").read_text(encoding="utf-8"))
    del cut["finished"]
    (stopped / "record.json").write_text(json.dumps(cut), encoding="utf-8")
    (tmp_path / "whole" / "at-90.pt").rename(stopped / "checkpoint.pt")
    again = train(spec, stopped, None, None)
    assert _psnr(again) == _psnr(whole)

    branch = Spec("embedded", "mcmc+averaged", 0, 120, 120)
    tail = train(branch, _made(tmp_path / "branch"), stopped_trunk(tmp_path, spec), None)
    assert (
        _psnr(tail)[: _iterations(tail).index(116) + 1]
        == (_psnr(whole)[: _iterations(whole).index(116) + 1])
    )
    assert _psnr(tail)[-1] != _psnr(whole)[-1]


def stopped_trunk(tmp_path: Path, spec: Spec) -> Path:
    trunk = _made(tmp_path / "trunk")
    train(spec, trunk, None, None)
    return trunk


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _psnr(made: dict[str, object]) -> list[float]:
    curve = made["curve"]
    assert isinstance(curve, list)
    return [row["psnr"] for row in curve]


def _iterations(made: dict[str, object]) -> list[int]:
    curve = made["curve"]
    assert isinstance(curve, list)
    return [row["iteration"] for row in curve]


_embedded = cache(lambda: load_scene("embedded"))  # seconds to make


def test_machines_and_days_are_said() -> None:
    records = [record("mcmc", "a", seed, 20.0) for seed in (2, 0, 1)]
    other = replace(records[0], machine="another", date="2026-02-01")
    assert machines_line([*records, other]) == (
        "3 trainings, 2026-01-01 to 2026-01-03: a machine, one thread each.\n"
        "1 training, 2026-02-01: another, one thread each."
    )


def test_new_records_take_the_place_of_old_ones() -> None:
    def one(seed: int, seconds: float) -> dict[str, Any]:
        setting = asdict(Setting("a", 1, 2, "sfm"))
        return {**setting, "arm": "mcmc", "seed": seed, "seconds": seconds}

    merged = merge([one(0, 1.0), one(1, 1.0)], [one(2, 2.0), one(1, 2.0)])
    assert merged == [one(0, 1.0), one(1, 2.0), one(2, 2.0)]


def test_bad_calls_say_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_study(["--scenes", str(tmp_path), "--stages", "nonsense"]) == 2
    assert "nonsense" in capsys.readouterr().err
    assert report.main(["--runs", str(tmp_path)]) == 2
    assert "no finished training" in capsys.readouterr().err
    with pytest.raises(ValueError, match="unknown; there are mcmc"):
        find_study_arm("nonsense")


def test_records_survive_writing(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    train(Spec("embedded", "faded", 1, 20, 80), tmp_path / "a", None, None)
    train(Spec("embedded", "faded", 1, 20, 80, sh_degree=1), tmp_path / "b", None, None)
    found = merge(gather(tmp_path / "a"), gather(tmp_path / "b"))
    for is_open in (lambda _: True, lambda r: r["sh_degree"] > 0, lambda _: False):
        write(found, tmp_path, is_open)
        assert merge([], load(tmp_path)) == found
    packed = (tmp_path / ARCHIVE).stat().st_mtime_ns
    write(found, tmp_path, lambda _: False)
    assert (tmp_path / ARCHIVE).stat().st_mtime_ns == packed
    one, other = read(tmp_path)
    assert (one.arm, one.seed, one.setting.iterations) == ("faded", 1, 20)
    assert one.seconds > 0
    assert other.state_bytes > one.state_bytes
    assert other.setting == replace(one.setting, sh_degree=1)
    assert one.machine == machine()
    assert torch.__version__ in one.machine
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", one.date)
    (tmp_path / ARCHIVE).unlink()
    (tmp_path / "records.jsonl").write_text('{"columns": ["psnr"]}\n', encoding="utf-8")
    with pytest.raises(ValueError, match="columns \\['psnr'\\], but"):
        read(tmp_path)


def test_records_of_before_the_arms_were_renamed_are_gathered(tmp_path: Path) -> None:
    """And those of arms of another list, such as a study that runs on elsewhere."""
    for arm in ("averaged@1/30", "adc+defaults-but-scales+averaged", "frame-0.4-capped+averaged"):
        row = dict.fromkeys(COLUMNS, 1.0)
        record = {"scene": "lego", "arm": arm, "seed": 0, "iterations": 30_000, "points": 200_000}
        record |= {"init": "sfm", "size": "images", "rotated": True, "tiled": 0, "sh_degree": 3}
        record |= {"mean_nu": None, "state_bytes": 1, "peak_rss_bytes": 1, "machine": "m"}
        record |= {"date": "2026-11-25", "finished": True, "curve": [row, row]}
        folder = tmp_path / arm.replace("/", "_")
        folder.mkdir()
        (folder / "record.json").write_text(json.dumps(record), encoding="utf-8")
    found = gather(tmp_path)
    names = {"mcmc+averaged", ADAPTIVE_DEFAULTS, "frame-0.4-capped+averaged"}
    assert {record["arm"] for record in found} == names
    assert [report.is_open(r) for r in found] == [
        r["arm"] in names - {"frame-0.4-capped+averaged"} for r in found
    ]
    write(merge([], found), tmp_path, report.is_open)
    made = report.tables(Study([*STUDY().records(), *read(tmp_path)]))
    assert "200,000, full, degree 3" not in made["every-scene"]  # there is no pair
    assert "`frame-0.4-capped+averaged`" in made["arms"]


def test_an_archived_arm_keeps_its_lines_and_is_not_trained() -> None:
    assert archive()["matrix"].archived
    with pytest.raises(ValueError, match="'matrix' is archived: its records are kept"):
        find_study_arm("matrix")
    assert difference(STUDY(), STUDY().settings(), "matrix").count
    assert not archive().keys() & TRAINED.keys()
    made = report.tables(STUDY())
    for name in (*archive(), *TRAINED):
        trained = any(r.arm == name for r in STUDY().records())
        assert (f"| `{name}` |" in made["arms"]) == trained


@pytest.mark.parametrize(
    "name", ["nonsense", "paper+averaged", "nonsense+averaged", "matrix+averaged"]
)
def test_an_arm_that_cannot_be_trained_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"is unknown; there are mcmc, rates-x2"):
        find_study_arm(name)


@pytest.mark.parametrize("arm", LIST, ids=lambda arm: arm.name)
def test_every_arm_trains(arm: StudyArm) -> None:
    if arm.adaptive:
        pytest.importorskip("gsplat")
    fit = fit_of(arm)(_embedded(), arm, FitOptions(60, 120), 1.1)
    for _ in range(4):
        fit.step()
    assert all(p.isfinite().all() for p in fit.gaussians.values())


def test_a_factor_on_the_positions_is_on_them_alone() -> None:
    stock, longer = (
        Fit(_embedded(), replace(find_study_arm(name), mcmc=False), FitOptions(60, 120))
        for name in (BASELINE, "positions-x3")
    )
    starts = {name: p.detach().clone() for name, p in stock.gaussians.items()}
    for fit in (stock, longer):
        fit.step()
    for name, start in starts.items():
        one, other = (fit.gaussians[name].detach() - start for fit in (stock, longer))
        factor = 3.0 if name == "means" else 1.0
        assert torch.allclose(other, factor * one, rtol=1e-3, atol=1e-6), name


def test_the_readmes_arm_is_all_that_a_new_one_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = Path(report.__file__).with_name("README.md").read_text(encoding="utf-8")
    entry = text.split("```python\n")[1].split("```")[0]
    assert len(entry.splitlines()) == 5
    (made,) = eval(f"({entry})", {**vars(arms)})
    monkeypatch.setitem(TRAINED, made.name, made)
    trained = ["mcmc", made.name, f"{made.name}+averaged"]
    found = plan(tmp_path, tmp_path, ["embedded"], arms=trained)
    assert [t.spec.arm for t in found] == trained
    assert found[-1].trunk == found[1].folder
    fit = Fit(_embedded(), find_study_arm(f"{made.name}+averaged"), FitOptions(60, 120))
    assert fit.phases is not None
    assert [type(part).__name__ for part in fit.phases.parts][:2] == ["Fading", "Averaging"]
    with pytest.raises(ValueError, match="'nonsense' is unknown"):
        plan(tmp_path, tmp_path, ["embedded"], arms=["nonsense"])


def test_a_legend_names_what_one_panel_lacks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    trained = (BASELINE, "a"), (BASELINE, "b"), ("paper", "b")
    study = Study([rotated_record(arm, scene, 0) for arm, scene in trained])
    kept: list[Any] = []
    monkeypatch.setattr(plots.plt, "close", kept.append)
    plots.plot_metrics(study, study.settings(), (BASELINE, "paper"), tmp_path / "one.png")
    (legend,) = kept[0].legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["3DGS-MCMC", "the paper's preset"]


@pytest.mark.parametrize("gain", [3.0, 0.1, -0.1])
def test_the_readmes_curve_is_of_the_seeds_that_both_have(
    gain: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ends = (BASELINE, 0, 20.0), (BASELINE, 1, 22.0), (BASELINE, 2, 90.0)
    ends = *ends, (DEFAULT_ARM, 0, 20.0 + gain), (DEFAULT_ARM, 1, 22.0 + gain)
    study = Study([rotated_record(arm, "a", seed, psnr=psnr) for arm, seed, psnr in ends])
    kept: list[Any] = []
    monkeypatch.setattr(plots.plt, "close", kept.append)
    (setting,) = study.settings()
    plots.plot_one(study, setting, tmp_path / "one.png")
    (figure,) = kept
    (axis,) = figure.axes
    assert [float(line.get_ydata()[-1]) for line in axis.lines] == [21.0, 21.0 + gain]
    first, second = axis.texts
    assert first.get_text() == "3DGS-MCMC, 21.0 dB"
    assert second.get_text() == f"the defaults, {21.0 + gain:.1f} dB"
    figure.canvas.draw()
    assert not first.get_window_extent().overlaps(second.get_window_extent())
    assert (tmp_path / "one.png").stat().st_size > 1000
