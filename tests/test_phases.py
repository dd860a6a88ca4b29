"""The phase scheduler in a trainer's hands: upgrade, switch, resume."""

from __future__ import annotations

import copy
import io
import logging
import pickle
import re
from typing import Any

import pytest
import torch
from trainers import (
    AveragedThroughout,
    assert_same,
    begun,
    edit_rows,
    every_one,
    everything,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    train,
    trained_by_adam,
    upgraded,
    values_of,
)

from opt3dgs_optim import (
    AWSGLD,
    DEFAULTS,
    DEFAULTS_ADC,
    Annealing,
    Averaging,
    ConstantMultiplier,
    Curvature,
    EnergyHistogram,
    Fading,
    FreshMoments,
    LQNAdam,
    OutOfView,
    Part,
    Phase,
    PhaseScheduler,
    SquaredLoss,
    StepAdam,
)
from opt3dgs_optim.names import GAUSSIAN

TOTAL, SWITCH = 60, 40


def scheduler(*others: Part, **options: Any) -> PhaseScheduler:
    return everything(TOTAL, SWITCH, *others, **{"settling": 0, **options})


def test_gsplat_and_inria_ways_agree() -> None:
    ends = []
    for make in (gsplat_optimizers, inria_optimizer):
        splats, optimizers = begun(phases := scheduler(), make)
        train(splats, optimizers, phases, 0, TOTAL)
        ends.append(splats)
    assert_same(*ends)


def test_hooks_follow_the_switch_wherever_it_is_moved() -> None:
    phases = PhaseScheduler(TOTAL, SWITCH, parts=[FreshMoments(settling=0)])
    acting = []
    for iteration in (0, 10, 39, 40, 41, 5):
        phases.current = iteration
        acting.append(bool(phases.hooks["before"]))
    assert acting == [False, False, False, True, True, False]
    phases.switch_step = 7
    phases.current = 7
    assert phases.hooks["before"]


def test_upgrade_works_in_place_and_keeps_what_the_trainer_set() -> None:
    splats = make_splats()
    before = gsplat_optimizers(splats, betas=(0.8, 0.95), fused=True)
    train(splats, before, None, 0, 3)
    held = dict(before)
    groups = {name: dict(opt.param_groups[0]) for name, opt in before.items()}
    moments = {name: opt.state[splats[name]]["exp_avg"] for name, opt in before.items()}
    after = scheduler().upgrade(before)
    assert after is before
    for name, optimizer in after.items():
        assert optimizer is held[name]
        assert isinstance(optimizer, torch.optim.Adam)
        assert groups[name].items() <= optimizer.param_groups[0].items()
        assert optimizer.state[splats[name]]["exp_avg"] is moments[name]
        assert optimizer.defaults["betas"] == (0.8, 0.95)


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("kind", [gsplat_optimizers, inria_optimizer])
def test_a_learning_rate_schedule_built_before_or_after_the_upgrade(kind: Any, when: str) -> None:
    """Its rates are those without us, and so is its silence: warnings are errors here."""
    rates = []
    for upgrades in (False, True):
        splats, phases = make_splats(), scheduler()
        optimizers = kind(splats)
        first = optimizers if kind is inria_optimizer else optimizers["means"]
        if upgrades and when == "after":
            phases.upgrade(optimizers)
        decay = torch.optim.lr_scheduler.ExponentialLR(first, 0.9)
        if upgrades and when == "before":
            phases.upgrade(optimizers)
        seen = []
        for iteration in range(TOTAL):
            train(splats, optimizers, phases if upgrades else None, iteration, iteration + 1)
            decay.step()
            groups = [group for each in every_one(optimizers) for group in each.param_groups]
            seen.append([group["lr"] for group in groups])
        rates.append(seen)
    assert rates[0] == rates[1]


def test_optimizers_without_gaussians_are_left_alone() -> None:
    optimizers: dict[str, Any] = gsplat_optimizers(make_splats())
    pose = torch.nn.Parameter(torch.ones(3))
    optimizers["pose_opt"] = torch.optim.Adam([pose], lr=0.1)
    assert type(scheduler().upgrade(optimizers)["pose_opt"]) is torch.optim.Adam


@pytest.mark.parametrize("when", ["before", "after"])
def test_extra_groups_of_one_optimizer_stay_plain_adam(when: str) -> None:
    """Exposures, poses or a network (4DGaussians) in INRIA's: no nu there, in any phase."""
    splats, phases = make_splats(), scheduler(nu=ConstantMultiplier(3.0))
    extra, twins = ([torch.nn.Parameter(torch.ones(n)) for n in (4, 5, 6)] for _ in "ab")
    optimizer = inria_optimizer(splats)
    if when == "after":
        phases.upgrade(optimizer)
    optimizer.add_param_group({"params": extra[:1], "lr": 0.1, "name": "exposure"})
    optimizer.add_param_group({"params": extra[1:], "lr": 0.1, "name": "deformation"})
    if when == "before":
        phases.upgrade(optimizer)
    plain = torch.optim.Adam(twins, lr=0.1, eps=1e-15)
    for iteration in range(TOTAL):
        for each in (*extra, *twins):
            each.grad = torch.full_like(each, 0.1 * iteration)
        train(splats, optimizer, phases, iteration, iteration + 1)
        plain.step()
    for one, twin in zip(extra, twins, strict=True):
        assert torch.equal(one, twin)
        assert bool((one < 1).all())


def test_phase_and_pixel_loss() -> None:
    phases = only(18, SquaredLoss(), switch=12)
    render, target = torch.full((2, 2, 3), 0.5), torch.zeros(2, 2, 3)
    for iteration in range(18):
        exploiting = iteration >= 12
        assert phases.phase is (Phase.EXPLOITATION if exploiting else Phase.EXPLORATION)
        assert float(phases.pixel_loss(render, target)) == (0.25 if exploiting else 0.5)
        phases.observe(0.1)


def test_pixel_loss_stays_l1_when_told() -> None:
    phases = only(10, Curvature(), switch=0)
    assert phases.exploiting is False  # nothing observed yet
    assert phases.phase is Phase.EXPLOITATION
    assert float(phases.pixel_loss(torch.full((2,), 0.5), torch.zeros(2))) == 0.5


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
@pytest.mark.parametrize("at", [SWITCH - 25, SWITCH - 1, SWITCH, SWITCH + 1, SWITCH + 9])
@pytest.mark.parametrize("order", ["upgrade, load", "load, upgrade"])
def test_resume_is_bit_exact(make: Any, at: int, order: str) -> None:
    """Before, at and after the switch; loaded into our optimizer or into the trainer's Adam."""

    def every_part() -> PhaseScheduler:
        return scheduler(Annealing(), Fading(share=0.5, events=20), AveragedThroughout())

    whole, optimizers = begun(phases := every_part(), make)
    train(whole, optimizers, phases, 0, TOTAL)

    first, optimizers = begun(phases := every_part(), make)
    train(first, optimizers, phases, 0, at)
    buffer = io.BytesIO()
    torch.save([values_of(first), [o.state_dict() for o in every_one(optimizers)]], buffer)
    buffer.seek(0)
    values, states = torch.load(buffer, weights_only=True)

    second, phases = {k: torch.nn.Parameter(v) for k, v in values.items()}, every_part()
    fresh: Any = make(second)
    if order == "upgrade, load":
        phases.upgrade(fresh)
    for optimizer, state in zip(every_one(fresh), states, strict=True):
        optimizer.load_state_dict(state)
    if order == "load, upgrade":
        phases.upgrade(fresh)
    assert phases.iteration == at
    train(second, fresh, phases, at, TOTAL)
    assert_same(whole, second)


def test_density_control_between_steps_is_survived_in_both_phases() -> None:
    fading = Fading(share=1.0, events=60, start=0.0, stop=1.0)
    splats, optimizers = begun(phases := scheduler(Annealing(), fading, AveragedThroughout()))
    generator = torch.Generator().manual_seed(0)
    for iteration in range(TOTAL):
        train(splats, optimizers, phases, iteration, iteration + 1)
        if iteration % 7 == 6:
            n = splats["means"].shape[0]
            keep = torch.randperm(n, generator=generator)[: n - 1]
            edit_rows(splats, optimizers, keep, 2)
    assert splats["means"].shape[0] > 12
    assert all(bool(torch.isfinite(p).all()) for p in splats.values())
    state = state_of(optimizers, splats["means"])
    assert state["Curvature.history"].shape[0] == len(splats["means"])
    assert torch.equal(state["AveragedThroughout.mean"], splats["means"])
    assert state["AveragedThroughout.count"].shape == (len(splats["means"]),)
    holders = {name for name, p in splats.items() if "Curvature.history" in state_of(optimizers, p)}
    assert holders == {"means"}


def test_presets() -> None:
    phases = PhaseScheduler.paper()
    assert (phases.total_steps, phases.switch_step) == (30_000, 29_000)
    histogram = phases.part(EnergyHistogram)
    assert histogram is not None
    assert (histogram.warmup, histogram.energy_range) == (2_500, (0.0, 0.2))
    kinds = [EnergyHistogram, FreshMoments, SquaredLoss, Curvature]
    assert [type(part) for part in phases.parts] == kinds
    assert phases.part(FreshMoments) == FreshMoments()
    short = PhaseScheduler.paper(3_000)
    warmup = short.part(EnergyHistogram)
    assert warmup is not None
    assert (short.switch_step, warmup.warmup) == (2_900, 250)
    assert PhaseScheduler(10).parts == DEFAULTS == (Fading(), OutOfView(), Averaging())
    for preset in (DEFAULTS, DEFAULTS_ADC, short.parts):
        assert len({type(part) for part in preset}) == len(preset)
    assert PhaseScheduler(10, parts=[]).parts == ()
    more = ConstantMultiplier(2.0)
    assert PhaseScheduler(10, parts=[*DEFAULTS, more]).parts[-1] == more


def test_optimizers_that_cannot_be_upgraded_are_named() -> None:
    splats = make_splats()
    mixed: dict[str, Any] = gsplat_optimizers(splats)
    mixed["scales"] = torch.optim.SGD([splats["scales"]], lr=0.1)
    with pytest.raises(TypeError, match=re.escape("optimizers['scales'] is a torch.optim.sgd.SGD")):
        scheduler().upgrade(mixed)
    assert {type(each) for each in mixed.values()} == {torch.optim.Adam, torch.optim.SGD}
    with pytest.raises(TypeError, match="a dict or a list of optimizers"):
        scheduler().upgrade(splats["means"])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"none of the names \['pose'\]"):
        scheduler().upgrade({"pose": gsplat_optimizers(splats)["sh0"]})
    with pytest.raises(ValueError, match="none of the names"):
        scheduler().upgrade(torch.optim.Adam([splats["means"]]))
    with pytest.raises(ValueError, match=r"none of the names \['exposure'\]"):
        scheduler().upgrade(torch.optim.Adam([{"params": [splats["means"]], "name": "exposure"}]))
    with pytest.raises(ValueError, match="none of the names"):
        scheduler().upgrade({})
    with pytest.raises(TypeError, match="with parts of its own"):
        scheduler().upgrade(begun(scheduler())[1])
    for own in (AWSGLD, LQNAdam):
        with pytest.raises(TypeError, match=f"a {own.__name__} with parts of its own"):
            scheduler().upgrade(own([{"params": [splats["means"]], "name": "means"}]))
    twice = inria_optimizer(splats)
    twice.param_groups[1]["name"] = "xyz"
    with pytest.raises(ValueError, match="two groups of the optimizer hold 'means'"):
        scheduler().upgrade(twice)


class OwnStep(torch.optim.Adam):
    """A subclass with a step of its own."""

    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Do nothing."""


def test_a_subclass_with_its_own_step_is_refused() -> None:
    splats = make_splats()
    optimizers: dict[str, Any] = gsplat_optimizers(splats)
    optimizers["means"] = OwnStep([{"params": [splats["means"]], "name": "means"}])
    with pytest.raises(TypeError, match="OwnStep with a step of its own"):
        scheduler().upgrade(optimizers)
    assert not any(isinstance(each, StepAdam) for each in optimizers.values())


def test_a_step_that_somebody_has_replaced_is_refused() -> None:
    optimizers: dict[str, Any] = gsplat_optimizers(make_splats())
    optimizers["scales"].step = lambda: None
    with pytest.raises(TypeError, match=r"replaced the step of optimizers\['scales'\]"):
        scheduler().upgrade(optimizers)


def test_adamw_is_upgraded_with_its_decay() -> None:
    x, y = [torch.nn.Parameter(torch.ones(4, 3)) for _ in "ab"]
    plain = torch.optim.AdamW([x], lr=0.1, weight_decay=0.3)
    phases = only(TOTAL)
    ours = phases.upgrade({"means": torch.optim.AdamW([y], lr=0.1, weight_decay=0.3)})
    for _ in range(5):
        x.grad, y.grad = torch.ones(4, 3), torch.ones(4, 3)
        phases.observe(0.1)
        plain.step()
        ours["means"].step()
    assert torch.equal(x, y)


def test_images_of_two_shapes() -> None:
    with pytest.raises(ValueError, match=re.escape("(2, 3)")):
        scheduler().pixel_loss(torch.zeros(2, 3), torch.zeros(3, 2))


# -- what an upgrade takes, and says ---------------------------------------------------------------


def test_a_dicts_key_wins_over_the_groups_name() -> None:
    """nerfstudio's own names, or anybody's: what the key says is upgraded."""
    splats = make_splats()
    optimizers = gsplat_optimizers(splats)
    for name, optimizer in optimizers.items():
        optimizer.param_groups[0]["name"] = f"gauss_params.{name}"
    nu = ConstantMultiplier(0.0)
    phases = only(TOTAL, nu)
    phases.upgrade(optimizers)
    before = values_of(splats)
    train(splats, optimizers, phases, 0, 2)
    assert_same(before, splats)  # nu = 0
    assert optimizers["means"].param_groups[0]["name"] == "gauss_params.means"
    state = copy.deepcopy(optimizers["means"].state_dict())
    optimizers["means"].load_state_dict(state)
    train(splats, optimizers, phases, 2, 4)
    assert torch.equal(before["means"], splats["means"])


def test_a_second_optimizer_without_positions_is_upgraded() -> None:
    """And one that the trainer has made anew in mid-training goes on in step with the others."""
    splats = make_splats()
    optimizers = gsplat_optimizers(splats)
    rest = {"means": optimizers.pop("means")}
    phases = only(TOTAL, Annealing(8.0, 0.5, names=GAUSSIAN))
    phases.upgrade(optimizers)
    phases.upgrade(rest)
    both = {**optimizers, **rest}
    assert phases.upgrade(both) is both  # again: nothing happens
    train(splats, both, phases, 0, 10)
    both["means"] = gsplat_optimizers(splats)["means"]  # training_setup, again
    phases.upgrade(both)
    assert phases.iteration == 10
    phases.observe(0.1, iteration=30)
    for param in splats.values():
        param.grad = torch.ones_like(param)
    before = values_of(splats)
    both["means"].step()
    # a first step of Adam is a learning rate long, times the factor at half time
    moved = before["means"] - splats["means"].detach()
    torch.testing.assert_close(moved, torch.full((12, 3), 0.01 * 2.0), rtol=1e-4, atol=0)


def test_what_is_upgraded_and_what_is_not_is_said_once(
    caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    splats = make_splats()
    optimizer = inria_optimizer(splats)
    optimizer.add_param_group({"params": [torch.nn.Parameter(torch.ones(3))], "name": "exposure"})
    phases = PhaseScheduler(500)
    with caplog.at_level(logging.INFO, "opt3dgs_optim"):
        phases.upgrade(optimizer)
    (record,) = caplog.records
    said = record.getMessage()
    for words in ("opt3dgs_optim 0.", "total_steps=500", "Fading(", "xyz", "rotation"):
        assert words in said
    assert said.endswith("left alone: exposure")
    assert (record.name, record.levelname) == ("opt3dgs_optim", "INFO")
    assert capsys.readouterr().out == ""


def test_without_logging_it_is_said_on_stderr(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.Logger, "hasHandlers", lambda self: False)
    PhaseScheduler(500).upgrade(gsplat_optimizers(make_splats()))
    out, err = capsys.readouterr()
    assert out == ""
    assert "total_steps=500" in err
    assert err.count("\n") == 1


# -- clocks that do not fit ------------------------------------------------------------------------


def test_an_energy_that_nobody_steps_after() -> None:
    """A host that calls training_setup again: its new optimizers are not ours."""
    begun(phases := PhaseScheduler(500))
    for _ in range(20):
        phases.observe(0.1)
    with pytest.warns(UserWarning, match=r"20 losses were observed and no upgraded.*Fading"):
        phases.observe(0.1)
    for _ in range(50):
        phases.observe(0.1)  # once


def test_optimizers_that_step_without_an_energy() -> None:
    splats, optimizers = begun(PhaseScheduler(500))
    train(splats, optimizers, None, 0, 20)
    with pytest.warns(UserWarning, match=r"20 times without a loss: Fading, Out") as told:
        train(splats, optimizers, None, 20, 21)
    (warning,) = told
    assert warning.filename.endswith("trainers.py")  # the user's line, not ours or torch's
    train(splats, optimizers, None, 21, 60)  # once


def test_an_energy_that_stops_coming() -> None:
    splats, optimizers = begun(phases := PhaseScheduler(500))
    train(splats, optimizers, phases, 0, 5)
    with pytest.warns(UserWarning, match="without a loss: Fading, OutOfView, Averaging stand"):
        train(splats, optimizers, None, 5, 30)


def test_steps_before_the_first_energy_are_plain_adams() -> None:
    splats, _, optimizers = upgraded(500, Annealing(names=GAUSSIAN), AveragedThroughout())
    train(splats, optimizers, None, 0, 15)
    assert_same(splats, trained_by_adam(15))


@pytest.mark.parametrize("order", ["upgrade, load", "load, upgrade"])
@pytest.mark.parametrize("told", [False, True])
def test_a_checkpoint_of_the_stock_trainer(order: str, told: bool) -> None:
    """Adam's state at step 200: the schedule is told where it is, or says that it is not."""
    splats = make_splats()
    stock = gsplat_optimizers(splats)
    train(splats, stock, None, 0, 200)
    phases = PhaseScheduler(400, parts=[Annealing()])
    fresh = gsplat_optimizers(splats)
    if order == "upgrade, load":
        phases.upgrade(fresh)
    for name, optimizer in fresh.items():
        optimizer.load_state_dict(stock[name].state_dict())
    if order == "load, upgrade":
        phases.upgrade(fresh)
    assert float(fresh["means"].state[splats["means"]]["step"]) == 200
    if told:
        phases.observe(0.1, iteration=205)  # not to the step: some trainers restart their Adam
        assert phases.numbers()["annealing"] < 1.3
        assert phases.iteration == 206
    else:
        with pytest.warns(UserWarning, match=r"made 200 steps, but this is iteration 0 of 400"):
            phases.observe(0.1)
    phases.observe(0.1)  # once


def test_a_longer_run_from_an_exploiting_checkpoint_starts_the_moments_anew_again() -> None:
    splats, short, first = upgraded(60, FreshMoments(), switch=40)
    train(splats, first, short, 0, 50)
    long = only(120, FreshMoments(), switch=90)
    second = long.upgrade(gsplat_optimizers(splats))
    for name, optimizer in second.items():
        optimizer.load_state_dict(first[name].state_dict())
    assert long.iteration == 50
    assert long.phase is Phase.EXPLORATION
    train(splats, second, long, 50, 93)
    assert {float(state_of(second, p)["step"]) for p in splats.values()} == {3.0}


def test_a_run_longer_than_announced() -> None:
    """A switch that comes too early for the run it is in."""
    splats, optimizers = begun(phases := everything(10))
    train(splats, optimizers, phases, 0, 10)
    train(splats, optimizers, phases, 10, 11)  # a trainer that counts from 1
    train(splats, optimizers, phases, 11, 12)
    with pytest.warns(UserWarning, match=r"total_steps=10.*pass the training's number"):
        train(splats, optimizers, phases, 12, 13)
    train(splats, optimizers, phases, 13, 20)  # once


@pytest.mark.parametrize("iteration", [-1, 1.5, "3", True])
def test_an_iteration_that_is_none(iteration: Any) -> None:
    phases = PhaseScheduler(10)
    with pytest.raises(ValueError, match=r"PhaseScheduler\.observe: iteration="):
        phases.observe(0.1, iteration=iteration)
    assert phases.iteration == 0


# -- copies ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies_go_on_alike(copied: Any) -> None:
    splats, optimizers = begun(
        phases := scheduler(Annealing(names=GAUSSIAN), Fading(), AveragedThroughout())
    )
    train(splats, optimizers, phases, 0, SWITCH + 4)
    twins, other, adams = copied((splats, phases, optimizers))
    train(splats, optimizers, phases, SWITCH + 4, TOTAL)
    train(twins, adams, other, SWITCH + 4, TOTAL)
    assert_same(splats, twins)
    assert other.iteration == phases.iteration == TOTAL


def test_a_loss_given_to_step_is_observed() -> None:
    _, optimizers = begun(phases := scheduler())
    closure: Any = lambda: torch.tensor(0.5)  # noqa: E731
    optimizers["means"].step(closure)
    assert phases.num_observed == 1


def test_losses_that_move_to_another_device() -> None:
    splats, phases, optimizers = upgraded(40, SquaredLoss())
    train(splats, optimizers, phases, 0, 3)
    phases.observe(torch.zeros((), device="meta"))
    assert isinstance(phases.valid, torch.Tensor)
    assert phases.valid.device.type == "meta"
