"""`adaptive=True` on a scene in which each part can be made useless, one at a time."""

from __future__ import annotations

import copy
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.multiprocessing as mp
from adaptive_scene import POINTS, SHORTENED, SWITCH, TOTAL, Scene, Training
from test_distributed import free_port
from torch import distributed
from trainers import edit_rows

from opt3dgs_optim import EnergyHistogram, PhaseScheduler, _adaptive
from opt3dgs_optim._evidence import largest_noise
from opt3dgs_optim.lqnadam import EPOCH, HISTORY, CurvatureOptions
from opt3dgs_optim.multiplier import ConstantMultiplier
from opt3dgs_optim.noise import covariance_noise
from opt3dgs_optim.runs import RunLog, read_run

ALL = frozenset({"multiplier", "curvature", "noise"})


@pytest.fixture(autouse=True)
def short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same decisions after a fifth of the iterations."""
    for name, value in SHORTENED.items():
        monkeypatch.setattr(_adaptive, name, value)


USELESS = {
    "multiplier": Scene(range=(5.0, 6.0)),  # all energies below the range: nu is 1
    "curvature": Scene(views_disagree=1.0),
    "noise": Scene(opacity=2.0),
}


@pytest.mark.parametrize("layout", ["dict", "single"])
def test_where_every_part_is_of_use_all_stay_on(layout: str) -> None:
    watched = Training(Scene(), layout).run(TOTAL)
    assert watched.phases.switched_off == {}
    assert HISTORY in watched.positions_state
    plain = Training(Scene(), layout, adaptive=False).run(TOTAL)
    for name, param in plain.splats.items():
        assert torch.equal(param, watched.splats[name])  # watching changes nothing


@pytest.mark.parametrize("layout", ["dict", "single"])
@pytest.mark.parametrize("part", USELESS)
def test_a_useless_part_alone_is_switched_off(part: str, layout: str) -> None:
    training = Training(USELESS[part], layout)
    histogram = training.phases.multiplier
    training.run(TOTAL)
    assert set(training.phases.switched_off) == {part}
    assert len(training.phases.switched_off[part]) > 20  # a sentence
    assert (HISTORY in training.positions_state) == (part != "curvature")
    assert (training.phases.multiplier is histogram) == (part != "multiplier")
    assert (training.phases.noise is None) == (part == "noise")


def test_all_at_once_is_then_plain_adam() -> None:
    useless = Scene(range=(5.0, 6.0), views_disagree=1.0, opacity=2.0)
    training = Training(useless).run(TOTAL)
    assert set(training.phases.switched_off) == ALL
    assert training.phases.accepted_share is None
    expected = Training(
        replace(useless, pairs=None, noise_scale=0.0), multiplier=None, adaptive=False
    ).load(_plain_state(training))
    training.run(TOTAL + 1)
    expected.step()
    for name, param in expected.splats.items():
        assert torch.equal(param, training.splats[name])


def _plain_state(training: Training) -> dict[str, Any]:
    """The checkpoint without what only an adaptive scheduler can take."""
    saved = training.save()
    for state in saved["optimizers"]:
        shared = state["param_groups"][0]["opt3dgs"]["scheduler"]
        del shared["adaptive"]
        shared["multiplier"] = None
    return saved


# -- the multiplier ------------------------------------------------------------------------------


def sloped(nu: float) -> EnergyHistogram:
    """A histogram whose weights rise evenly, and hardly change: nu is this in all partitions."""
    histogram = EnergyHistogram(20, (0.0, 2.0), temperature=0.5, warmup=0, step_size=1e-9)
    slope = (nu - 1) / (histogram.zeta * 0.5) * 0.1
    weights = torch.softmax(slope * torch.arange(20, dtype=torch.float64), 0)
    state = histogram.state_dict()
    histogram.load_state_dict({**state, "weights": weights.tolist()})
    return histogram


def test_a_constant_nu_becomes_that_constant() -> None:
    training = Training(Scene(pairs=None, noise_scale=0.0), multiplier=sloped(1.5)).run(106)
    constant = training.phases.multiplier
    assert isinstance(constant, ConstantMultiplier)
    # The weights move by 1e-9 in each step.
    assert constant.value == pytest.approx(1.5, abs=1e-4)
    plain = Training(Scene(pairs=None, noise_scale=0.0), multiplier=sloped(1.5), adaptive=False)
    plain.run(106)
    # nu differs by 1e-4 relative, in steps of 0.02: the trajectory goes on without a jump.
    torch.testing.assert_close(training.splats["means"], plain.splats["means"], atol=1e-3, rtol=0)
    assert "1.5" in training.phases.switched_off["multiplier"]


def test_a_nu_that_would_always_go_uphill_is_not_kept() -> None:
    scene = Scene(pairs=None, noise_scale=0.0, concave=True)  # uphill leads to the middle
    training = Training(scene, multiplier=sloped(-0.5)).run(106)
    assert "multiplier" in training.phases.switched_off
    assert training.phases.multiplier is None


def test_energies_above_the_range_are_waited_for() -> None:
    training = Training(Scene(range=(0.0, 0.2), pairs=None, noise_scale=0.0)).run(SWITCH)
    assert float(training.phases.multiplier.weights[-1]) > 0.5  # pyright: ignore
    assert training.phases.switched_off == {}


def test_a_constant_that_the_user_asked_for_stays() -> None:
    training = Training(Scene(pairs=None, noise_scale=0.0), multiplier=2.0).run(SWITCH)
    assert training.phases.switched_off == {}


def test_the_histogram_leaves_no_tensors_behind() -> None:
    training = Training(Scene(range=(5.0, 6.0), energy="view_centered"))
    histogram: Any = training.phases.multiplier
    training.run(106)
    assert "multiplier" in training.phases.switched_off
    assert histogram.state_dict()["views"]["views"] == []
    assert histogram.num_observed == 0


# -- curvature -----------------------------------------------------------------------------------


def test_hardly_any_accepted_pair() -> None:
    training = Training(Scene(concave=True, noise_scale=0.0)).run(TOTAL)
    assert "accepted" in training.phases.switched_off["curvature"]


@pytest.mark.parametrize(
    "options",
    [
        CurvatureOptions(pair_dtype="bfloat16"),
        CurvatureOptions(history_size=2),
        CurvatureOptions(pairs="epoch", epoch_steps=7),
    ],
    ids=["bfloat16", "small", "epoch"],
)
def test_other_kinds_of_pairs_are_judged_as_well(options: CurvatureOptions) -> None:
    useful = Training(Scene(pairs=options, noise_scale=0.0)).run(TOTAL)
    assert "curvature" not in useful.phases.switched_off


# -- noise ---------------------------------------------------------------------------------------


def test_the_size_of_the_noise_is_that_of_the_noise() -> None:
    draw = torch.Generator().manual_seed(0)
    scales = torch.randn(50, 3, generator=draw) * 0.3 - 2
    quats, opacities = torch.randn(50, 4, generator=draw), torch.randn(50, generator=draw) - 5
    eta = torch.randn(4000, 50, 3, generator=draw)
    noise = torch.stack([covariance_noise(scales, quats, opacities, each) for each in eta])
    covariance = torch.einsum("snd,sne->nde", noise, noise) / len(eta)
    longest = torch.linalg.eigvalsh(covariance)[:, -1].sqrt().max()
    # 4,000 draws: the deviation is known to 1 / sqrt(8000) = 1.1 %, its largest of 50 to 5 %.
    assert float(largest_noise(scales, opacities, 10.0)) == pytest.approx(
        10 * float(longest), rel=0.05
    )


def test_noise_comes_back_with_the_first_transparent_point() -> None:
    training = Training(USELESS["noise"]).run(50)
    assert training.phases.noise is None
    with torch.no_grad():  # it drifts there: seen at the next check
        training.splats["opacities"][3] = -5.3
    training.run(59)
    assert training.phases.noise is None
    training.run(60)
    assert training.phases.noise is not None
    assert training.phases.switched_off == {}


def test_noise_comes_back_with_density_control_at_once() -> None:
    training = Training(USELESS["noise"]).run(50)
    rows = torch.arange(POINTS - 4)
    edit_rows(training.splats, training.optimizers, rows, 4)
    training.run(56)
    assert training.phases.noise is None  # an edit alone is no reason
    with torch.no_grad():
        training.splats["opacities"][5] = -5.3
    edit_rows(training.splats, training.optimizers, rows, 4)
    training.run(57)
    assert training.phases.noise is not None
    with torch.no_grad():
        training.splats["opacities"].fill_(2.0)
    training.run(60)
    assert "noise" in training.phases.switched_off  # and rests again


# -- one view ------------------------------------------------------------------------------------


def test_one_view_needs_no_centring_and_no_epochs() -> None:
    pairs = CurvatureOptions(pairs="epoch", epoch_steps=7)
    scene = Scene(views=1, energy="view_centered", pairs=pairs, noise_scale=0.0)
    training = Training(scene)
    histogram: Any = training.phases.multiplier
    training.run(64)
    assert {"view_centering", "epoch_pairs"} <= set(training.phases.switched_off)
    if histogram is training.phases.multiplier:
        assert histogram.energy == "raw"
    training.run(SWITCH + 30)
    assert EPOCH not in training.positions_state
    assert HISTORY in training.positions_state
    assert training.phases.curvature_options.pairs == "consecutive"


def test_a_second_view_brings_centring_back() -> None:
    histogram = EnergyHistogram(20, (0.0, 2.0), temperature=0.05, warmup=20, energy="view_centered")
    phases = PhaseScheduler(TOTAL, SWITCH, multiplier=histogram, adaptive=True)
    for _ in range(40):
        phases.observe(1.0, view="left")
    assert histogram.energy == "raw"
    phases.observe(1.0, view="right")
    assert histogram.energy == "view_centered"
    assert "view_centering" not in phases.switched_off


def test_views_that_nobody_names_decide_nothing() -> None:
    pairs = CurvatureOptions(pairs="epoch", epoch_steps=7)
    phases = PhaseScheduler(TOTAL, SWITCH, curvature=pairs, adaptive=True)
    for _ in range(80):
        phases.observe(1.0)
    assert phases.switched_off == {}


# -- cost, reports, state ------------------------------------------------------------------------


def test_it_looks_at_the_device_at_rare_checks_only(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[int] = []
    check = _adaptive.Adaptive._check
    training = Training(Scene())

    def counted(self: Any, device: torch.device) -> None:
        looks.append(self._scheduler.num_observed)
        check(self, device)

    monkeypatch.setattr(_adaptive.Adaptive, "_check", counted)
    training.run(TOTAL)
    # While exploring at most so often, after the switch ten steps apart in so short a phase.
    assert looks == [20, 40, 60, 80, 100, *range(120, TOTAL + 1, 10)]


def test_the_reason_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with RunLog(tmp_path / "log.jsonl") as log, caplog.at_level(logging.INFO, "opt3dgs_optim"):
        training = Training(USELESS["noise"], log=log).run(50)
        with torch.no_grad():
            training.splats["opacities"].fill_(-5.3)
        training.run(64)
    events = [e for e in read_run(tmp_path / "log.jsonl").events if "switched" in e["event"]]
    assert [(e["event"], e["part"], e["iteration"]) for e in events] == [
        ("switched_off", "noise", 19),
        ("switched_on", "noise", 59),
    ]
    assert "opacity gate" in events[0]["reason"]
    assert [record.levelname for record in caplog.records] == ["INFO", "INFO"]


@pytest.mark.parametrize(
    ("part", "cut", "layout"),
    [
        *(("all", cut, "dict") for cut in (19, 50, 99, 100, 125, 165)),
        *(("none", cut, "single") for cut in (50, 125)),
        *(("all", cut, "single") for cut in (50, 125)),
        ("noise", 21, "dict"),
    ],
)
def test_a_resumed_run_is_the_same_bit_for_bit(part: str, cut: int, layout: str) -> None:
    every = Scene(range=(5.0, 6.0), views_disagree=1.0, opacity=2.0)
    scene = {"all": every, "none": Scene()}.get(part) or USELESS[part]
    whole = Training(scene, layout).run(cut)
    saved = whole.save()
    again = Training(scene, layout).load(saved)
    assert dict(again.phases.switched_off) == dict(whole.phases.switched_off)
    torch.manual_seed(1)
    whole.run(TOTAL)
    torch.manual_seed(1)
    again.run(TOTAL)
    assert dict(again.phases.switched_off) == dict(whole.phases.switched_off)
    for name, param in whole.splats.items():
        assert torch.equal(param, again.splats[name]), name
    assert (HISTORY in whole.positions_state) == (HISTORY in again.positions_state)


def test_an_edit_just_before_a_checkpoint_is_not_forgotten() -> None:
    training = Training(USELESS["noise"]).run(50)
    with torch.no_grad():
        training.splats["opacities"][5] = -5.3
    edit_rows(training.splats, training.optimizers, torch.arange(POINTS - 4), 4)
    again = Training(USELESS["noise"]).load(training.save())
    for each in (training, again):
        each.run(51)
        assert each.phases.noise is not None


def test_rewinding_brings_parts_back() -> None:
    scene = Scene(range=(5.0, 6.0), views_disagree=1.0, opacity=2.0)
    training = Training(scene).run(15)
    early = training.save()
    expected = Training(scene).load(early).run(TOTAL)
    training.run(TOTAL)
    assert training.phases.multiplier is None
    training.load(early)
    assert training.phases.switched_off == {}
    assert training.phases.curvature
    training.run(TOTAL)
    for name, param in expected.splats.items():
        assert torch.equal(param, training.splats[name])


def test_checkpoints_between_adaptive_and_not() -> None:
    plain = Training(Scene(), adaptive=False).run(60)
    assert "adaptive" not in plain.phases.state_dict()  # as it was before there was such a thing
    watched = Training(Scene()).load(plain.save()).run(TOTAL)
    assert watched.phases.switched_off == {}
    decided = Training(USELESS["multiplier"]).run(106)
    with pytest.raises(ValueError, match=r"switched off multiplier.*adaptive=True is needed"):
        Training(USELESS["multiplier"], adaptive=False).load(decided.save())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("pairs", [1.0]),
        ("windows", [[1.0]]),
        ("windows", None),
        ("probes", -1),
        ("switched_off", ["noise"]),
        ("switched_off", {"renderer": "slow"}),
        ("constant", None),
    ],
)
def test_a_damaged_state_changes_nothing(key: str, value: Any) -> None:
    training = Training(USELESS["multiplier"]).run(106)
    state = training.phases.state_dict()
    before = copy.deepcopy(state)
    state["adaptive"] = {**state["adaptive"], key: value}
    with pytest.raises(ValueError, match="adaptive"):
        training.phases.load_state_dict(state)
    assert training.phases.state_dict() == before


def test_copies_go_on_alike() -> None:
    training = Training(USELESS["noise"]).run(50)
    other = copy.deepcopy(training)
    for each in (training, other):
        torch.manual_seed(3)
        each.run(TOTAL)
    assert torch.equal(training.splats["means"], other.splats["means"])
    assert training.phases.switched_off is not other.phases.switched_off


def test_adaptive_is_a_flag() -> None:
    with pytest.raises(ValueError, match=r"adaptive='yes', but True or False"):
        PhaseScheduler(10, adaptive="yes")  # type: ignore[arg-type]
    assert PhaseScheduler(10).switched_off == {}


# -- ranks ---------------------------------------------------------------------------------------


def rank_main(rank: int, port: int, folder: str) -> None:
    """On rank 1 the views disagree and one point is transparent; on rank 0 all is well."""
    torch.set_num_threads(1)
    for name, value in SHORTENED.items():
        setattr(_adaptive, name, value)
    address = f"tcp://127.0.0.1:{port}"
    distributed.init_process_group("gloo", init_method=address, rank=rank, world_size=2)
    scene = Scene(opacity=2.0, views_disagree=1.0 * rank)
    training = Training(scene, process_group=distributed.group.WORLD)
    if rank == 1:
        with torch.no_grad():
            training.splats["opacities"][0] = -5.3
    decided = []
    for until in range(10, TOTAL + 1, 10):
        training.run(until)
        decided.append(sorted(training.phases.switched_off))
    torch.save(decided, f"{folder}/{rank}.pt")
    distributed.barrier()
    distributed.destroy_process_group()


def test_ranks_decide_alike(tmp_path: Path) -> None:
    mp.spawn(rank_main, args=(free_port(), str(tmp_path)), nprocs=2)  # pyright: ignore
    a, b = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    assert a == b
    assert "noise" not in a[0]  # one rank's transparent point is reason enough for all
