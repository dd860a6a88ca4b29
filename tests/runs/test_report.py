"""The report: its numbers against hand-computed ones, its files against each other."""

from __future__ import annotations

import html
import importlib.util
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from opt3dgs_optim.runs import RunLog, read_run, report
from opt3dgs_optim.runs.metrics import higher_is_better
from opt3dgs_optim.runs.stats import compare

NAN = "nan"


def write_run(path, arm, seed, points, *, steps=(), metric="psnr", **metadata):
    """A log with evaluations at (iteration, seconds, value) and steps at (iteration, nu, phase)."""
    lines = [
        {
            "kind": "start",
            "iteration": 0,
            "seconds": 0.0,
            "time": "2026-11-21T00:00:00+00:00",
            "command": "train.py --arm x",
            "machine": "Testix-1, 3 CPUs",
            "metadata": {"arm": arm, "seed": seed, **metadata},
        }
    ]
    for i, nu, phase in steps:
        line = {"kind": "step", "iteration": i, "seconds": float(i), "phase": phase, "nu": nu}
        lines.append(line | {"accepted": 0.25})
    for i, seconds, value in points:
        line = {"kind": "evaluation", "iteration": i, "seconds": seconds, metric: value}
        lines.append(line)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return read_run(path)


def two_arms(folder):
    """Baseline: 20 -> 24 dB in 100 s (both seeds +-1); other: 20 -> 28 dB in 200 s (+-0.5)."""
    return [
        write_run(folder / "m0.jsonl", "mcmc", 0, [(0, 0.0, 19.0), (50, 100.0, 23.0)]),
        write_run(folder / "m1.jsonl", "mcmc", 1, [(0, 0.0, 21.0), (50, 100.0, 25.0)]),
        write_run(folder / "f0.jsonl", "faded", 0, [(0, 0.0, 19.5), (100, 200.0, 27.5)]),
        write_run(folder / "f1.jsonl", "faded", 1, [(0, 0.0, 20.5), (100, 200.0, 28.5)]),
    ]


def arms_of(runs, metric=None, baseline=None) -> tuple[Any, dict[str, Any]]:
    (comparison,) = compare(runs, metric, baseline)
    return comparison, {arm.name: arm for arm in comparison.arms}


def test_numbers_match_hand_computed_ones(tmp_path):
    comparison, arms = arms_of(two_arms(tmp_path))
    assert comparison.baseline == "mcmc"
    assert comparison.target == 24.0
    faded = arms["faded"]
    final = faded.numbers["final psnr"]
    assert (final.mean, final.n) == (28.0, 2)
    assert final.std == pytest.approx(np.sqrt(0.5))
    # 24 dB: seed 0 after 4.5/8 of 200 s = 112.5 s, seed 1 after 3.5/8 = 87.5 s.
    reached = faded.numbers["seconds to baseline psnr"]
    assert reached.mean == pytest.approx(100.0)
    assert reached.std == pytest.approx(25 / np.sqrt(2))
    # The baseline's seed 0 ends at 23 dB, below 24; seed 1 passes it at 3/4 of 100 s.
    reached = arms["mcmc"].numbers["seconds to baseline psnr"]
    assert (reached.mean, reached.n) == (75.0, 1)
    # At 100 s: 23.5 - 23 and 24.5 - 25, paired by seed.
    gain = faded.numbers["psnr gain at equal seconds"]
    assert gain.mean == pytest.approx(0.0)
    assert gain.std == pytest.approx(np.sqrt(0.5))
    assert faded.numbers["iterations/s"].mean == 0.5
    assert faded.numbers["seconds"].mean == 200.0
    assert arms["mcmc"].numbers["psnr gain at equal seconds"] is None


def test_a_gain_is_over_the_seeds_that_both_have(tmp_path):
    runs = two_arms(tmp_path)
    for seed, end in ((1, 26.0), (8, 28.0)):
        points = [(0, 0.0, 20.0), (10, 50.0, end)]
        runs += [write_run(tmp_path / f"{seed}.jsonl", "x", seed, points)]
    gain = arms_of(runs)[1]["x"].numbers["psnr gain at equal seconds"]
    assert (gain.mean, gain.std, gain.n) == (pytest.approx(26.0 - 23.0), None, 1)  # at 50 s


def test_another_baseline_and_lower_is_better(tmp_path):
    def run(arm, end):
        points = [(0, 0.0, 0.5), (10, 100.0, end)]
        return write_run(tmp_path / f"{arm}.jsonl", arm, 0, points, metric="lpips")

    runs = [run("mcmc", 0.3), run("b", 0.1)]
    b = arms_of(runs, "lpips")[1]["b"]
    assert b.numbers["seconds to baseline lpips"].mean == pytest.approx(50.0)
    gain = b.numbers["lpips gain at equal seconds"]
    assert (gain.mean, gain.std) == (pytest.approx(0.2), None)
    comparison, arms = arms_of(runs, "lpips", "b")
    assert comparison.baseline == "b"
    assert arms["mcmc"].numbers["seconds to baseline lpips"] is None
    assert arms["mcmc"].numbers["lpips gain at equal seconds"].mean == pytest.approx(-0.2)


# -- which way a metric is better ------------------------------------------------------------------

HIGHER = "psnr ssim train_ssim PSNR val1_psnr test/psnr psnr_val eval.psnr.mean valPSNR psnr2 fps"
HIGHER += " val_1_psnr model1_ssim cc_psnr ms_ssim MS-SSIM mPSNR l1ft_psnr flipped_psnr psnr:test"
LOWER = (
    "lpips LPIPS lpips_vgg vgg/lpips loss loss/val val1_loss L1Loss l1 L2 avg_l1 mae rmse energy"
)
LOWER += " d-ssim D_SSIM dssim losses_total test_error flip lpips2 rgb_loss"
UNKNOWN = (
    "nu accepted points num_points val1_points total metric1 all1 dl1 flipped 1-ssim ssim_loss"
)
UNKNOWN += " psnr_std loss_weight l1_lambda grad_norm psnr_gain seconds_to_psnr best_psnr_iteration"
UNKNOWN += " neg_psnr l 1 \N{SNOWMAN}"


@pytest.mark.parametrize(
    ("names", "direction"), [(HIGHER, True), (LOWER, False), (UNKNOWN, None)], ids=str
)
def test_directions_are_known_by_words_and_not_by_substrings(names, direction):
    assert {name: higher_is_better(name) for name in names.split()} == dict.fromkeys(
        names.split(), direction
    )
    assert higher_is_better("") is None
    assert higher_is_better("1 - SSIM") is None
    assert higher_is_better("PSNR (dB)") is True


def two_arms_by(folder, metric, ends=(0.3, 0.1), **about):
    return [
        write_run(
            folder / f"{arm}.jsonl",
            arm,
            0,
            [(0, 0.0, 0.5), (10, 100.0, end)],
            metric=metric,
            **about,
        )
        for arm, end in zip(("mcmc", "b"), ends, strict=True)
    ]


@pytest.mark.parametrize("metric", ["val1_psnr", "test/lpips", "ssim_loss"])
@pytest.mark.parametrize("told", [None, "higher", "lower"])
def test_the_caller_may_say_the_direction(tmp_path, capsys, metric, told):
    runs = two_arms_by(tmp_path / "logs", metric)
    words = ["--better", told] if told else []
    assert report.main([str(tmp_path / "logs"), "-o", str(tmp_path / "out"), *words]) == 0
    told_as = {None: None, "higher": True, "lower": False}[told]
    better = higher_is_better(metric) if told is None else told_as
    written = report.write_report(runs, tmp_path / "twin", higher_is_better=told_as)[0]
    text = (tmp_path / "out/report.md").read_text()
    assert written.read_text() == text
    comparison, arms = (each := compare(runs, None, None, told_as)[0]), each.arms
    assert comparison.higher_is_better is better
    numbers: dict[str, Any] = dict(arms[1].numbers)
    gain = numbers[f"{metric} gain at equal seconds"]
    reached = numbers[f"seconds to baseline {metric}"]
    if better is None:
        assert (gain, reached) == (None, None)
        assert "are better is not known from its name" in text
        assert "0.1000 |" in text  # the values are shown all the same
    else:
        assert gain.mean == pytest.approx(-0.2 if better else 0.2)
        # 0.3 on the way from 0.5 down to 0.1; from above it is reached at the start.
        assert reached.mean == pytest.approx(0.0 if better else 50.0)
        assert "not known" not in text


NOT_HIGHER: list[Any] = [False, np.bool_(False)]


def test_numpys_truth_is_a_direction_and_a_word_is_none(tmp_path):
    runs = two_arms_by(tmp_path, "ssim_loss")
    twins = [
        report.write_report(runs, tmp_path / type(way).__name__, higher_is_better=way)[
            0
        ].read_text()
        for way in NOT_HIGHER
    ]
    assert twins[0] == twins[1]
    wrong: Any
    for wrong in ("higher", 1, 0.0):
        with pytest.raises(ValueError, match=r"write_report: higher_is_better=.* True, False or"):
            report.write_report(runs, tmp_path / "out", higher_is_better=wrong)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("better", "caption"), [(None, False), (False, True)])
def test_the_picture_says_a_direction_that_is_known(tmp_path, monkeypatch, better, caption):
    pytest.importorskip("matplotlib", reason="needs matplotlib")
    from opt3dgs_optim.runs import plot

    (comparison,) = compare(two_arms_by(tmp_path, "ssim_loss"), None, None, better)
    figure = plot._figure(comparison, "")
    assert ("is better" in figure._supxlabel.get_text()) is caption


def test_the_metric_that_is_compared_is_one_that_can_be_judged(tmp_path):
    lines = [
        {"kind": "evaluation", "iteration": 1, "seconds": 1, "points": 7, "val_psnr": 20.0},
    ]
    (tmp_path / "a.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert compare([read_run(tmp_path / "a.jsonl")])[0].metric == "val_psnr"
    only = write_run(tmp_path / "b.jsonl", "b", 0, [(1, 1.0, 7.0)], metric="points")
    assert compare([only])[0].metric == "points"


def test_means_are_shown_of_what_is_no_loss(tmp_path):
    names = {"val1_points": True, "l1_weight": True, "train/loss": False, "l1": False, "psnr": True}
    path = tmp_path / "a.jsonl"
    line = {"kind": "step", "iteration": 1, "seconds": 1, **dict.fromkeys(names, 2.0)}
    path.write_text(json.dumps(line) + "\n")
    numbers = compare([read_run(path)])[0].arms[0].numbers
    assert {name: f"mean {name}" in numbers for name in names} == names


# -- which runs are paired -------------------------------------------------------------------------


def seeded(folder, seeds, arm, end):
    """A run a seed; ABSENT: no such entry."""
    runs = []
    for i, seed in enumerate(seeds):
        about = {} if seed is ABSENT else {"seed": seed}
        path = folder / f"{arm}{i}.jsonl"
        with RunLog(path, metadata={"arm": arm, **about}) as log:
            log.evaluation(0, psnr=20.0)
            log.evaluation(10, psnr=end + i)
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for line in lines:
            line["seconds"] = float(line["iteration"])
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        runs.append(read_run(path))
    return runs


ABSENT = object()


@pytest.mark.parametrize(
    ("baseline", "other", "gains"),
    [
        ([ABSENT], [ABSENT], None),  # strangers
        ([None], [None], None),
        ([ABSENT, 0], [ABSENT, 1], None),
        ([""], [""], None),
        ([0], [0], [5.0]),
        ([0, 1], [1, ABSENT], [4.0]),
        (["0"], [0], [5.0]),  # from a command line
        ([np.int64(3)], [3.0], [5.0]),
        ([np.float32(2)], ["2 "], [5.0]),
        ([0.5], [0], None),
        ([[1, 2]], [[1, 2]], [5.0]),
        ([True], [1], None),
        ([0, 0], [0], [4.5]),  # the baseline's twice: both count
        ([0], [0, 0], [5.0, 6.0]),
    ],
)
def test_runs_are_paired_by_a_seed_that_both_have(tmp_path, baseline, other, gains):
    runs = [*seeded(tmp_path, baseline, "mcmc", 20.0), *seeded(tmp_path, other, "x", 25.0)]
    for order in (runs, runs[::-1]):
        comparison = compare(order)[0]
        (arm,) = [each for each in comparison.arms if each.name == "x"]
        found: Any = arm.numbers["psnr gain at equal seconds"]
        text = report.as_markdown([comparison], order, [])
        assert ("No gain is shown for x: no run has the `seed`" in text) == (gains is None)
        assert arm.num_paired == len(gains or [])
        if gains is None:
            assert found is None
        else:
            assert (found.mean, found.n) == (pytest.approx(np.mean(gains)), len(gains))


def test_means_of_nu_and_accepted_share(tmp_path):
    steps = [(1, 1.0, "exploration"), (2, 2.0, "exploration"), (3, NAN, "exploitation")]
    run = write_run(tmp_path / "a.jsonl", "a", 0, [(3, 3.0, 20.0)], steps=steps)
    arm = arms_of([run])[1]["a"]
    assert arm.numbers["mean nu"].mean == 1.5
    assert arm.numbers["mean accepted"].mean == 0.25


def test_the_table_shows_the_numbers(tmp_path):
    runs = two_arms(tmp_path)
    _, arms = arms_of(runs)
    report.write_report(runs, tmp_path / "out")
    markdown = (tmp_path / "out/report.md").read_text()
    table = [line for line in markdown.splitlines() if line.startswith("| ")]
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    cells = {row[0]: dict(zip(head, row, strict=True)) for row in rows}
    assert list(cells) == list(arms)
    for name, cell in cells.items():
        assert ["arm", "seeds", *arms[name].numbers] == head
        for heading, stat in arms[name].numbers.items():
            if stat is not None:
                shown = cell[heading].split()[0]
                digits = len(shown.partition(".")[2])
                assert float(shown) == pytest.approx(stat.mean, abs=0.51 * 10**-digits)
    assert "Testix-1, 3 CPUs" in markdown
    assert "75" in cells["mcmc"]["seconds to baseline psnr"]
    assert "(1 of 2)" in cells["mcmc"]["seconds to baseline psnr"]
    assert cells["mcmc"]["psnr gain at equal seconds"] == "baseline"


def picture(path):
    matplotlib_image = pytest.importorskip("matplotlib.image", reason="needs matplotlib")
    return matplotlib_image.imread(path)


def test_picture_opens_and_shows_curves_without_touching_matplotlib(tmp_path):
    matplotlib = pytest.importorskip("matplotlib", reason="needs matplotlib")
    before = dict(matplotlib.rcParams)
    steps = [(i, 1.0, "exploration" if i < 8 else "exploitation") for i in range(10)]
    runs = two_arms(tmp_path)
    runs += [write_run(tmp_path / "$_|.jsonl", "_$x^{", 0, [(9, 9.0, 21.0)], steps=steps)]
    assert report.write_report(runs, tmp_path / "out")[-1].name == "report.png"
    assert dict(matplotlib.rcParams) == before
    image = picture(tmp_path / "out/report.png")[..., :3]
    assert image.shape[1] == 1650
    assert (image[0] == 1).all()  # white margin
    for colour in ((0x33, 0x33, 0x33), (0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):
        near = np.abs(image * 255 - np.array(colour)).max(axis=-1) < 3
        assert near.sum() > 200, colour  # a legend handle and a line at least


@pytest.mark.parametrize(
    ("points", "shown"),
    [([], "– |"), ([(5, 5.0, 20.0)], "20.00"), ([(5, 5.0, 20.0), (9, 9.0, NAN)], "nan")],
)
@pytest.mark.parametrize("others", [False, True])
def test_what_a_run_lacks_shows(tmp_path, points, shown, others):
    steps = [(1, 1.0, "exploration")]
    runs = two_arms(tmp_path) if others else []
    runs += [write_run(tmp_path / "odd.jsonl", "odd", 0, points, steps=steps)]
    report.write_report(runs, tmp_path / "out")
    (row,) = [
        line for line in (tmp_path / "out/report.md").read_text().split("\n") if "odd" in line
    ]
    assert shown in row


def test_empty_log_and_mixed_metrics(tmp_path):
    (tmp_path / "empty.jsonl").write_text("")
    runs = [read_run(tmp_path / "empty.jsonl")]
    runs += [write_run(tmp_path / "a.jsonl", "a", 0, [(1, 1.0, 20.0), (2, 2.0, 21.0)])]
    runs += [write_run(tmp_path / "b.jsonl", "b", 0, [(1, 1.0, 0.5)], metric="ssim")]
    report.write_report(runs, tmp_path / "out", baseline="a")
    text = (tmp_path / "out/report.md").read_text()
    assert "| empty | 1 | – |" in text
    assert "final psnr | final ssim" in text


def test_scenes_get_their_own_table_and_picture(tmp_path):
    points = [(1, 1.0, 20.0), (2, 2.0, 21.0)]
    runs = [write_run(tmp_path / f"{s}.jsonl", "a", 0, points, scene=s) for s in ("x", "y/z")]
    names = [path.name for path in report.write_report(runs, tmp_path / "out")]
    assert names[0] == "report.md"
    assert names[1:] in ([], ["report-x.png", "report-y_z.png"])
    text = (tmp_path / "out/report.md").read_text()
    assert "## x" in text
    assert "## y/z" in text


def test_an_arm_has_one_colour_on_all_scenes_and_the_first_is_the_baselines(tmp_path):
    points = [(1, 1.0, 20.0), (2, 2.0, 21.0)]
    arms = {"x": ("b", "mcmc", "a"), "y": ("a", "b"), "z": ("a", "mcmc")}
    runs = [
        write_run(tmp_path / f"{scene}-{arm}.jsonl", arm, 0, points, scene=scene)
        for scene, names in arms.items()
        for arm in names
    ]
    found = compare(runs)
    colours = [{arm.name: arm.colour for arm in each.arms} for each in found]
    assert colours == [{"mcmc": 0, "b": 1, "a": 2}, {"b": 1, "a": 2}, {"mcmc": 0, "a": 2}]
    assert [each.baseline for each in found] == ["mcmc", None, "mcmc"]
    report.write_report(runs, tmp_path / "out")
    for scene, names in arms.items():
        image = picture(tmp_path / f"out/report-{scene}.png")[..., :3]
        for arm, colour in (("b", (0x00, 0x72, 0xB2)), ("a", (0xD5, 0x5E, 0x00))):
            near = np.abs(image * 255 - np.array(colour)).max(axis=-1) < 3
            assert (near.sum() > 100) == (arm in names), (scene, arm)
    assert "The baseline arm did not run" in (tmp_path / "out/report.md").read_text()


def test_a_report_on_nothing(tmp_path):
    with pytest.raises(ValueError, match="no runs; pass at least one"):
        report.write_report([], tmp_path)


def test_without_psnr_the_first_metric_is_compared(tmp_path):
    run = write_run(tmp_path / "a.jsonl", "a", 0, [(1, 1.0, 0.5)], metric="ssim")
    assert compare([run])[0].metric == "ssim"
    assert compare([write_run(tmp_path / "b.jsonl", "b", 0, [])])[0].metric == "psnr"


MARKUP = "<b>|*x*_y_[z](w)`c` ![i](j) &amp; $e$ ~s~ #"


def test_names_with_markup_are_escaped(tmp_path):
    points = [(1, 1.0, 20.0)]
    about = {"scene": f"{MARKUP}\n# s", "command": f"train.py --beta={MARKUP}"}
    runs = [write_run(tmp_path / f"{MARKUP.replace('/', '')}.jsonl", MARKUP, 0, points, **about)]
    runs += [write_run(tmp_path / "b.jsonl", "1. snake_case", 0, points, metric=MARKUP, **about)]
    report.write_report(runs, tmp_path / "out")
    text = (tmp_path / "out/report.md").read_text()
    for line in text.splitlines():
        if not line.startswith(("Mean ±", "![psnr over seconds and iterations](report.png)")):
            assert not re.search(r"[<>`$~\[\]]|\*|(?<=.)#(?!\d)(?! )", line), line
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in table}) == 1
    assert len(table) == 4
    assert "snake_case" in text
    assert html.unescape(text).count(MARKUP) == 4  # scene, arm, metric, command
    assert "\n# s" not in text


def test_names_in_any_script_and_of_any_length_are_drawn(tmp_path):
    pytest.importorskip("matplotlib", reason="needs matplotlib")
    name = "森林 🌲 \u202e \0 \ud800 $x^{ " + "long " * 100
    steps = [(i, 1.0, name + "ab"[i > 4]) for i in range(10)]
    points = [(1, 1.0, 20.0), (2, 2.0, 21.0)]
    run = write_run(tmp_path / "a.jsonl", name, 0, points, steps=steps, metric=name, scene=name)
    other = write_run(tmp_path / "b.jsonl", "b", 0, points, scene="b")
    written = report.write_report([run, other], tmp_path / "out", metric=name)
    assert all(picture(path).shape[1] == 1650 for path in written[1:])
    assert len(written) == 3


VALUES = st.sampled_from([0, 1, -1.5, 20, 1e200, -1e308, 10**300, "nan", "inf", "-inf", True])
LINES = st.fixed_dictionaries(
    {
        "kind": st.sampled_from(["step", "evaluation"]),
        "iteration": st.sampled_from([0, 1, 7, 2**52]),
        "seconds": st.sampled_from([0, 0.0, 1e-9, 3, 5.5, 9e11]),
    },
    optional={"psnr": VALUES, "loss": VALUES, "nu": VALUES, "phase": st.sampled_from("ab")},
)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(logs=st.lists(st.lists(LINES, max_size=6), min_size=1, max_size=3))
def test_any_readable_log_makes_a_report(tmp_path, monkeypatch, capsys, logs):
    hide_matplotlib(monkeypatch)
    folder = Path(tempfile.mkdtemp(dir=tmp_path))
    for i, lines in enumerate(logs):
        (folder / f"{i}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert report.main([str(folder), "-o", str(folder / "out")]) == 0
    assert (folder / "out/report.md").read_text().startswith("# Error against run time")


def test_extreme_numbers_are_drawn(tmp_path):
    pytest.importorskip("matplotlib", reason="needs matplotlib")
    values = [0.0, 1e200, -1e308, "nan", 1e29, 1e-300]
    points = [(i, 9e11 * i / 6, value) for i, value in enumerate(values)]
    runs = [write_run(tmp_path / f"{i}.jsonl", "a", i, points) for i in range(2)]
    assert picture(report.write_report(runs, tmp_path / "out")[-1]).shape[1] == 1650


def hide_matplotlib(monkeypatch):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)


def test_command_line(tmp_path):
    two_arms(tmp_path / "logs")
    words = [tmp_path / "logs", tmp_path / "logs/m0.jsonl", "-o", tmp_path / "out"]
    call = [sys.executable, "-W", "error", "-m", "opt3dgs_optim", "report", *map(str, words)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    said = "" if importlib.util.find_spec("matplotlib") else f"{report.NO_PICTURE}\n"
    assert (done.returncode, done.stderr) == (0, said)
    assert (tmp_path / "out/report.md").read_text().count(" | 2 | ") == 2  # m0 counts once


def test_command_line_without_matplotlib(tmp_path, monkeypatch, capsys):
    hide_matplotlib(monkeypatch)
    two_arms(tmp_path / "logs")
    assert report.main([str(tmp_path / "logs"), "-o", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().err.strip() == report.NO_PICTURE
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["report.md"]
    assert ".png" not in (tmp_path / "out/report.md").read_text()


BAD_LINES = {
    "digits": b'{"kind":"evaluation","iteration":1,"seconds":1,"psnr":%s}' % (b"9" * 400),
    "empty": b"{}",
}


def test_command_line_says_in_one_line_what_is_wrong_and_writes_nothing(tmp_path, capsys):
    two_arms(tmp_path / "logs")
    (tmp_path / "void").mkdir()
    (tmp_path / "file").write_text("")
    for name, line in BAD_LINES.items():
        (tmp_path / f"{name}.jsonl").write_bytes(line + b"\n")
    for scene in ("a b", "A_b"):
        points = [(1, 1.0, 20.0)]
        write_run(tmp_path / f"scenes/{scene}.jsonl", "a", 0, points, metric="ssim", scene=scene)
    logs, out = str(tmp_path / "logs"), str(tmp_path / "out")
    one_file = "two of the scenes ['A_b', 'a b'] would be drawn into one of"
    for arguments, message in (
        ([str(tmp_path / "nowhere"), "-o", out], "no such file or folder"),
        ([str(tmp_path / "void"), "-o", out], "no *.jsonl file in the folder"),
        *(([str(tmp_path / f"{n}.jsonl"), "-o", out], f"{n}.jsonl, line 1") for n in BAD_LINES),
        ([logs, "-o", out, "--baseline", "x"], "no such arm; there are faded, mcmc"),
        ([logs, "-o", out, "--metric", "lpips"], "--metric 'lpips': in no log; there are psnr"),
        ([str(tmp_path / "scenes"), "-o", out], one_file),
        ([logs, "-o", str(tmp_path / "file")], "file"),
        ([logs, "-o", str(tmp_path / "file" / "folder")], "file"),
    ):
        assert report.main(arguments) == 2, arguments
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_a_place_that_cannot_be_written_is_found_before_any_log_is_read(
    tmp_path, monkeypatch, capsys
):
    def refuse(**_):
        raise PermissionError(13, "Permission denied", str(tmp_path))

    two_arms(tmp_path / "logs")
    monkeypatch.setattr(report, "read_run", pytest.fail)
    monkeypatch.setattr("tempfile.TemporaryFile", refuse)  # root may write anywhere
    assert report.main([str(tmp_path / "logs"), "-o", str(tmp_path / "out")]) == 2
    assert "Permission denied" in capsys.readouterr().err


def test_an_arm_that_is_none_goes_by_the_files_name(tmp_path):
    for name in ("first", "second"):
        with RunLog(tmp_path / f"{name}.jsonl", metadata={"arm": None, "scene": None}) as log:
            log.evaluation(1, psnr=20.0)
    (found,) = compare([read_run(tmp_path / f"{name}.jsonl") for name in ("first", "second")])
    assert {arm.name for arm in found.arms} == {"first", "second"}


def test_logs_of_one_name_go_by_their_folders(tmp_path, capsys):
    """`A/stock/log.jsonl` and `A/ours/log.jsonl` are no two seeds of one arm."""
    for folder, psnr in (("stock", 19.0), ("ours", 26.0)):
        with RunLog(tmp_path / "runs" / folder / "log.jsonl") as log:
            log.evaluation(1, psnr=psnr)
    assert report.main([str(tmp_path / "runs"), "-o", str(tmp_path / "report")]) == 0
    table = (tmp_path / "report" / "report.md").read_text()
    assert "| ours |" in table
    assert "| stock |" in table
    assert "| log |" not in table
    alone = tmp_path / "runs" / "stock"
    assert report.main([str(alone), "-o", str(tmp_path / "report")]) == 0
    assert "| log |" in (tmp_path / "report" / "report.md").read_text()


def test_runs_without_a_scene_have_a_heading_beside_others(tmp_path):
    for name, about in (("a", {"scene": "garden"}), ("b", {}), ("c", {"scene": "attic"})):
        with RunLog(tmp_path / f"{name}.jsonl", metadata=about) as log:
            log.evaluation(1, psnr=20.0)
    assert report.main([str(tmp_path), "-o", str(tmp_path / "report")]) == 0
    text = (tmp_path / "report" / "report.md").read_text()
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings == ["## garden", "## Runs without a scene in their metadata", "## attic"]
