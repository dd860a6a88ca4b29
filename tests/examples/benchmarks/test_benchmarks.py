"""The study: one command trains a line of the evidence, one adds it, one makes the page."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from benchmarks import evidence, open_end, report, steps, train

needs_gsplat = pytest.mark.skipif(
    importlib.util.find_spec("gsplat") is None, reason="gsplat is not installed"
)
TINY = ["--scene", "embedded", "--arm", "defaults", "--iterations", "20", "--points", "60"]


def line(**changes: Any) -> dict[str, Any]:
    made = {"scene": "lego", "size": "images_2", "arm": "stock", "iterations": 30_000}
    made |= {"density": "relocation"}
    made |= {"points": 50_000, "sh_degree": 0, "seed": 0, "psnr": 30.0, "ssim": 0.9, "lpips": 0.1}
    made |= {"seconds": 1.0, "device": "a CPU", "date": "2026-11-27", "command": "train"}
    return made | changes


def stopped_and_whole(
    monkeypatch: pytest.MonkeyPatch, folder: Path, *words: str
) -> list[dict[str, Any]]:
    """The records of two trainings, of which one was stopped after iteration 11 and went on."""
    step, paths = train.Fit.step, [folder / "stopped.json", folder / "whole.json"]

    def until(fit: train.Fit) -> torch.Tensor:
        if fit.iteration == 11:
            raise KeyboardInterrupt
        return step(fit)

    monkeypatch.setattr(train.Fit, "step", until)
    assert train.main([*TINY, *words, "-o", str(paths[0])]) == 130
    monkeypatch.setattr(train.Fit, "step", step)
    assert 0 < json.loads(paths[0].read_text())["curve"][-1]["iteration"] < 11
    for path in paths:
        assert train.main([*TINY, *words, "-o", str(path)]) == 0
    return [json.loads(path.read_text()) for path in paths]


def without_seconds(record: dict[str, Any]) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k != "seconds"} for row in record["curve"]]


def test_a_stopped_training_goes_on_and_becomes_a_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one, other = stopped_and_whole(monkeypatch, tmp_path)
    assert without_seconds(one) == without_seconds(other)
    assert [row["iteration"] for row in one["curve"]] == list(range(0, 21, 2))
    found = evidence.line_of(other)
    assert found["psnr"] == other["curve"][-1]["psnr"]
    assert found["command"] == (
        "python examples/benchmarks/train.py --scene embedded --arm defaults --size images_4 "
        "--iterations 20 --points 60 --seed 0"
    )


def test_a_training_without_a_planned_end_is_ended_at_several_lengths(tmp_path: Path) -> None:
    """What comes after an end does not depend on it."""
    options = ["--scene", "embedded", "--points", "60"]
    for ends in (["60", "90"], ["90"]):
        out = tmp_path / str(len(ends))
        assert open_end.main([*ends, *options, "-o", str(out)]) == 0
        assert sorted(path.name for path in out.iterdir()) == [
            f"embedded-images_4-0-{end}.json" for end in ends
        ]
    last = "embedded-images_4-0-90.json"
    one, other = (json.loads((tmp_path / n / last).read_text()) for n in ("1", "2"))
    for each in (one, other):
        del each["curve"][0]["seconds"]
    assert one["curve"] == other["curve"]
    line = evidence.line_of(json.loads((tmp_path / "2" / last).read_text()))
    assert (line["arm"], line["iterations"]) == ("open-end", 90)
    assert line["command"] == (
        "python examples/benchmarks/open_end.py 60 90 --scene embedded --size images_4 "
        "--points 60 --seed 0"
    )


@pytest.mark.parametrize("ends", [["90", "60"], ["59"], ["60", "60"]])
def test_ends_that_do_not_ascend_are_refused(ends: list[str], tmp_path: Path, capsys: Any) -> None:
    assert open_end.main([*ends, "--points", "60", "-o", str(tmp_path)]) == 2
    assert "ascending numbers" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("main", "words"),
    [
        (open_end.main, ["60", "--density", "clone-and-split"]),
        (open_end.main, ["60", "--arm", "stock"]),
        (train.main, ["--arm", "open-end"]),
    ],
)
def test_what_the_other_command_trains_is_refused(main: Any, words: list[str]) -> None:
    with pytest.raises(SystemExit):
        main(words)


def test_seed_and_views_say_what_is_trained_on(tmp_path: Path) -> None:
    parsed = train.parser().parse_args(["--seed", "2", "--views", "5"])
    scene = train.scene_of(parsed)
    assert [view.name for view in scene.test] == [f"view_{i:02d}" for i in (2, 9, 16, 23)]
    assert [view.name for view in scene.train] == [f"view_{i:02d}" for i in (0, 5, 11, 17, 22)]
    words = [*TINY, "--views", "99", "-o", str(tmp_path / "x.json")]
    assert train.main(words) == 2


def test_a_folder_that_cannot_be_written_to_is_refused_before_the_training(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(train.Fit, "step")
    assert train.main([*TINY, "-o", "/proc/x.json"]) == 2


def test_lines_are_replaced_and_kept_in_order(tmp_path: Path) -> None:
    path = tmp_path / "evidence.jsonl"
    evidence.add([line(seed=1), line(psnr=31.0), line(views=14)], path)
    evidence.add([line(psnr=32.0), line(arm="defaults")], path)
    lines = evidence.read(path)
    assert [(x["arm"], x["seed"], x["views"], x["psnr"]) for x in lines] == [
        ("defaults", 0, 0, 30.0),
        ("stock", 0, 0, 32.0),
        ("stock", 1, 0, 30.0),
        ("stock", 0, 14, 30.0),
    ]
    assert "rotated" not in path.read_text()


def test_gains_are_of_seeds_that_both_have() -> None:
    stock = [line(seed=s, psnr=p) for s, p in ((0, 30.0), (1, 20.0))]
    ours = [line(arm="defaults", seed=s, psnr=p) for s, p in ((1, 21.0), (2, 40.0))]
    assert report.gained(ours, stock).startswith("+1.00 / ")
    assert report.gained(ours, stock).endswith("(1 seed)")
    assert report.gained([], stock) == "not trained"
    assert report.gained(ours, ours[:0]) == report.gained(ours[1:], stock) == "not trained"
    assert report.shown(stock) == "25.00 / 0.9000 / 0.1000 (2 seeds)"
    assert report.gained(stock, stock) == "0.00 / 0.0000 / 0.0000 (2 seeds)"


def test_the_pages_are_made_of_the_evidence() -> None:
    """What stands in their tables is what `report.py` writes."""
    for path in report.PAGES:
        page = path.read_text(encoding="utf-8")
        assert report.filled(page) == page
    with pytest.raises(ValueError, match="evidence:nothing, but there are"):
        report.filled("<!-- evidence:nothing --><!-- end -->")


def readme() -> str:
    return " ".join((report.ROOT / "README.md").read_text(encoding="utf-8").split())


def test_the_readme_says_where_a_third_of_the_iterations_is_enough() -> None:
    whole = [(scene, report.WHOLE, report.MANY) for scene in ("bonsai", "lego", "train")]
    half = [(scene, report.HALF, report.THIRD) for scene in (*report.MAIN, "train")]
    for scene, those, run in (*whole, *half):
        stock, ours = report.third(scene, "relocation", those, run)
        assert report.gain(ours, stock)["psnr"] > 0, scene
        assert len(stock) == (1 if those is report.WHOLE else 3)
    said = "on all three scenes 800 pixels wide and more"
    part = "(one seed, [`Harmonics`](#plan-a-shorter-training) added), and on all four of 320"
    end = "to 489 (means of three seeds)."
    assert f"10,000 iterations reach the PSNR of stock's 30,000 {said} {part} {end}" in readme()
    without = {
        s: report.mean(report.of(report.THIRD, s, **report.WHOLE))["psnr"] for s, _, _ in whole
    }
    said = f"(bonsai without: {without['bonsai']:.2f}, train {without['train']:.2f})"
    assert f"with `Harmonics` {said}" in readme()
    bonsai, lego, train = (
        report.mean(report.of(report.MANY, s, **report.WHOLE))["psnr"] - psnr
        for s, psnr in without.items()
    )
    assert f"{bonsai:.1f}" == f"{train:.1f}"
    assert f"gains {bonsai:.1f} dB (bonsai, train) and {abs(lego):.1f} (lego), one seed" in readme()


def test_the_readme_says_what_was_measured() -> None:
    """Its numbers beside the table's are those of the evidence, of steps and of states."""
    words = readme()
    found = []
    for density, run, scenes in (
        (report.RELOCATION, report.STOCK, report.MAIN),
        (report.SPLIT, report.THIRD, ("bonsai", "plush")),
    ):
        for scene in scenes:
            those = {"density": density, **report.HALF}
            short = report.of(report.SHORT, scene, **those)
            assert [x["seed"] for x in short] == [0]
            gained = report.gain(report.of(run, scene, **those), short)
            found.append(f"{gained['psnr']:.1f}")
    said = (
        "loses {}, {} and {} dB with relocation; with clone and split ours gains {} and {} dB over"
    )
    assert f"stock shortened to 10,000 {said.format(*found)} it (bonsai, plush)" in words
    made = json.loads(report.GPU.read_text(encoding="utf-8"))["steps"]["results"]
    ratios = [made[count]["defaults"]["ratio"] for count in ("100000", "1000000", "5000000")]
    assert f"[{100 * min(ratios):.0f} to {100 * max(ratios):.0f} %]" in words
    last = max(row["defaults, last thirtieth"]["ratio"] for row in made.values())
    assert f"up to {100 * last:.0f} % in the last thirtieth" in words
    numbers = 59  # of a Gaussian with harmonics of degree 3
    assert f"{4 * (numbers + 9)} bytes more" in words
    assert f"{4 * 2 * numbers} bytes" in words
    for scene in ("bonsai", "lego", "train"):
        (stock,), (ours,) = report.third(scene, report.RELOCATION, report.WHOLE)
        assert ours["seconds"] / stock["seconds"] == pytest.approx(1 / 3, abs=0.02)
    few = [re.findall(r"\| ([+-][\d.]+) / ", row)[-1] for row in report.few().splitlines()[2:]]
    assert f"lose up to {-min(map(float, few)):.1f} dB (one seed)" in words
    whole = json.loads(report.GPU.read_text(encoding="utf-8"))["iterations"]["results"]
    share = 100 * whole["1000000"]["defaults"]["ratio"]
    assert f"A whole gsplat iteration takes {share:.0f} % of stock's (a million)" in words
    less = []
    for ended in (x for x in report.lines() if x["arm"] == "open-end"):
        those = {k: ended[k] for k in ("size", "points", "seed")}
        (planned,) = report.of(("defaults", ended["iterations"]), ended["scene"], **those)
        less.append(planned["psnr"] - ended["psnr"])
    assert len(less) == 27
    said = "dB below a planned training (small photos, one seed of three)"
    assert f"at worst {max(less):.1f} {said}" in words


def test_the_readme_says_what_clone_and_split_reaches() -> None:
    """With stock's threshold, and with as many Gaussians."""
    words = readme()
    less, same_number, seed_by_seed, more, share = [], [], [], [], []
    for scene, size, equal, trained in (
        ("bonsai", report.HALF, 1.3, 3),
        ("lego", report.HALF, 0.89, 2),
        ("plush", report.HALF, 1.18, 3),
        ("train", report.HALF, 2.0, 1),
        ("bonsai", report.WHOLE, 3.12, 1),
    ):
        those = report.with_split(scene, size)
        stock, ours = report.third(scene, report.SPLIT, those)
        assert len(stock) == trained
        same = report.of(report.THIRD, scene, density=report.SPLIT, **those | {"threshold": equal})
        assert same[0]["gaussians"] == pytest.approx(stock[0]["gaussians"], rel=0.05)
        less.append(-report.gain(ours, stock)["psnr"])
        same_number.append(-report.gain(same, stock)["psnr"])
        for each in (ours, same):
            seed_by_seed += [a["psnr"] - b["psnr"] for a, b in zip(stock, each, strict=True)]
        more.append(sum(x["gaussians"] for x in ours) / sum(x["gaussians"] for x in stock))
        share += [b["seconds"] / a["seconds"] for a, b in zip(stock, ours, strict=True)]
    worst = round(max(less), 1)
    assert round(max(same_number), 1) <= worst
    said = "With [clone and split](docs/evidence.md#with-clone-split-and-reset), 10,000 end at most"
    assert f"{said} {worst} dB below stock's 30,000" in words
    single = f"single seeds up to {max(seed_by_seed):.1f} below)"
    number = f"with up to {100 * (max(more) - 1):.0f} % more Gaussians, or with as many"
    assert single in words
    assert number in words
    for page in ("inria.md", "gsplat.md"):
        text = " ".join((report.ROOT / "docs/hosts" / page).read_text(encoding="utf-8").split())
        assert f"end at most {worst} dB below stock's 30,000, {number} (means of one to" in text
        assert single in text
    said = f"{100 * min(share):.0f} to {100 * max(share):.0f} % with clone and split"
    assert f"a third of stock's seconds with relocation (800 pixels and more), {said}" in words


def test_the_picture_is_drawn(tmp_path: Path) -> None:
    report.draw(tmp_path / "iterations.png")
    assert (tmp_path / "iterations.png").stat().st_size > 20_000


def test_steps_are_timed_beside_six_adams() -> None:
    device = torch.device("cpu")
    found = steps.measure(64, device, ["six Adams", "defaults", "the paper's exploitation"], 3)
    assert found["six Adams"]["ratio"] == 1.0
    assert all(row["low"] <= row["ratio"] <= row["high"] for row in found.values())
    # two moments of 59 numbers of four bytes, and six counts of steps
    assert found["six Adams"]["bytes_per_point"] == pytest.approx(472, abs=1)
    assert "| defaults | " in steps.table({64: found})


@needs_gsplat
@pytest.mark.filterwarnings("ignore")  # gsplat's, at its import
def test_splits_are_drawn_as_the_seed_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """gsplat draws them from torch's global generator, whose state a checkpoint keeps."""
    words = ("--density", "clone-and-split", "--iterations", "40")
    one, other = stopped_and_whole(monkeypatch, tmp_path, *words)
    assert without_seconds(one) == without_seconds(other)
    counts = {row["iteration"]: row["num_points"] for row in one["curve"]}
    assert counts[20] > counts[8] > 60


@needs_gsplat
@pytest.mark.filterwarnings("ignore")  # gsplat's, at its import
@pytest.mark.thorough
def test_clone_split_and_resets_are_gsplats_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """It grows from the first refinement on; a reset leaves no opacity above twice the limit."""
    fit = train.fit_of(
        train.load_scene("embedded"),
        train.find_arm("defaults"),
        train.FitOptions(700, 200),
        "clone-and-split",
    )
    strategy = fit.density.strategy  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setattr(strategy, "reset_every", 650)
    counts = []
    while fit.iteration < 651:
        fit.step()
        counts.append(len(fit.gaussians["means"]))
    assert set(counts[:600]) == {200}
    assert counts[-1] > 220
    assert float(torch.sigmoid(fit.gaussians["opacities"].detach()).max()) < 0.0101
    assert fit.relocated == 0
