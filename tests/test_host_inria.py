"""3dgs-mcmc's and INRIA's row edits around our optimizer: simulated always, real where present."""

from __future__ import annotations

import io
from typing import Any

import pytest
import torch
from inria_host import ATTRIBUTES, OPTIONS, made_model
from torch import Tensor
from trainers import everything, make_splats

from opt3dgs_optim import EnergyHistogram, Part, PhaseScheduler

TOTAL, SWITCH, POINTS = 60, 30, 40
MODELS = ["simulated", "3dgs-mcmc"]

pytestmark = pytest.mark.filterwarnings("ignore:.*non-writable:UserWarning")


def make_model(kind: str) -> Any:
    splats = make_splats(POINTS)
    splats["opacities"].data[::6] = -9.0
    return made_model(kind, splats)


def upgrade(model: Any, parts: list[Part] | None = None) -> PhaseScheduler:
    if parts is None:
        phases = everything(TOTAL, SWITCH, nu=EnergyHistogram(warmup=8))
    else:
        phases = PhaseScheduler(TOTAL, SWITCH, parts)
    model.optimizer = phases.upgrade(model.optimizer)
    return phases


def loss_of(model: Any, view: int, phases: PhaseScheduler | None) -> Tensor:
    seen = torch.arange(len(model._xyz)) % 3 != view % 3
    render = model._xyz.sum(-1) * (1 + 0.1 * view) + model.get_opacity[:, 0]
    render = render + model.get_scaling.mean(-1) + model._rotation.sum(-1)
    render = render + model._features_dc.mean((1, 2)) + model._features_rest.mean((1, 2))
    target = torch.full_like(render, 0.1 * view)[seen]
    if phases is None:
        return 0.1 * (render[seen] - target).abs().mean()
    return 0.1 * phases.pixel_loss(render[seen], target)


def run(
    model: Any, phases: PhaseScheduler | None, first: int, last: int, edits: bool = True
) -> int:
    """3dgs-mcmc's order: backward, densify, step, noise; returns the number of no-op steps."""
    no_ops = 0
    for iteration in range(first, last):
        torch.manual_seed(iteration)
        lr = model.update_learning_rate(iteration)
        loss = loss_of(model, iteration % 5, phases)
        loss.backward()
        if phases is not None:
            phases.observe(loss)
        if edits and iteration % 7 == 6 and iteration < 50:
            with torch.no_grad():
                model.relocate_gs(dead_mask=(model.get_opacity <= 0.005).squeeze(-1))
                model.add_new_gs(cap_max=60)
        no_ops += model._xyz.grad is None
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            model._xyz.add_(1e-3 * lr * torch.randn_like(model._xyz))
    return no_ops


def same(a: Any, b: Any) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ATTRIBUTES.values())


@pytest.mark.parametrize("kind", MODELS)
def test_off_is_bit_identical_to_the_trainer_with_adam(kind: str) -> None:
    ours, theirs = make_model(kind), make_model(kind)
    phases = upgrade(ours, [])
    run(ours, phases, 0, TOTAL)
    run(theirs, None, 0, TOTAL)
    assert len(ours._xyz) > POINTS
    assert same(ours, theirs)


@pytest.mark.parametrize("kind", MODELS)
def test_a_whole_run_with_no_op_iterations(kind: str) -> None:
    """10: after an edit the new Parameters have no gradient; the switch follows the trainer."""
    model = make_model(kind)
    phases = upgrade(model)
    no_ops = run(model, phases, 0, SWITCH)
    assert no_ops == 4
    state = model.optimizer.state[model._xyz]
    assert float(state["step"]) == SWITCH - no_ops
    assert "Curvature.history" not in state
    run(model, phases, SWITCH, TOTAL)
    state = model.optimizer.state[model._xyz]
    assert state["Curvature.history"].shape[0] == len(model._xyz)
    for attribute in ATTRIBUTES.values():
        assert bool(torch.isfinite(getattr(model, attribute)).all())
    for group in model.optimizer.param_groups:  # 5: under these very names
        held = model.optimizer.state[group["params"][0]]
        assert held["exp_avg"].shape == held["exp_avg_sq"].shape == group["params"][0].shape
    rates = [group["lr"] for group in model.optimizer.param_groups[1:]]
    assert rates == [2.5e-3, 2.5e-3 / 20, 5e-2, 5e-3, 1e-3]


@pytest.mark.parametrize("kind", MODELS)
def test_pairs_left_behind_by_an_edit_are_dropped(kind: str) -> None:
    """The history keeps its old rows: pruned and grown back to the same number is noticed too."""
    model = make_model(kind)
    phases = upgrade(model)
    run(model, phases, 0, SWITCH + 8, edits=False)
    held = model.optimizer.state[model._xyz]["Curvature.history"]
    assert bool(held.any())
    mask = torch.arange(len(model._xyz)) < 2
    with torch.no_grad():
        _prune(model, mask)
        model.add_new_gs(cap_max=POINTS)
    count = len(model._xyz)
    run(model, phases, SWITCH + 8, SWITCH + 9, edits=False)  # has gradients: backward came after
    now = model.optimizer.state[model._xyz]["Curvature.history"]
    assert now.shape[0] == count
    assert int((now != 0).sum()) < int((held != 0).sum()) / 2


def _prune(model: Any, mask: Tensor) -> None:
    n = len(model._xyz)
    model.xyz_gradient_accum, model.denom = torch.zeros(n, 1), torch.zeros(n, 1)
    model.max_radii2D = torch.zeros(n)
    model.prune_points(mask)


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("at", [SWITCH - 5, SWITCH, SWITCH + 12])
def test_capture_and_restore_are_bit_exact(kind: str, at: int) -> None:
    whole = make_model(kind)
    run(whole, upgrade(whole), 0, TOTAL)
    first = make_model(kind)
    run(first, upgrade(first), 0, at)
    buffer = io.BytesIO()
    torch.save(first.capture(), buffer)
    buffer.seek(0)
    # 15: plain torch.load is weights_only; the original writes a numpy learning rate, its own trap
    captured = torch.load(buffer, weights_only=kind == "simulated")
    second = make_model(kind)
    second.restore(captured, OPTIONS)  # a stock Adam takes our state
    phases = upgrade(second)
    assert phases.iteration == at
    run(second, phases, at, TOTAL)
    assert same(whole, second)


def test_relocation_before_the_first_step() -> None:
    model = make_model("simulated")
    phases = upgrade(model)
    model.relocate_gs((model.get_opacity <= 0.005).squeeze(-1))
    model.add_new_gs(60)
    run(model, phases, 0, 10)
    assert len(model._xyz) > POINTS


def test_opacity_reset_of_inria() -> None:
    model = make_model("simulated")
    phases = upgrade(model)
    run(model, phases, 0, SWITCH + 4)
    pairs = model.optimizer.state[model._xyz]["Curvature.history"].clone()
    model.reset_opacity()
    assert not bool(model.optimizer.state[model._opacity]["exp_avg"].any())
    run(model, phases, SWITCH + 4, SWITCH + 5, edits=False)
    assert model.optimizer.state[model._xyz]["Curvature.history"].shape == pairs.shape


def test_sparse_adam_style_steps_through_edits() -> None:
    """step(visible, N) of INRIA's newer trainer, with prunings and clones in between."""
    model = make_model("simulated")
    phases = upgrade(model)
    for iteration in range(TOTAL):
        torch.manual_seed(iteration)
        loss = loss_of(model, iteration % 5, phases)
        loss.backward()
        phases.observe(loss)
        count = len(model._xyz)
        visible = torch.arange(count) % 3 != iteration % 3
        before = model._xyz.detach().clone()
        model.optimizer.step(visible, count)
        model.optimizer.zero_grad(set_to_none=True)
        assert torch.equal(model._xyz[~visible], before[~visible])
        if iteration % 8 == 7:
            model.prune_points(torch.arange(count) < 2)
            model.append(torch.tensor([3, 4, 5]))
            if iteration % 16 == 15:
                model.reset_opacity()
    assert len(model._xyz) == POINTS + 7
    assert bool(torch.isfinite(model._xyz).all())
