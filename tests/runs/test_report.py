"""The report: its numbers against hand-computed ones, its files against each other."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from opt3dgs_optim.runs import RunLog, read_run, report
from opt3dgs_optim.runs.stats import compare, higher_is_better

ABSENT = object()


def write_run(path, arm, seed, points, *, steps=(), metric="psnr", **metadata):
    """A log with evaluations at (iteration, seconds, value) and steps at (iteration, nu)."""
    lines = [
        {
            "kind": "start",
            "iteration": 0,
            "seconds": 0.0,
            "time": "2026-11-21T00:00:00+00:00",
            "machine": "Testix-1, 3 CPUs",
            "metadata": {"arm": arm, **({} if seed is ABSENT else {"seed": seed}), **metadata},
        }
    ]
    for i, nu in steps:
        line = {"kind": "step", "iteration": i, "seconds": float(i), "nu": nu}
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
        write_run(folder / "m0.jsonl", "stock", 0, [(0, 0.0, 19.0), (50, 100.0, 23.0)]),
        write_run(folder / "m1.jsonl", "stock", 1, [(0, 0.0, 21.0), (50, 100.0, 25.0)]),
        write_run(folder / "f0.jsonl", "faded", 0, [(0, 0.0, 19.5), (100, 200.0, 27.5)]),
        write_run(folder / "f1.jsonl", "faded", 1, [(0, 0.0, 20.5), (100, 200.0, 28.5)]),
    ]


def arms_of(runs, metric=None, baseline=None) -> tuple[Any, dict[str, Any]]:
    (comparison,) = compare(runs, metric, baseline)
    return comparison, {arm.name: arm for arm in comparison.arms}


def test_numbers_match_hand_computed_ones(tmp_path):
    comparison, arms = arms_of(two_arms(tmp_path))
    assert comparison.baseline == "stock"
    assert comparison.target == 24.0
    faded = arms["faded"]
    final = faded.numbers["final psnr"]
    assert (final.mean, final.n) == (28.0, 2)
    assert final.error == pytest.approx(0.5)  # sqrt(1/2) of deviation, over sqrt(2)
    # 24 dB: seed 0 after 4.5/8 of 200 s = 112.5 s, seed 1 after 3.5/8 = 87.5 s.
    reached = faded.numbers["seconds to baseline psnr"]
    assert reached.mean == pytest.approx(100.0)
    assert reached.error == pytest.approx(12.5)
    # The baseline's seed 0 ends at 23 dB, below 24; seed 1 passes it at 3/4 of 100 s.
    reached = arms["stock"].numbers["seconds to baseline psnr"]
    assert (reached.mean, reached.n) == (75.0, 1)
    # At 100 s: 23.5 - 23 and 24.5 - 25, paired by seed.
    gain = faded.numbers["psnr gain at equal seconds"]
    assert gain.mean == pytest.approx(0.0)
    assert gain.error == pytest.approx(0.5)
    assert faded.numbers["iterations"].mean == 100
    assert faded.numbers["seconds"].mean == 200.0
    assert arms["stock"].numbers["psnr gain at equal seconds"] is None


def test_another_baseline_and_lower_is_better(tmp_path):
    def run(arm, end):
        points = [(0, 0.0, 0.5), (10, 100.0, end)]
        return write_run(tmp_path / f"{arm}.jsonl", arm, 0, points, metric="lpips")

    runs = [run("stock", 0.3), run("b", 0.1)]
    b = arms_of(runs, "lpips")[1]["b"]
    assert b.numbers["seconds to baseline lpips"].mean == pytest.approx(50.0)
    gain = b.numbers["lpips gain at equal seconds"]
    assert (gain.mean, gain.error) == (pytest.approx(0.2), None)
    comparison, arms = arms_of(runs, "lpips", "b")
    assert comparison.baseline == "b"
    assert arms["stock"].numbers["seconds to baseline lpips"] is None
    assert arms["stock"].numbers["lpips gain at equal seconds"].mean == pytest.approx(-0.2)


# -- which way a metric is better ------------------------------------------------------------------


def test_means_are_shown_of_what_is_no_loss(tmp_path):
    names = {"val1_points": True, "train/loss": False, "l1": False, "psnr": True}
    path = tmp_path / "a.jsonl"
    at = {"iteration": 1, "seconds": 1}
    lines = {"kind": "step", **at, **dict.fromkeys(names, 2.0)}, {"kind": "evaluation", **at}
    path.write_text("".join(json.dumps(line | {"psnr": 2.0}) + "\n" for line in lines))
    numbers = compare([read_run(path)])[0].arms[0].numbers
    assert {name: f"mean {name}" in numbers for name in names} == names


@pytest.mark.parametrize(
    ("names", "direction"),
    [
        ("psnr ssim PSNR val1_psnr test/psnr psnr_val eval.psnr.mean psnr:test", True),
        ("lpips LPIPS lpips_vgg vgg/lpips loss loss/val l1 L2 avg_l1 mae rmse energy", False),
        ("nu accepted points val1_points all1 ssim_loss psnr_loss l 1 \N{SNOWMAN}", None),
    ],
    ids=str,
)
def test_directions_are_known_by_words_and_not_by_substrings(names, direction):
    assert {higher_is_better(name) for name in names.split()} == {direction}


def test_a_metric_whose_direction_is_not_known_is_refused(tmp_path, capsys):
    for arm, end in (("stock", 0.3), ("b", 0.1)):
        points = [(0, 0.0, 0.5), (10, 100.0, end)]
        write_run(tmp_path / f"logs/{arm}.jsonl", arm, 0, points, metric="ssim_loss")
    words = [str(tmp_path / "logs"), "-o", str(tmp_path / "out")]
    for more in ([], ["--metric", "ssim_loss"]):
        assert report.main([*words, *more]) == 2
        assert "whose name says which values are better: there are none" in capsys.readouterr().err


def test_the_metric_that_is_compared_is_one_that_can_be_judged(tmp_path):
    line = {"kind": "evaluation", "iteration": 1, "seconds": 1, "points": 7, "val_psnr": 20.0}
    (tmp_path / "a.jsonl").write_text(json.dumps(line) + "\n")
    assert compare([read_run(tmp_path / "a.jsonl")])[0].metric == "val_psnr"
    only = write_run(tmp_path / "c.jsonl", "c", 0, [(1, 1.0, 0.5)], metric="ssim")
    assert compare([only])[0].metric == "ssim"
    none = write_run(tmp_path / "d.jsonl", "d", 0, [])
    assert compare([none, only])[0].metric == "ssim"
    with pytest.raises(ValueError, match="'psnr': not among those"):
        compare([none])


def test_lines_between_evaluations_are_walked_to_the_first_crossing(tmp_path):
    """From 20 to 26 to 22 to 27 dB: 24 after a second third, and not in the last stretch."""
    ours = [(0, 0.0, 20.0), (1, 3.0, 26.0), (2, 6.0, 22.0), (3, 9.0, 27.0)]
    runs = [
        write_run(tmp_path / "m.jsonl", "stock", 0, [(0, 0.0, 20.0), (1, 5.0, 24.0)]),
        write_run(tmp_path / "x.jsonl", "x", 0, ours),
        write_run(tmp_path / "y.jsonl", "y", 0, [(0, 0.5, 25.0), (1, 1.0, 23.0)]),
    ]
    arms = arms_of(runs)[1]
    assert arms["y"].numbers["seconds to baseline psnr"].mean == 0.5  # from the first on
    numbers = arms["x"].numbers
    assert numbers["seconds to baseline psnr"].mean == pytest.approx(2.0)
    gain = 26.0 - 4.0 * 2 / 3 - 24.0  # where the baseline ends, in the second stretch
    assert numbers["psnr gain at equal seconds"].mean == pytest.approx(gain)


# -- which runs are paired -------------------------------------------------------------------------


def seeded(folder, seeds, arm, end):
    """A run a seed; ABSENT: no such entry."""
    runs = []
    for i, seed in enumerate(seeds):
        points = [(0, 0.0, 20.0), (10, 10.0, end + i)]
        runs.append(write_run(folder / f"{arm}{i}.jsonl", arm, seed, points))
    return runs


@pytest.mark.parametrize(
    ("baseline", "other", "gains"),
    [
        ([ABSENT], [ABSENT], None),  # strangers
        ([None], [None], None),
        ([ABSENT, 0], [ABSENT, 1], None),
        ([0], [0], [5.0]),
        ([0, 1], [1, ABSENT], [4.0]),
        (["0"], [0], [5.0]),  # from a command line
    ],
)
def test_runs_are_paired_by_a_seed_that_both_have(tmp_path, baseline, other, gains):
    runs = [*seeded(tmp_path, baseline, "stock", 20.0), *seeded(tmp_path, other, "x", 25.0)]
    for order in (runs, runs[::-1]):
        comparison = compare(order)[0]
        (arm,) = [each for each in comparison.arms if each.name == "x"]
        found: Any = arm.numbers["psnr gain at equal seconds"]
        if gains is None:
            assert found is None
        else:
            assert (found.mean, found.n) == (pytest.approx(np.mean(gains)), len(gains))


def test_two_runs_of_one_arm_and_seed_are_refused(tmp_path):
    """A run begun anew beside its old log would count twice."""
    for folder, seeds in (("same", [0, 0]), ("words", ["0", 0])):
        runs = seeded(tmp_path / folder, seeds, "x", 25.0)
        with pytest.raises(ValueError, match=r"arm 'x' has two runs of seed 0; one is '.*/x1'"):
            compare(runs)
    assert compare(seeded(tmp_path, [None, None], "x", 25.0))[0].arms[0].runs


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
    assert "75" in cells["stock"]["seconds to baseline psnr"]
    assert "(1 of 2)" in cells["stock"]["seconds to baseline psnr"]
    assert cells["stock"]["psnr gain at equal seconds"] == "baseline"


def picture(path):
    matplotlib_image = pytest.importorskip("matplotlib.image", reason="needs matplotlib")
    return matplotlib_image.imread(path)


def test_picture_opens_and_shows_curves_without_touching_matplotlib(tmp_path):
    matplotlib = pytest.importorskip("matplotlib", reason="needs matplotlib")
    before = dict(matplotlib.rcParams)
    steps = [(i, 1.0) for i in range(10)]
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


def test_empty_log_and_mixed_metrics(tmp_path):
    (tmp_path / "empty.jsonl").write_text("")
    runs = [read_run(tmp_path / "empty.jsonl")]
    runs += [write_run(tmp_path / "a.jsonl", "a", 0, [(1, 1.0, 20.0), (2, 2.0, 21.0)])]
    runs += [write_run(tmp_path / "b.jsonl", "b", 0, [(1, 1.0, 0.5)], metric="ssim")]
    report.write_report(runs, tmp_path / "out", baseline="a")
    text = (tmp_path / "out/report.md").read_text()
    assert "/empty | 1 | – |" in text
    assert "final psnr | final ssim" in text


def test_an_arm_has_one_colour_on_all_scenes_and_the_first_is_the_baselines(tmp_path):
    points = [(1, 1.0, 20.0), (2, 2.0, 21.0)]
    arms = {"x": ("b", "stock", "a"), "y": ("a", "b"), "y/z": ("a", "stock")}
    runs = [
        write_run(tmp_path / scene / f"{arm}.jsonl", arm, 0, points, scene=scene)
        for scene, names in arms.items()
        for arm in names
    ]
    found = compare(runs)
    colours = [{arm.name: arm.colour for arm in each.arms} for each in found]
    assert colours == [{"stock": 0, "b": 1, "a": 2}, {"b": 1, "a": 2}, {"stock": 0, "a": 2}]
    gains = [each.arms[-1].numbers["psnr gain at equal seconds"] for each in found]
    assert [gain is None for gain in gains] == [False, True, False]  # of y there is no baseline
    report.write_report(runs, tmp_path / "out")
    text = (tmp_path / "out/report.md").read_text()
    for scene, names in arms.items():
        assert f"## {scene}\n" in text
        image = picture(tmp_path / f"out/report-{scene.replace('/', '_')}.png")[..., :3]
        for arm, colour in (("b", (0x00, 0x72, 0xB2)), ("a", (0xD5, 0x5E, 0x00))):
            near = np.abs(image * 255 - np.array(colour)).max(axis=-1) < 3
            assert (near.sum() > 100) == (arm in names), (scene, arm)


def test_names_keep_the_table_and_the_lines_whole(tmp_path):
    points = [(1, 1.0, 20.0)]
    runs = [write_run(tmp_path / f"{arm}.jsonl", f"{arm}|x\ny", 0, points) for arm in "ab"]
    report.write_report(runs, tmp_path / "out")
    table = (tmp_path / "out/report.md").read_text().replace("\\|", "&").splitlines()
    table = [line for line in table if line.startswith("|")]
    assert [line.split(" | ")[0] for line in table[2:]] == ["| a&x y", "| b&x y"]
    assert len({line.count("|") for line in table}) == 1


def hide_matplotlib(monkeypatch):
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.mark.processes
def test_command_line(tmp_path):
    two_arms(tmp_path / "logs")
    logs = [tmp_path / "logs" / f"{name}.jsonl" for name in ("m0", "m1")]
    (tmp_path / "faded").mkdir()
    for log in ("f0", "f1"):
        (tmp_path / "logs" / f"{log}.jsonl").rename(tmp_path / "faded" / f"{log}.jsonl")
    words = [tmp_path / "faded", *logs, "-o", tmp_path / "out"]
    call = [sys.executable, "-W", "error", "-m", "opt3dgs_optim", "report", *map(str, words)]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    said = "" if importlib.util.find_spec("matplotlib") else f"{report.NO_PICTURE}\n"
    assert (done.returncode, done.stderr) == (0, said)
    assert (tmp_path / "out/report.md").read_text().count(" | 2 | ") == 2


def test_command_line_without_matplotlib(tmp_path, monkeypatch, capsys):
    hide_matplotlib(monkeypatch)
    two_arms(tmp_path / "logs")
    assert report.main([str(tmp_path / "logs"), "-o", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().err.strip() == report.NO_PICTURE
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["report.md"]
    assert ".png" not in (tmp_path / "out/report.md").read_text()


def test_logs_without_an_arm_go_by_their_folder_and_name(tmp_path):
    """`A/stock/log.jsonl` and `A/ours/log.jsonl` are no two seeds of one arm."""
    for folder, psnr in (("stock", 19.0), ("ours", 26.0)):
        with RunLog(tmp_path / "runs" / folder / "log.jsonl") as log:
            log.evaluation(1, psnr=psnr)
    assert report.main([str(tmp_path / "runs"), "-o", str(tmp_path / "report")]) == 0
    table = (tmp_path / "report" / "report.md").read_text()
    assert "| ours/log |" in table
    assert "| stock/log |" in table


def test_command_line_says_in_one_line_what_is_wrong(tmp_path, capsys):
    two_arms(tmp_path / "logs")
    (tmp_path / "void").mkdir()
    (tmp_path / "file").write_text("{}\n")
    logs, out = str(tmp_path / "logs"), str(tmp_path / "out")
    for arguments, message in (
        ([str(tmp_path / "nowhere"), "-o", out], "No such file or directory"),
        ([str(tmp_path / "void"), "-o", out], "no runs: pass run logs"),
        ([str(tmp_path / "file"), "-o", out], "file, line 1"),
        ([logs, f"{logs}/m0.jsonl", "-o", out], "arm 'stock' has two runs of seed 0"),
        ([logs, "-o", out, "--baseline", "x"], "no such arm; there are faded, stock"),
        ([logs, "-o", out, "--metric", "lpips"], "--metric 'lpips': not among those that a run"),
        ([logs, "-o", str(tmp_path / "file")], "file"),
    ):
        assert report.main(arguments) == 2, arguments
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("every", "unit"), [(1, 1.0), (2, 1.0), (1, 0.0)])
def test_the_report_says_what_the_last_iterations_gained(
    tmp_path: Path, every: int, unit: float
) -> None:
    """Of a log that has the loss of every iteration, above 0."""
    with RunLog(tmp_path / "log.jsonl", metadata={"arm": "mine"}) as log:
        for iteration in range(0, 4_100, every):
            value: Any = 0.1 if iteration < 2_100 else 0.05
            log.step(iteration, loss=unit * value)
        log.evaluation(4_100, psnr=25.0)
    written = report.write_report([read_run(tmp_path / "log.jsonl")], tmp_path / "out")
    said = "The last 2,000 iterations of mine gained 6.02 ± 0.00 dB in the loss"
    assert (said in written[0].read_text()) is (every == unit == 1)
    assert " nan " not in written[0].read_text()
