"""The study: its page equals its records, its rule the defaults, and its trainings can resume."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splatting.arms import Arm
from splatting.fit import Fit, FitOptions
from splatting.scenes import load_scene
from studies.pages import filled
from studies.scenes import plots, report, steps
from studies.scenes.analysis import Study
from studies.scenes.arms import (
    BASELINE,
    BOTH,
    FADED,
    STOCK_AVERAGED,
    STUDY_ARMS,
    adaptive,
    find_study_arm,
    last_phases,
    whole_trainings,
)
from studies.scenes.arms import DEFAULTS as DEFAULT_ARM
from studies.scenes.decisions import COMPARISONS, MANY_VIEWS_SCENES, decide, every_scene, points_of
from studies.scenes.long_tables import (
    difference,
    headline_table,
    reach_table,
    same_start,
    scenes_gain_table,
    sizes_table,
)
from studies.scenes.parts.own_step import OwnStep
from studies.scenes.parts.step_lengths import StepLengths
from studies.scenes.plan import plan, stages
from studies.scenes.records import COLUMNS, Record, Setting, gather, merge, read, write
from studies.scenes.run import main as run_study
from studies.scenes.tables import machines_line
from studies.scenes.training import Spec, machine, train
from studies.scenes.view_angles import nearest_angles

from opt3dgs_optim import DEFAULTS, DEFAULTS_ADC

RECORDS = report.FOLDER / "records.json"


def record(arm: str, scene: str, seed: int, psnr: float, seconds: float = 10.0) -> Record:
    """A straight curve from 10 dB at 0 s."""
    curve = {name: np.array([0.0, 1.0]) for name in COLUMNS}
    curve["iteration"] = np.array([0.0, 3000.0])
    curve["seconds"] = np.array([0.0, seconds])
    curve["psnr"] = np.array([10.0, psnr])
    setting = Setting(scene, 100, 3000, "sfm")
    return Record(setting, arm, seed, curve, None, 1, 1, None, "a machine", f"2026-01-0{seed + 1}")


def test_the_pages_are_made_from_the_records() -> None:
    made = report.tables(Study(read(RECORDS)))
    made |= report.rotated_tables(report.rotating_study())
    for path in report.PAGES:
        page = path.read_text(encoding="utf-8")
        assert "<!-- study:" in page
        assert filled(page, made, report.MARK, every=False) == page, path


def test_the_page_is_short() -> None:
    assert len(report.PAGE.read_text(encoding="utf-8").split()) <= 2_800


def test_the_defaults_are_what_the_page_concludes() -> None:
    decided = {part: decision.on for part, decision in decide(report.rotating_study()).items()}
    committed = json.loads((report.FOLDER / "decisions.json").read_text(encoding="utf-8"))
    assert committed == decided
    assert {type(part).__name__ for part in DEFAULTS} == {
        part for part, on in decided.items() if on
    }


def test_every_rotated_training_is_of_a_stage() -> None:
    planned = {replace(spec, seed=0) for specs in stages().values() for spec in specs}
    for setting, arm in report.rotating_study()._of:
        if STUDY_ARMS[arm].retired:
            continue
        kind = {name: getattr(setting, name) for name in ("rotated", "size", "views", "tiled")}
        spec = Spec(setting.scene, arm, 0, setting.iterations, setting.points, **kind)
        assert spec in planned, spec


def test_the_defaults_are_the_measured_arm() -> None:
    measured = find_study_arm(DEFAULT_ARM).parts
    assert measured is not None
    assert measured(300, None) == list(DEFAULTS)
    cloning = find_study_arm("adc+defaults-but-scales+averaged").parts
    assert cloning is not None
    assert cloning(300, None) == list(DEFAULTS_ADC)


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
    assert study.cost(setting, BOTH, "faded") == 1.0
    assert study.cost(setting, BOTH) == 1.0


def test_what_averaging_adds_in_the_end_counts_at_equal_seconds() -> None:
    """At 4/5 of the iterations, where its own curve is that of the iterates yet."""
    arms = {"faded": 22.0, DEFAULT_ARM: 22.4, BASELINE: 20.0, STOCK_AVERAGED: 20.1}
    records = [rotated_record(arm, "plush", 0, psnr=psnr) for arm, psnr in arms.items()]
    setting = records[0].setting
    study = Study(records, {("plush", "images_4", 7_500, 0, 0, "faded"): 1.25})
    found = difference(study, [setting], DEFAULT_ARM, STOCK_AVERAGED)
    assert found.cost == 1.25
    assert found.of("psnr")[0] == pytest.approx(0.2 * 10.0 + 0.8 * 22.0 + 0.4 - 20.1)
    found = difference(study, [setting], DEFAULT_ARM, "faded")
    assert found.of("psnr")[0] == pytest.approx(0.4)


def test_a_branch_is_not_compared_with_a_trunk_that_was_trained_again() -> None:
    branch, trunk = (rotated_record(arm, "plush", 0) for arm in ("l2@1/30", BASELINE))
    again = replace(trunk, curve=trunk.curve | {"psnr": trunk.curve["psnr"] + 0.1})
    assert difference(Study([branch, trunk]), [trunk.setting], branch.arm).count == 1
    assert difference(Study([branch, again]), [trunk.setting], branch.arm).count == 0


def test_means_of_iterates_are_of_the_trunks_in_the_records() -> None:
    study = report.rotating_study()
    for ours in study.records():
        if trunk := STUDY_ARMS[ours.arm].averages:
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


def test_every_scene_and_size_has_its_line() -> None:
    arms = ((BASELINE, 20.0), (BOTH, 20.5))
    quarter = [rotated_record(arm, "banana", 0, psnr=psnr) for arm, psnr in arms]
    half = [replace(r, setting=replace(r.setting, size="images_2", points=5_000)) for r in quarter]
    other = rotated_record(BASELINE, "plush", 0)  # has no pair
    unpaired = rotated_record(BOTH, "banana", 1, psnr=30.0)
    study = Study([*quarter, *half, other, unpaired])
    table = scenes_gain_table(study, every_scene(study, 7_500), BOTH, BASELINE)
    ends = "20.00 / 0.700 / 0.200 | 20.50 / 0.700 / 0.200 | +0.50"
    assert table.splitlines()[2:] == [
        f"| banana | 4,000, quarter | {ends} |",
        f"| banana | 5,000, half | {ends} |",
    ]


def test_a_line_compares_arms_of_one_seed() -> None:
    arms = (BASELINE, "faded", BOTH)
    records = [rotated_record(arm, "banana", seed) for arm in arms for seed in (0, 1)]
    others = [rotated_record(arm, "plush", 0) for arm in arms[:2]]
    study = Study([*records, *others])
    table = sizes_table(study, study.all_settings(), [*arms, "own-step"])
    cell = "20.00 / 0.700 / 0.200"
    line = f"| banana | 4,000, quarter, 7,500 | {cell} | {cell} | {cell} | - |"
    assert table.splitlines()[2:] == [line]


def test_when_stocks_quality_is_reached_over_the_seeds_of_both() -> None:
    runs = (BASELINE, 0, 20.0), (BOTH, 0, 30.0), (BASELINE, 1, 28.0)
    study = Study([rotated_record(arm, "a", seed, psnr=psnr) for arm, seed, psnr in runs])
    said = reach_table(study, study.all_settings(), BOTH, [3_000, 5_000])
    assert "| 20.00 dB (1) | x0.50 of its seconds | - | - |" in said
    shorter = rotated_record(BOTH, "a", 0, psnr=21.0)
    shorter = replace(shorter, setting=replace(shorter.setting, iterations=5_000))
    costs = {("a", "images_4", 3_000, 0, 0, BOTH): 1.2}
    both = Study([*study.records(), shorter], costs)
    said = reach_table(both, study.all_settings(), BOTH, [3_000, 5_000])
    assert "| x0.50 of its seconds | - | +1.00 dB in x0.80 |" in said


def test_the_headline_is_of_the_seeds_that_every_line_has() -> None:
    runs = (BASELINE, 0, 20.0), (BASELINE, 1, 28.0), (DEFAULT_ARM, 0, 30.0), (DEFAULT_ARM, 1, 31.0)
    long = [rotated_record(arm, "a", seed, psnr=psnr) for arm, seed, psnr in runs]
    setting = replace(long[0].setting, iterations=3_000)
    short = [replace(r, setting=setting) for r in long if (r.arm, r.seed) != (BASELINE, 1)]
    rest = " / 0.700 / 0.200 |"
    assert headline_table(Study([*long, *short]), [long[0].setting], 3_000).splitlines()[2:] == [
        f"| stock, 7,500 | 20.00{rest}",
        f"| **defaults**, 7,500 | 30.00{rest}",
        f"| stock, 3,000 | 20.00{rest}",
        f"| **defaults**, 3,000 | 30.00{rest}",
    ]


def test_dots_are_the_ends_of_shorter_trainings_of_every_seed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    long = [rotated_record(arm, "a", seed) for arm in (BASELINE, DEFAULT_ARM) for seed in (0, 1)]
    short = replace(long[0].setting, iterations=3_000)
    others = [
        replace(rotated_record(DEFAULT_ARM, "a", s, psnr=20 + s), setting=short) for s in (0, 1)
    ]
    panels: list[Any] = []
    monkeypatch.setattr(plots, "_finish", lambda _figure, axis, _path: panels.append(axis))
    costs = {("a", "images_4", 3_000, 0, 0, FADED): 1.5}
    for known in (others, others[:1]):  # the second without one of the seeds
        study = Study([*long, *known], costs)
        plots.plot_metrics(study, [long[0].setting], (BASELINE, DEFAULT_ARM), tmp_path, [3_000])
    dots = [
        [line.get_xydata() for line in panel.lines if line.get_marker() == "o"] for panel in panels
    ]
    assert np.array(dots[0]).tolist() == [[[0.4 * 1.5, 20.5]]]
    assert dots[1] == []


def test_gain_at_equal_seconds_and_its_spread() -> None:
    records = [
        record(arm, scene, seed, psnr + 0.1 * seed * (arm != BASELINE), seconds)
        for scene in "abcde"
        for seed in range(3)
        for arm, psnr, seconds in ((BASELINE, 20.0, 10.0), ("faded", 22.0, 20.0))
    ]
    study = Study(records)
    gain = study.gain(study.settings(3000), "faded")
    assert gain is not None
    # At 10 s the slower arm is half-way: 10 + 12 / 2 = 16 dB, 0.05 more for each seed.
    assert gain.equal_seconds == pytest.approx(-4.0 + 0.05)
    assert gain.spread == pytest.approx(0.05)
    assert gain.equal_iterations == pytest.approx(2.1)
    assert gain.seconds == pytest.approx(2.0)
    assert gain.reach == pytest.approx(np.mean([20 * 10 / (12 + 0.1 * s) / 10 for s in range(3)]))
    assert gain.verdict == "does not pay"


@pytest.mark.parametrize(
    ("seeds", "gains", "verdict"),
    [
        (3, (0.5, 0.6, 0.7), "pays"),
        (3, (0.1, 0.9, -0.3), "does not pay"),
        (2, (5.0, 5.0), "undecided"),
    ],
)
def test_the_rule(seeds: int, gains: tuple[float, ...], verdict: str) -> None:
    records = [
        record(arm, scene, seed, 20.0 + (gains[seed] if arm != BASELINE else 0.0))
        for scene in "abcde"
        for seed in range(seeds)
        for arm in (BASELINE, "faded")
    ]
    study = Study(records)
    gain = study.gain(study.settings(3000), "faded")
    assert gain is not None
    assert gain.verdict == verdict


def test_the_plan_names_known_arms_and_puts_what_is_needed_first() -> None:
    trainings = plan(Path("scenes"), Path("runs"))
    seen: set[Path] = set()
    for training in trainings:
        assert training.spec.arm in STUDY_ARMS
        assert set(training.needs) <= seen, training
        seen.add(training.folder)
    assert len(seen) == len(trainings)
    assert all(arm.control in STUDY_ARMS for arm in STUDY_ARMS.values())
    with pytest.raises(ValueError, match="nonsense"):
        plan(Path("scenes"), Path("runs"), ["nonsense"])


def test_a_training_resumes_and_branches(tmp_path: Path) -> None:
    spec = Spec("embedded", BASELINE, 0, 40, 120)
    whole = train(spec, _made(tmp_path / "whole"), None, None)
    # Stopped after the evaluation at 20: the record is ahead of the checkpoint, as when killed.
    stopped = _made(tmp_path / "stopped")
    train(spec, stopped, None, None)
    cut = json.loads((stopped / "record.json").read_text(encoding="utf-8"))
    del cut["finished"]
    (stopped / "record.json").write_text(json.dumps(cut), encoding="utf-8")
    (tmp_path / "whole" / "at-30.pt").rename(stopped / "checkpoint.pt")
    again = train(spec, stopped, None, None)
    assert _psnr(again) == _psnr(whole)

    branch = Spec("embedded", "l2@1/4", 0, 40, 120)
    tail = train(branch, _made(tmp_path / "branch"), stopped_trunk(tmp_path, spec), None)
    assert (
        _psnr(tail)[: _iterations(tail).index(30) + 1]
        == (_psnr(whole)[: _iterations(whole).index(30) + 1])
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


def _fit(arm: str, iterations: int = 3000) -> Fit:
    return Fit(_embedded(), find_study_arm(arm), FitOptions(iterations, 120))


def test_records_survive_writing(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    train(Spec("embedded", "faded", 1, 20, 80), tmp_path / "a", None, None)
    train(Spec("embedded", "faded", 1, 20, 80, sh_degree=1), tmp_path / "b", None, None)
    path = tmp_path / "records.json"
    write(merge(gather(tmp_path / "a"), gather(tmp_path / "b")), path)
    one, other = read(path)
    assert (one.arm, one.seed, one.setting.iterations) == ("faded", 1, 20)
    assert one.seconds > 0
    assert other.state_bytes > one.state_bytes
    assert other.setting == replace(one.setting, sh_degree=1)
    assert one.machine == machine()
    assert torch.__version__ in one.machine
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", one.date)
    assert Study([one, other]).settings(20) == [one.setting]
    assert Study([one, other]).settings(20, sh_degree=1) == [other.setting]


def test_the_picture_of_the_steps_is_drawn_from_its_file(tmp_path: Path) -> None:
    committed = report.FOLDER / "steps.json"
    data = json.loads(committed.read_text(encoding="utf-8"))
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", data["date"])
    assert "torch" in data["machine"]
    shutil.copy(committed, tmp_path)
    assert steps.main(["--redraw", "-o", str(tmp_path)]) == 0
    assert (tmp_path / "steps.png").stat().st_size > 10_000


def test_angles_between_views() -> None:
    scene = _embedded()
    first, second = scene.train[:2]
    directions = [
        np.asarray(v.camera.position - scene.points.median(0).values) for v in (first, second)
    ]
    lengths = [np.linalg.norm(d) for d in directions]
    between = math.degrees(math.acos(directions[0] @ directions[1] / math.prod(lengths)))
    assert nearest_angles(replace(scene, train=[first], test=[second])) == pytest.approx(
        [between], rel=1e-3
    )
    assert nearest_angles(replace(scene, test=[first])) == pytest.approx([0.0], abs=0.1)


def test_machines_and_days_are_said() -> None:
    records = [record("mcmc", "a", seed, 20.0) for seed in (2, 0, 1)]
    other = replace(records[0], machine="another", date="2026-02-01")
    assert machines_line([*records, other]) == (
        "3 trainings, 2026-01-01 to 2026-01-03: a machine, one thread each.\n"
        "1 training, 2026-02-01: another, one thread each."
    )


def test_new_records_take_the_place_of_old_ones() -> None:
    def one(seed: int, seconds: float) -> dict[str, object]:
        key = {"scene": "a", "points": 1, "iterations": 2, "init": "sfm", "arm": "mcmc"}
        return {**key, "sh_degree": 0, "seed": seed, "seconds": seconds}

    merged = merge([one(0, 1.0), one(1, 1.0)], [one(2, 2.0), one(1, 2.0)])
    assert merged == [one(0, 1.0), one(1, 2.0), one(2, 2.0)]


def test_bad_calls_say_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_study(["--scenes", str(tmp_path), "--stages", "nonsense"]) == 2
    assert "nonsense" in capsys.readouterr().err
    assert report.main(["--runs", str(tmp_path)]) == 2
    assert "no finished training" in capsys.readouterr().err
    with pytest.raises(ValueError, match="unknown; there are mcmc"):
        find_study_arm("nonsense")


def _own_step_lengths(times: float) -> dict[str, list[float]]:
    """Root mean square of every parameter's first steps, with the trainer's rates so changed."""
    lengths, own = StepLengths(every=1), OwnStep()
    arm = Arm("own", "", lambda _iterations, _nu: [own, lengths])
    fit = Fit(_embedded(), arm, FitOptions(40, 120))
    found: dict[str, list[float]] = {name: [] for name in fit.gaussians}
    fit.rates = {name: times * rate for name, rate in fit.rates.items()}
    for optimizer in fit.optimizers.values():
        optimizer.param_groups[0]["lr"] *= times
    for iteration in range(12):
        rates = {name: o.param_groups[0]["lr"] for name, o in fit.optimizers.items()}
        fit.step()
        # The Gaussians begin round: nothing turns them in the first step.
        for name, rows in lengths.rows.items() if iteration > 2 else []:
            length = rows[-1] * rates[name]
            # Points that no view has seen yet stand still, and do not count as steps.
            assert 0.3 < length / own.wanted(name, iteration / 40) < 1.5, (name, iteration)
            found[name].append(length)
    return found


def test_own_steps_have_the_wanted_size_whatever_the_rates() -> None:
    usual = _own_step_lengths(1.0)
    for times in (0.1, 0.3, 3.0, 10.0):
        for name, lengths in _own_step_lengths(times).items():
            # Lengths are rounded to 1e-5 of a rate.
            assert lengths == pytest.approx(usual[name], rel=1e-2), (name, times)


def test_own_steps_resume(tmp_path: Path) -> None:
    whole, resumed = _fit("own-step", 60), _fit("own-step", 60)
    for _ in range(25):
        whole.step()
    whole.save(tmp_path / "at.pt")
    resumed.load(tmp_path / "at.pt")
    for fit in (whole, resumed):
        for _ in range(10):
            fit.step()
    assert all(torch.equal(p, resumed.gaussians[n]) for n, p in whole.gaussians.items())


def test_a_retired_arm_is_drawn_but_not_trained() -> None:
    assert STUDY_ARMS["matrix"].retired
    with pytest.raises(ValueError, match="'matrix' is retired: its records are kept"):
        find_study_arm("matrix")
    study = Study(read(RECORDS))
    assert study.gains(study.settings(report.SHORT), ["matrix"])


def test_every_arm_with_code_is_listed() -> None:
    coded = [*whole_trainings(), *(arm.name for arm in (*last_phases(), *adaptive()))]
    assert not [name for name in coded if name not in STUDY_ARMS or STUDY_ARMS[name].retired]
