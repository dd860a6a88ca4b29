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
from adaptive_scene import CHECK, SWITCH, TOTAL, Scene, Training, shorten
from ranks import free_port
from torch import Tensor, distributed
from trainers import assert_same

from opt3dgs_optim import Course, Part, PhaseScheduler

HISTORY = "Curvature.history"
USELESS = {"Curvature": Scene(views_disagree=1.0), "GatedNoise": Scene(opacity=2.0)}


@pytest.fixture(autouse=True)
def short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten(monkeypatch)


@pytest.mark.parametrize("layout", ["dict", "single"])
def test_where_every_part_is_of_use_all_stay_on(layout: str) -> None:
    watched = Training(Scene(), layout).run(TOTAL)
    assert watched.phases.switched_off == {}
    assert HISTORY in watched.positions_state
    plain = Training(Scene(), layout, adaptive=False).run(TOTAL)
    assert_same(plain.splats, watched.splats)


@pytest.mark.parametrize("layout", ["dict", "single"])
@pytest.mark.parametrize("part", USELESS)
def test_a_useless_part_alone_is_switched_off(part: str, layout: str) -> None:
    training = Training(USELESS[part], layout).run(TOTAL)
    assert set(training.phases.switched_off) == {part}
    assert len(training.phases.switched_off[part]) > 20  # a sentence
    acting = [type(each).__name__ for each in training.phases.hooks["before"]]
    assert part not in acting
    assert len(acting) == 1


def test_all_at_once_is_then_plain_adam() -> None:
    useless = Scene(views_disagree=1.0, opacity=2.0)
    training = Training(useless).run(TOTAL)
    assert set(training.phases.switched_off) == set(USELESS)
    bare = replace(useless, curvature=False, noise_scale=0.0)
    expected = Training(bare, adaptive=False).load(training.save())
    training.run(TOTAL + 1)
    expected.step()
    assert_same(expected.splats, training.splats)


# -- the evidence of the parts -------------------------------------------------------------------


def test_hardly_any_accepted_pair() -> None:
    training = Training(Scene(concave=True, noise_scale=0.0)).run(TOTAL)
    assert "accepted" in training.phases.switched_off["Curvature"]


def test_a_short_history_is_judged_as_well() -> None:
    useful = Training(Scene(history_size=2, noise_scale=0.0)).run(TOTAL)
    assert "Curvature" not in useful.phases.switched_off


def test_noise_comes_back_with_the_first_transparent_point() -> None:
    training = Training(USELESS["GatedNoise"]).run(50)
    assert training.phases.switched_off
    with torch.no_grad():  # it drifts there: seen at the next look
        training.splats["opacities"][3] = -5.3
    training.run(59)
    assert training.phases.switched_off
    training.run(60)
    assert training.phases.switched_off == {}
    assert training.noise in training.phases.hooks["after"]


# -- what a stranger's part has to say ------------------------------------------------------------


class Judged(Part):
    """Is useless while `bad`."""

    def __init__(self) -> None:
        self.bad, self.asked = False, 0

    def factor(self, group: Any, course: Course) -> float:
        return 2.0

    def evidence(self, course: Course) -> Tensor:
        self.asked += 1
        return torch.tensor([float(self.bad), 7.0])

    def useless(self, evidence: list[float], course: Course) -> str | None:
        assert evidence[1] == 7.0
        return "it was told to be" if evidence[0] else None


def factors(phases: PhaseScheduler) -> list[Any]:
    return [part.factor({}, phases) for part in phases.hooks["factor"]]


def test_a_part_of_ones_own_is_switched_off_and_on() -> None:
    first, second = Judged(), Judged()
    scene = Scene(curvature=False, noise_scale=0.0)
    training = Training(scene, "dict", first, second).run(CHECK)
    assert factors(training.phases) == [2.0, 2.0]
    second.bad = True
    training.run(2 * CHECK)
    assert training.phases.switched_off == {"Judged#2": "it was told to be"}
    assert factors(training.phases) == [2.0]
    first.bad, second.bad = True, False
    training.run(3 * CHECK)
    assert training.phases.switched_off == {"Judged": "it was told to be"}
    assert factors(training.phases) == [2.0]
    first.bad = False
    training.run(4 * CHECK)
    assert training.phases.switched_off == {}
    assert first.asked == second.asked == 4


@pytest.mark.parametrize(
    ("seen", "why", "message"),
    [
        (0.5, None, r"Says\.evidence: 0\.5, but a tensor \[k\]"),
        (torch.tensor(0.5), None, r"Says\.evidence: tensor\(0\.5000\), but a tensor \[k\]"),
        ([0.5], None, r"Says\.evidence: \[0\.5\], but a tensor \[k\]"),
        (torch.ones(1, dtype=torch.complex64), None, r"Says\.evidence: .* of real numbers"),
        (torch.ones(1), True, r"Says\.useless: True, but a reason, or None"),
    ],
)
def test_what_a_part_says_wrongly_is_told_before_any_is_switched_off(
    seen: Any, why: Any, message: str
) -> None:
    class Says(Part):
        def evidence(self, course: Course) -> Any:
            return seen

        def useless(self, evidence: list[float], course: Course) -> Any:
            return why

    other = Judged()
    other.bad = True
    phases = PhaseScheduler(1_000, parts=[other, Says()], adaptive=True)
    with pytest.raises(ValueError, match=message):
        phases.judge()
    assert phases.switched_off == {}


def test_it_looks_at_the_device_at_rare_checks_only() -> None:
    looks: list[int] = []
    training = Training(Scene())
    judge = training.phases.judge

    def counted(over_ranks: Any = None) -> Any:
        looks.append(training.phases.num_observed)
        return judge(over_ranks)

    training.phases.judge = counted  # type: ignore[method-assign]
    training.run(TOTAL)
    # While exploring at most so often, after the switch ten steps apart in so short a phase.
    assert looks == [20, 40, 60, 80, 100, *range(120, TOTAL + 1, 10)]


class Log:
    """What a RunLog is asked for."""

    def __init__(self) -> None:
        self.events: list[tuple[Any, ...]] = []
        self.lines: list[dict[str, Any]] = []

    def step(self, iteration: int, **columns: Any) -> None:
        self.lines.append({"iteration": iteration, **columns})

    def event(self, event: str, iteration: int, *, part: str, reason: str) -> None:
        self.events.append((event, part, iteration, reason))


def test_the_reason_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    log: Any = Log()
    with caplog.at_level(logging.INFO, "opt3dgs_optim"):
        training = Training(USELESS["GatedNoise"], log=log).run(50)
        with torch.no_grad():
            training.splats["opacities"].fill_(-5.3)
        training.run(64)
    assert [event[:3] for event in log.events] == [
        ("switched_off", "GatedNoise", 19),
        ("switched_on", "GatedNoise", 59),
    ]
    assert "opacity gate" in log.events[0][3]
    assert [record.levelname for record in caplog.records] == ["INFO"] * 3  # and the upgrade's


# -- checkpoints -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("part", "cut", "layout"),
    [
        *(("all", cut, "dict") for cut in (19, 50, 109, 125, 165)),
        *(("none", cut, "single") for cut in (50, 125)),
        *(("all", cut, "single") for cut in (50, 125)),
        ("GatedNoise", 21, "dict"),
    ],
)
def test_a_resumed_run_is_the_same_bit_for_bit(part: str, cut: int, layout: str) -> None:
    every = Scene(views_disagree=1.0, opacity=2.0)
    scene = {"all": every, "none": Scene()}.get(part) or USELESS[part]
    whole = Training(scene, layout).run(cut)
    saved = whole.save()
    again = Training(scene, layout).load(saved)
    assert dict(again.phases.switched_off) == dict(whole.phases.switched_off)
    for each in (whole, again):
        torch.manual_seed(1)
        each.run(TOTAL)
    assert dict(again.phases.switched_off) == dict(whole.phases.switched_off)
    assert_same(whole.splats, again.splats)


def test_rewinding_brings_parts_back() -> None:
    scene = Scene(views_disagree=1.0, opacity=2.0)
    training = Training(scene).run(15)
    early = training.save()
    expected = Training(scene).load(early).run(TOTAL)
    training.run(TOTAL)
    assert "Curvature" in training.phases.switched_off
    training.load(early)
    assert training.phases.switched_off == {}
    training.run(TOTAL)
    assert_same(expected.splats, training.splats)


def test_copies_go_on_alike() -> None:
    training = Training(USELESS["GatedNoise"]).run(50)
    other = copy.deepcopy(training)
    assert training.phases.switched_off is not other.phases.switched_off
    for each in (training, other):
        each.noise.gaussians = each.splats
        torch.manual_seed(3)
        each.run(TOTAL)
    assert torch.equal(training.splats["means"], other.splats["means"])


# -- ranks ---------------------------------------------------------------------------------------


def rank_main(rank: int, port: int, folder: str) -> None:
    """On rank 1 the views disagree and one point is transparent; on rank 0 all is well."""
    torch.set_num_threads(1)
    shorten(pytest.MonkeyPatch())
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


@pytest.mark.processes
def test_ranks_decide_alike(tmp_path: Path) -> None:
    mp.spawn(rank_main, args=(free_port(), str(tmp_path)), nprocs=2)  # pyright: ignore
    a, b = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    assert a == b
    assert "GatedNoise" not in a[0]  # one rank's transparent point is reason enough for all
    assert SWITCH < TOTAL
