"""The phase scheduler in a trainer's hands: upgrade, switch, resume."""

from __future__ import annotations

import io
import re
from typing import Any

import pytest
import torch
from trainers import (
    INRIA_NAMES,
    edit_rows,
    everything,
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    train,
    view_loss,
)

from opt3dgs_optim import AWSGLD, EnergyHistogram, LQNAdam, Phase, PhaseScheduler
from opt3dgs_optim.lqnadam import CurvatureOptions

TOTAL, SWITCH = 60, 40


def scheduler(**options: Any) -> PhaseScheduler:
    options.setdefault("multiplier", EnergyHistogram(warmup=10, step_size=0.1))
    return everything(TOTAL, SWITCH, **options)


def snapshot(splats: dict) -> dict:
    return {name: param.detach().clone() for name, param in splats.items()}


def test_everything_off_is_the_trainers_adam_bit_for_bit() -> None:
    ours, theirs = make_splats(), make_splats()
    phases = scheduler(multiplier=None, curvature=None, squared_loss=False, reset_moments=False)
    upgraded = phases.upgrade(gsplat_optimizers(ours))
    train(ours, upgraded, phases, 0, TOTAL)
    train(theirs, gsplat_optimizers(theirs), None, 0, TOTAL)
    for name in ours:
        assert torch.equal(ours[name], theirs[name])


def test_gsplat_and_inria_ways_agree() -> None:
    ours, theirs = make_splats(), make_splats()
    a, b = scheduler(), scheduler()
    train(ours, a.upgrade(gsplat_optimizers(ours)), a, 0, TOTAL)
    train(theirs, b.upgrade(inria_optimizer(theirs)), b, 0, TOTAL)
    for name in ours:
        assert torch.equal(ours[name], theirs[name])


def test_upgrade_keeps_what_the_trainer_set() -> None:
    splats = make_splats()
    before = gsplat_optimizers(splats, betas=(0.8, 0.95), fused=True)
    train(splats, before, None, 0, 3)
    groups = {name: dict(opt.param_groups[0]) for name, opt in before.items()}
    moments = {name: opt.state[splats[name]]["exp_avg"] for name, opt in before.items()}
    after = scheduler().upgrade(before)
    assert list(after) == list(before)
    for name, optimizer in after.items():
        assert isinstance(optimizer, torch.optim.Adam)
        assert optimizer.param_groups[0] == groups[name]
        assert optimizer.state[splats[name]]["exp_avg"] is moments[name]
        assert optimizer.defaults["betas"] == (0.8, 0.95)


def test_learning_rate_schedule_made_before_the_upgrade_goes_on_working() -> None:
    splats = make_splats()
    optimizers = gsplat_optimizers(splats)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], 0.9)
    phases = scheduler()
    with pytest.warns(UserWarning, match="build learning-rate schedulers on what upgrade"):
        upgraded = phases.upgrade(optimizers)
    train(splats, upgraded, phases, 0, 3)
    with pytest.warns(UserWarning, match="lr_scheduler|learning rate scheduler"):
        decay.step()
    assert upgraded["means"].param_groups[0]["lr"] == pytest.approx(1e-2 * 0.9)


def test_learning_rates_are_never_changed_by_us() -> None:
    splats = make_splats()
    phases = scheduler()
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    decay = torch.optim.lr_scheduler.ExponentialLR(upgraded["means"], 0.99)
    for iteration in range(TOTAL):
        train(splats, upgraded, phases, iteration, iteration + 1)
        decay.step()
    assert upgraded["means"].param_groups[0]["lr"] == pytest.approx(1e-2 * 0.99**TOTAL, rel=1e-12)
    assert upgraded["scales"].param_groups[0]["lr"] == 5e-3


def test_only_gaussian_groups_get_nu_and_only_positions_get_curvature() -> None:
    splats = make_splats()
    optimizers: dict[str, Any] = gsplat_optimizers(splats)
    pose = torch.nn.Parameter(torch.ones(3))
    optimizers["pose_opt"] = torch.optim.Adam([pose], lr=0.1)
    phases = scheduler(multiplier=3.0)
    upgraded = phases.upgrade(optimizers)
    assert upgraded["pose_opt"] is optimizers["pose_opt"]
    train(splats, upgraded_gaussians(upgraded), phases, 0, SWITCH)
    assert not any("history" in opt.state[p] for opt, p in pairs(upgraded, splats))
    train(splats, upgraded_gaussians(upgraded), phases, SWITCH, SWITCH + 3)
    holders = [name for name in splats if "history" in upgraded[name].state[splats[name]]]
    assert holders == ["means"]


def upgraded_gaussians(upgraded: dict) -> dict:
    return {name: opt for name, opt in upgraded.items() if name != "pose_opt"}


def pairs(upgraded: dict, splats: dict) -> list:
    return [(upgraded[name], splats[name]) for name in splats]


def test_extra_groups_of_one_optimizer_stay_plain_adam() -> None:
    """INRIA's optimizer may hold exposures or poses: no nu there, in any phase."""
    splats, exposure = make_splats(), torch.nn.Parameter(torch.ones(4))
    twin = torch.nn.Parameter(torch.ones(4))
    optimizer = inria_optimizer(splats)
    optimizer.add_param_group({"params": [exposure], "lr": 0.1, "name": "exposure"})
    phases = scheduler(multiplier=3.0, reset_moments=False)
    upgraded = phases.upgrade(optimizer)
    plain = torch.optim.Adam([twin], lr=0.1, eps=1e-15)
    for iteration in range(TOTAL):
        for each in (exposure, twin):
            each.grad = torch.full((4,), 0.1 * iteration)
        train(splats, upgraded, phases, iteration, iteration + 1)
        plain.step()
    assert torch.equal(exposure, twin)


def test_a_group_added_after_the_upgrade_is_stepped() -> None:
    splats, pose = make_splats(), torch.nn.Parameter(torch.ones(2))
    phases = scheduler()
    upgraded = phases.upgrade(inria_optimizer(splats))
    upgraded.add_param_group({"params": [pose], "lr": 0.1, "name": "pose"})
    pose.grad = torch.ones(2)
    train(splats, upgraded, phases, 0, 1)
    assert bool((pose < 1).all())


def test_phase_and_pixel_loss() -> None:
    splats = make_splats()
    phases = scheduler()
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    render, target = torch.full((2, 2, 3), 0.5), torch.zeros(2, 2, 3)
    for iteration in range(TOTAL):
        exploiting = iteration >= SWITCH
        assert phases.phase is (Phase.EXPLOITATION if exploiting else Phase.EXPLORATION)
        expected = 0.25 if exploiting else 0.5
        assert float(phases.pixel_loss(render, target)) == expected
        train(splats, upgraded, phases, iteration, iteration + 1)


def test_pixel_loss_stays_l1_when_told() -> None:
    phases = everything(10, 0, squared_loss=False)
    assert float(phases.pixel_loss(torch.full((2,), 0.5), torch.zeros(2))) == 0.5


def test_moments_start_anew_at_the_switch_or_are_kept() -> None:
    for reset in (True, False):
        splats = make_splats()
        phases = scheduler(reset_moments=reset)
        upgraded = phases.upgrade(gsplat_optimizers(splats))
        train(splats, upgraded, phases, 0, SWITCH + 1)
        steps = {float(opt.state[p]["step"]) for opt, p in pairs(upgraded, splats)}
        assert steps == ({1.0} if reset else {SWITCH + 1.0})


def test_moments_start_anew_by_themselves_where_the_phase_is_long_enough() -> None:
    assert everything(30_000).reset_moments
    assert everything(3_000).reset_moments
    assert not everything(300).reset_moments
    assert everything(300, 0.5).reset_moments
    assert PhaseScheduler.paper(300).reset_moments


def test_the_object_is_the_same_before_and_after_the_switch() -> None:
    splats = make_splats()
    phases = scheduler()
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    ids = {name: (id(opt), id(opt.step.__func__)) for name, opt in upgraded.items()}  # type: ignore
    train(splats, upgraded, phases, 0, TOTAL)
    assert ids == {name: (id(opt), id(opt.step.__func__)) for name, opt in upgraded.items()}  # type: ignore


@pytest.mark.parametrize("kind", ["gsplat", "inria"])
@pytest.mark.parametrize("at", [SWITCH - 25, SWITCH - 1, SWITCH, SWITCH + 1, SWITCH + 9])
@pytest.mark.parametrize("order", ["upgrade, load", "load, upgrade"])
def test_resume_is_bit_exact(kind: str, at: int, order: str) -> None:
    """Before, at and after the switch; loaded into our optimizer or into the trainer's Adam."""
    make = gsplat_optimizers if kind == "gsplat" else inria_optimizer

    def states(optimizers: Any) -> Any:
        if isinstance(optimizers, dict):
            return {name: opt.state_dict() for name, opt in optimizers.items()}
        return optimizers.state_dict()

    def load(optimizers: Any, saved: Any) -> None:
        if isinstance(optimizers, dict):
            for name, opt in optimizers.items():
                opt.load_state_dict(saved[name])
        else:
            optimizers.load_state_dict(saved)

    whole, phases = make_splats(), scheduler()
    train(whole, phases.upgrade(make(whole)), phases, 0, TOTAL)  # type: ignore[arg-type]

    first, phases = make_splats(), scheduler()
    optimizers: Any = phases.upgrade(make(first))  # type: ignore[arg-type]
    train(first, optimizers, phases, 0, at)
    buffer = io.BytesIO()
    torch.save({"splats": snapshot(first), "optimizers": states(optimizers)}, buffer)
    buffer.seek(0)
    saved = torch.load(buffer, weights_only=True)

    second, phases = {k: torch.nn.Parameter(v) for k, v in saved["splats"].items()}, scheduler()
    fresh: Any = make(second)
    if order == "load, upgrade":
        load(fresh, saved["optimizers"])
        fresh = phases.upgrade(fresh)
    else:
        fresh = phases.upgrade(fresh)
        load(fresh, saved["optimizers"])
    assert phases.iteration == at
    train(second, fresh, phases, at, TOTAL)
    for name in whole:
        assert torch.equal(whole[name], second[name]), name


def test_state_dict_without_ours_is_taken() -> None:
    """A checkpoint of the stock trainer: its moments load, the phases start where they are."""
    splats = make_splats()
    stock = gsplat_optimizers(splats)
    train(splats, stock, None, 0, 4)
    phases = scheduler()
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    upgraded["means"].load_state_dict(stock["means"].state_dict())
    assert float(upgraded["means"].state[splats["means"]]["step"]) == 4
    assert phases.iteration == 0


def test_density_control_between_steps_is_survived_in_both_phases() -> None:
    splats, phases = make_splats(), scheduler()
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    generator = torch.Generator().manual_seed(0)
    for iteration in range(TOTAL):
        train(splats, upgraded, phases, iteration, iteration + 1)
        if iteration % 7 == 6:
            n = splats["means"].shape[0]
            keep = torch.randperm(n, generator=generator)[: n - 1]
            edit_rows(splats, upgraded, keep, 2)
    assert splats["means"].shape[0] > 12
    assert all(bool(torch.isfinite(p).all()) for p in splats.values())
    assert upgraded["means"].state[splats["means"]]["history"].shape[0] == splats["means"].shape[0]


def test_iterations_without_gradients_count_for_the_switch() -> None:
    """INRIA: the iterations that edit points are no-ops of the optimizer (grad is None)."""
    splats, phases = make_splats(), scheduler()
    upgraded = phases.upgrade(inria_optimizer(splats))
    for iteration in range(SWITCH):
        if iteration % 3 == 0:
            phases.observe(0.1)
            upgraded.step()
        else:
            train(splats, upgraded, phases, iteration, iteration + 1)
    assert phases.phase is Phase.EXPLOITATION


def test_the_trainers_own_iteration_is_followed() -> None:
    phases = scheduler()
    phases.observe(0.1, iteration=SWITCH)
    assert phases.exploiting


def test_histogram_is_left_alone_in_exploitation() -> None:
    """The L2 loss is another energy."""
    splats, histogram = make_splats(), EnergyHistogram(warmup=10)
    phases = scheduler(multiplier=histogram)
    train(splats, phases.upgrade(gsplat_optimizers(splats)), phases, 0, TOTAL)
    assert histogram.num_observed == SWITCH


def test_non_finite_loss_skips_the_step_in_both_phases() -> None:
    for at in (SWITCH - 5, SWITCH + 5):
        splats, phases = make_splats(), scheduler()
        upgraded = phases.upgrade(gsplat_optimizers(splats))
        train(splats, upgraded, phases, 0, at)
        before = snapshot(splats)
        loss = view_loss(splats, 0, phases) * float("nan")
        loss.backward()
        phases.observe(loss)
        for optimizer in upgraded.values():
            optimizer.step()
            optimizer.zero_grad()
        assert all(torch.equal(before[name], splats[name]) for name in splats)
        train(splats, upgraded, phases, at + 1, TOTAL)
        assert all(bool(torch.isfinite(p).all()) for p in splats.values())


def test_noise_is_ours_only_when_asked() -> None:
    results = []
    for scale in (0.0, 1.0):
        torch.manual_seed(0)
        splats = make_splats()
        splats["opacities"].data.fill_(-9.0)
        phases = scheduler(noise_scale=scale)
        upgraded = phases.upgrade(gsplat_optimizers(splats), splats if scale else None)
        train(splats, upgraded, phases, 0, 2)
        results.append(snapshot(splats))
    assert not torch.equal(results[0]["means"], results[1]["means"])


def test_noise_needs_the_gaussians() -> None:
    with pytest.raises(ValueError, match="gaussians=None"):
        scheduler(noise_scale=5e5).upgrade(gsplat_optimizers(make_splats()))


def test_noise_can_stop_at_the_switch() -> None:
    splats = make_splats()
    phases = scheduler(noise_scale=1.0, noise_in_exploitation=False)
    upgraded = phases.upgrade(gsplat_optimizers(splats), splats)
    train(splats, upgraded, phases, 0, SWITCH)
    assert phases.noise is not None
    train(splats, upgraded, phases, SWITCH, SWITCH + 1)
    assert phases.noise is None
    train(splats, upgraded, phases, SWITCH + 1, TOTAL)  # our own steps are nobody else's noise


def test_accepted_share_is_reported() -> None:
    splats, phases = make_splats(), scheduler()
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    train(splats, upgraded, phases, 0, SWITCH)
    assert phases.accepted_share is None
    train(splats, upgraded, phases, SWITCH, SWITCH + 5)
    assert phases.accepted_share is not None
    assert 0 <= float(phases.accepted_share) <= 1


def test_never_observed_is_said_once() -> None:
    splats = make_splats()
    upgraded = scheduler().upgrade(inria_optimizer(splats))
    view_loss(splats, 0).backward()
    with pytest.warns(UserWarning, match="PhaseScheduler.*no energy has been observed yet"):
        upgraded.step()


def test_paper_preset() -> None:
    phases = PhaseScheduler.paper()
    assert (phases.total_steps, phases.switch_step) == (30_000, 29_000)
    assert isinstance(phases.multiplier, EnergyHistogram)
    assert phases.multiplier.warmup == 2_500
    assert phases.multiplier.energy_range == (0.0, 0.2)
    assert phases.curvature_options == CurvatureOptions()
    short = PhaseScheduler.paper(3_000)
    assert isinstance(short.multiplier, EnergyHistogram)
    assert (short.switch_step, short.multiplier.warmup) == (2_900, 250)


def test_inria_names() -> None:
    splats = make_splats()
    upgraded = scheduler().upgrade(inria_optimizer(splats))
    assert [group["name"] for group in upgraded.param_groups] == list(INRIA_NAMES.values())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"total_steps": 0}, "total_steps=0"),
        ({"total_steps": 10.5}, "total_steps=10.5"),
        ({"switch": 11}, "switch=11"),
        ({"switch": 1.1}, "switch=1.1"),
        ({"switch": -1}, "switch=-1"),
        ({"multiplier": "nu"}, "multiplier='nu'"),
        ({"multiplier": True}, "multiplier=True"),
        ({"noise_scale": -1.0}, "noise_scale=-1.0"),
        ({"squared_loss": "l2"}, "squared_loss='l2'"),
        ({"reset_moments": 1}, "reset_moments=1"),
        ({"noise_in_exploitation": None}, "noise_in_exploitation=None"),
    ],
)
def test_bad_options(options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        everything(**{"total_steps": 10, **options})
    assert "PhaseScheduler" in str(error.value)


def test_optimizers_that_cannot_be_upgraded_are_named() -> None:
    splats = make_splats()
    mixed: dict[str, Any] = gsplat_optimizers(splats)
    mixed["scales"] = torch.optim.SGD([splats["scales"]], lr=0.1)
    with pytest.raises(TypeError, match=re.escape("optimizers['scales'] is a torch.optim.sgd.SGD")):
        scheduler().upgrade(mixed)
    with pytest.raises(TypeError, match="a dict of optimizers"):
        scheduler().upgrade([torch.optim.Adam([splats["means"]])])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="positions"):
        scheduler().upgrade({"sh0": gsplat_optimizers(splats)["sh0"]})
    with pytest.raises(ValueError, match="positions"):
        scheduler().upgrade(torch.optim.Adam([splats["means"]]))
    phases = scheduler()
    upgraded = phases.upgrade(gsplat_optimizers(splats))
    with pytest.raises(TypeError, match="already"):
        phases.upgrade(upgraded)
    for own in (AWSGLD, LQNAdam):
        with pytest.raises(TypeError, match="already"):
            phases.upgrade(own([{"params": [splats["means"]], "name": "means"}]))
    twice = inria_optimizer(splats)
    twice.param_groups[1]["name"] = "xyz"
    with pytest.raises(ValueError, match="two groups are named 'xyz'"):
        scheduler().upgrade(twice)


class OwnStep(torch.optim.Adam):
    """A subclass with a step of its own."""

    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Do nothing."""


def test_a_subclass_with_its_own_step_is_refused() -> None:
    splats = make_splats()
    optimizers: dict[str, Any] = gsplat_optimizers(splats)
    optimizers["means"] = OwnStep([{"params": [splats["means"]], "name": "means"}])
    with pytest.raises(TypeError, match="OwnStep"):
        scheduler().upgrade(optimizers)


def test_adamw_is_upgraded_with_its_decay() -> None:
    x, y = [torch.nn.Parameter(torch.ones(4, 3)) for _ in "ab"]
    plain = torch.optim.AdamW([x], lr=0.1, weight_decay=0.3)
    phases = scheduler(multiplier=None)
    ours = phases.upgrade({"means": torch.optim.AdamW([y], lr=0.1, weight_decay=0.3)})
    for _ in range(5):
        x.grad, y.grad = torch.ones(4, 3), torch.ones(4, 3)
        phases.observe(0.1)
        plain.step()
        ours["means"].step()
    assert torch.equal(x, y)


def test_bad_state_is_refused() -> None:
    with pytest.raises(ValueError, match="missing"):
        scheduler().load_state_dict({"iteration": 3})


def test_images_of_two_shapes() -> None:
    with pytest.raises(ValueError, match=re.escape("(2, 3)")):
        scheduler().pixel_loss(torch.zeros(2, 3), torch.zeros(3, 2))
