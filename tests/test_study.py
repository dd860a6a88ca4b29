"""The study: its page equals its records, its rule the defaults, and its trainings can resume."""

from __future__ import annotations

import inspect
import json
import math
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from splatting.arms import NOISE_LR
from splatting.fit import FitOptions
from splatting.scenes import load_scene
from study import report, steps
from study.analysis import Study
from study.arms import BASELINE, STUDY_ARMS, find_study_arm
from study.decisions import COMPARISONS, decide
from study.fitting import OPACITY_DECAY, SCALE_DECAY, StudyFit
from study.own_statistics import chosen_rows
from study.plan import plan
from study.records import COLUMNS, Record, Setting, gather, merge, read, write
from study.run import main as run_study
from study.tables import machines_line
from study.training import Spec, machine, train
from study.view_angles import nearest_angles
from torch import Tensor

from opt3dgs_optim import Annealing, EnergyHistogram, PhaseScheduler

RECORDS = report.FOLDER / "records.json"


def record(arm: str, scene: str, seed: int, psnr: float, seconds: float = 10.0) -> Record:
    """A straight curve from 10 dB at 0 s."""
    curve = {name: np.array([0.0, 1.0]) for name in COLUMNS}
    curve["seconds"] = np.array([0.0, seconds])
    curve["psnr"] = np.array([10.0, psnr])
    setting = Setting(scene, 100, 3000, "sfm")
    return Record(setting, arm, seed, curve, None, 1, 1, None, "a machine", f"2026-01-0{seed + 1}")


def test_the_pages_are_made_from_the_records() -> None:
    made = report.tables(Study(read(RECORDS)))
    for path in report.PAGES:
        page = path.read_text(encoding="utf-8")
        assert "<!-- study:decisions -->" in page
        assert report.fill(page, made) == page, path


def test_the_defaults_are_what_the_page_concludes() -> None:
    decided = {part: decision.on for part, decision in decide(Study(read(RECORDS))).items()}
    committed = json.loads((report.FOLDER / "decisions.json").read_text(encoding="utf-8"))
    assert committed == decided
    parameters = inspect.signature(PhaseScheduler.__init__).parameters
    whole = {part: on for part, on in decided.items() if "." not in part}
    assert set(whole) <= set(parameters)
    for part, on in whole.items():
        assert bool(parameters[part].default) == on, part
    annealing = Annealing()
    assert (annealing.opacity_peak != annealing.peak) == decided["annealing.opacity_peak"]


def test_the_defaults_are_the_measured_arm() -> None:
    measured = find_study_arm(report.BEST).arm(_embedded()).make
    assert measured is not None
    phases, defaults = measured(300, 1.0, None), PhaseScheduler(300, noise_scale=NOISE_LR)
    parts = ("annealing", "fading", "pooling", "multiplier", "curvature")
    for part in (*parts, "squared_loss", "reset_moments"):
        assert getattr(phases, part) == getattr(defaults, part), part
    peak, opacities = Annealing().peak, Annealing().opacity_peak
    unpooled = f"annealed-{peak:g}-opacities-{opacities:g}+faded"
    assert COMPARISONS["annealing.opacity_peak"][0] == unpooled
    assert COMPARISONS["pooling"][1] == report.BEST


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


@pytest.mark.parametrize(
    "name",
    [
        "visible",
        "annealed+decoupled",
        "annealed+average",
        "annealed-4-0.4+faded+decoupled",
        "annealed-4-0.4+faded+regularisers-0",
        "annealed-4-0.4+faded+regularisers-0.1",
        "annealed-4-0.4+faded-means-1",
        "annealed-4-opacities-1+faded+eps-all-0.1",
        "annealed-4-opacities-1+faded+pooled-all",
        "adamw-gs",
        "noise-visible",
        "noise-hidden",
        "awsgld-fixed-range",
        "awsgld-fixed-temperature",
        "matrix",
    ],
)
def test_arms_train(tmp_path: Path, name: str) -> None:
    made = train(Spec("embedded", name, 0, 60, 80), tmp_path, None, None)
    assert np.isfinite(_psnr(made)).all()


_embedded = cache(lambda: load_scene("embedded"))  # seconds to make


def _fit(arm: str, host: dict[str, object] | None = None, iterations: int = 3000) -> StudyFit:
    found = find_study_arm(arm)
    found = found if host is None else replace(found, host=host)
    return StudyFit(_embedded(), found, FitOptions(iterations, 120))


def _gradients(fit: StudyFit) -> dict[str, Tensor]:
    """Of the regularisers alone; zero where they do not reach."""
    (fit._regularisers() + 0.0 * sum(p.sum() for p in fit.gaussians.values())).backward()
    return {name: param.grad for name, param in fit.gaussians.items() if param.grad is not None}


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("annealed-4-0.4+faded", 1.0),
        ("annealed-4-0.4+faded+regularisers-0.1", 0.1),
        ("annealed-4-0.4+faded+regularisers-0", 0.0),
        ("annealed-4-0.4+faded+decoupled", 0.0),
        ("annealed-4-0.4+faded-means-1", 1.0),
    ],
)
def test_regularisers_in_the_loss(name: str, factor: float) -> None:
    whole, own = _gradients(_fit("mcmc")), _gradients(_fit(name))
    assert whole["scales"].abs().min() > 0
    assert whole["opacities"].abs().min() > 0
    for key, gradient in whole.items():
        torch.testing.assert_close(own[key], factor * gradient)  # one rounding of the factor


def test_a_decay_outside_adam_acts_where_the_regularisers_do_not() -> None:
    with_decay, without = (
        _fit("annealed-4-0.4+faded+decoupled"),
        _fit("annealed-4-0.4+faded+regularisers-0"),
    )
    with_decay.step()
    without.step()
    smaller = {
        name: (without.gaussians[name] - with_decay.gaussians[name]).detach()
        for name in without.gaussians
    }
    opacity = torch.sigmoid(without.gaussians["opacities"].detach())
    wanted = {
        "opacities": OPACITY_DECAY * opacity * (1 - opacity),
        "scales": torch.full_like(smaller["scales"], SCALE_DECAY),
    }
    for name, decay in wanted.items():
        # float32 keeps 1e-6 of a logit or a log of a few units.
        torch.testing.assert_close(smaller.pop(name), decay, rtol=0.0, atol=2e-6)
    assert all(not difference.any() for difference in smaller.values())


def test_a_scheduled_decay_acts_in_its_part_of_the_run() -> None:
    fit = _fit("adamw-gs")
    decayed: dict[float, set[str]] = {}
    for share in (0.0, 0.04, 0.2, 0.49, 0.5, 0.9):
        fit.iteration = round(share * fit.options.iterations)
        before = {name: param.detach().clone() for name, param in fit.gaussians.items()}
        fit._decay()
        decayed[share] = {n for n, p in fit.gaussians.items() if not torch.equal(p, before[n])}
    both = {"opacities", "scales"}
    assert decayed == {0.0: set(), 0.04: {"scales"}, 0.2: both, 0.49: both, 0.5: set(), 0.9: set()}


def test_a_relative_eps_shortens_the_steps_of_small_gradients() -> None:
    fit = _fit("annealed-4-opacities-1+faded+eps-opacities-0.1")
    for _ in range(3):
        fit.step()
    (group,) = fit.optimizers["opacities"].param_groups
    moments = fit.optimizers["opacities"].state[fit.gaussians["opacities"]]["exp_avg_sq"].clone()
    typical = (moments.mean() / (1 - 0.999**3)).sqrt()
    fit.step()
    assert group["eps"] == pytest.approx(0.1 * float(typical), rel=1e-4)
    others = [o.param_groups[0]["eps"] for n, o in fit.optimizers.items() if n != "opacities"]
    assert set(others) == {1e-15}


def test_positions_that_are_not_annealed_step_as_stock_ones() -> None:
    stock, annealed, own = (
        _fit("mcmc"),
        _fit("annealed-4-0.4+faded"),
        _fit("annealed-4-0.4+faded-means-1"),
    )
    start = {name: param.detach().clone() for name, param in stock.gaussians.items()}
    for fit in (stock, annealed, own):
        fit.step()
    # The opacities of the start are far above the noise's gate, so a step is Adam's alone.
    assert torch.equal(own.gaussians["means"], stock.gaussians["means"])
    assert not torch.equal(own.gaussians["means"], annealed.gaussians["means"])
    for name in start.keys() - {"means"}:
        assert torch.equal(own.gaussians[name], annealed.gaussians[name]), name


def test_noise_by_visibility() -> None:
    means: dict[str, Tensor] = {}
    seen = torch.zeros(())
    for name in ("mcmc", "noise-visible", "noise-hidden", "quiet"):
        fit = _fit("mcmc" if name == "quiet" else name)
        with torch.no_grad():
            fit.gaussians["opacities"].fill_(math.log(0.0055 / 0.9945))  # where the gate opens
            fit.gaussians["means"][::3] += 1e3  # where no camera looks
        if name == "quiet":
            fit.noise = None
        torch.manual_seed(5)
        fit.step()
        means[name] = fit.gaussians["means"].detach()
        seen = seen if fit.seen is None else fit.seen
    assert 20 < seen.sum() < 100
    noisy = (means["mcmc"] != means["quiet"]).any(dim=1)
    assert noisy[seen].all()
    assert noisy[~seen].any()
    rows = seen[:, None]
    where = torch.where
    assert torch.equal(means["noise-visible"], where(rows, means["mcmc"], means["quiet"]))
    assert torch.equal(means["noise-hidden"], where(rows, means["quiet"], means["mcmc"]))


@pytest.mark.parametrize(
    ("name", "host", "message"),
    [
        ("mcmc", {"nonsense": 1}, "nonsense.*there are beta2"),
        ("faded", {"regularisers": -0.1}, "regularisers=-0.1, but a number from 0 on"),
        ("faded", {"regularisers": 1.0, "decoupled": True}, "decoupled=True takes them away"),
        ("mcmc", {"noise": "seen"}, "noise='seen', but one of visible, hidden"),
        ("faded", {"noise": "visible"}, "noise='visible', but its optimizers inject"),
    ],
)
def test_bad_host_options_say_what_is_wrong(
    name: str, host: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        _fit(name, host)


def test_range_and_temperature_are_fixed_one_at_a_time() -> None:
    kinds = {}
    for name in ("awsgld", "awsgld-fixed-range", "awsgld-fixed-temperature", "awsgld-fixed"):
        phases = _fit(name).phases
        assert phases is not None
        assert isinstance(phases.multiplier, EnergyHistogram)
        kinds[name] = (phases.multiplier.energy_range, phases.multiplier.temperature)
        assert phases.multiplier.warmup == 250
    assert kinds == {
        "awsgld": ("auto", "auto"),
        "awsgld-fixed-range": ((0.0, 0.2), "auto"),
        "awsgld-fixed-temperature": ("auto", 2e-3),
        "awsgld-fixed": ((0.0, 0.2), 2e-3),
    }


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
    with pytest.raises(ValueError, match="marker study:nonsense"):
        report.fill("<!-- study:nonsense -->\n<!-- end -->", {})


def test_stale_and_fresh_rows_are_found() -> None:
    first = torch.tensor([[0.1, 0.0], [1.0, 1.0], [0.5, 0.0], [0.0, 0.0], [0.01, 0.01]])
    moments = {"exp_avg": first, "exp_avg_sq": torch.tensor([[1.0, 1.0]] * 3 + [[0, 0], [1, 1]])}
    # ratios: 0.005, 1, 0.125, never a gradient, 0.0001
    assert chosen_rows(moments, 0.4, stale=True).tolist() == [4, 0]
    assert chosen_rows(moments, 0.4, stale=False).tolist() == [1, 2]
    assert sorted(chosen_rows(moments, 1.0, stale=True).tolist()) == [0, 1, 2, 4]


@pytest.mark.parametrize("name", ["faded-scales-only", "faded-stale", "faded-fresh"])
def test_fading_of_one_parameter_or_of_chosen_points(name: str) -> None:
    fit = _fit(name, iterations=60)
    changed: dict[str, float] = {}
    for _ in range(6):
        before = {n: _second_moment(fit, n) for n in fit.gaussians}
        fit.step()
        for n, old in before.items():
            # Without an event exp_avg_sq falls by a thousandth at most.
            fallen = (_second_moment(fit, n) < 0.9 * old).reshape(len(old), -1).all(1)
            changed[n] = max(changed.get(n, 0.0), fallen.float().mean().item())
    if name == "faded-scales-only":
        assert changed.pop("scales") > 0.1
        assert set(changed.values()) == {0.0}
    else:
        assert min(changed.values()) > 0.0, changed


def _second_moment(fit: StudyFit, name: str) -> Tensor:
    state = fit.optimizers[name].state.get(fit.gaussians[name], {})
    return state.get("exp_avg_sq", torch.zeros_like(fit.gaussians[name])).clone()


def test_own_steps_have_the_wanted_size() -> None:
    fit = _fit("own-step-2", iterations=200)
    for _ in range(30):
        fit.step()
    for name in ("scales", "sh0"):
        before = fit.gaussians[name].detach().clone()
        (group,) = fit.optimizers[name].param_groups
        wanted = 2.0 * 0.05 ** (fit.iteration / 200) * group["lr"]
        fit.step()
        size = (fit.gaussians[name] - before).square().mean().sqrt().item()
        assert size == pytest.approx(wanted, rel=0.25), name
