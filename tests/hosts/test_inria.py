"""What INRIA's trainer, 3dgs-mcmc and mini-splatting do to an upgraded optimizer."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from cpu_gsplat import relocation
from gaussians import through_a_file
from gsplat_host import POINTS, splats
from inria_host import ATTRIBUTES, OPTIONS, SimulatedModel, made_model

from opt3dgs_optim import PhaseScheduler

TOTAL = 60  # steps: the trainer's iterations less one


def upgrade(model: SimulatedModel, parts: Any = None) -> PhaseScheduler:
    """The lines of the page."""
    phases = PhaseScheduler(TOTAL, parts=parts)
    phases.upgrade(model.optimizer)
    return phases


def run(model: SimulatedModel, first: int, last: int, *, masked: bool = False) -> int:
    """3dgs-mcmc's order: backward, densify, step, noise; returns the number of no-op steps."""
    no_ops = 0
    for iteration in range(first, last):
        torch.manual_seed(iteration)
        lr = model.update_learning_rate(iteration)
        seen = torch.arange(len(model._xyz)) % 3 != iteration % 3
        values = [getattr(model, name).flatten(1).mean(1) for name in ATTRIBUTES.values()]
        (torch.stack(values).sum(0) - 0.1 * (iteration % 5))[seen].abs().mean().backward()
        if iteration % 7 == 6 and iteration < 50:
            with torch.no_grad():
                model.relocate_gs(dead_mask=(model.get_opacity <= 0.005).squeeze(-1))
                model.add_new_gs(cap_max=60)
        no_ops += model._xyz.grad is None
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            model._xyz.add_(1e-3 * lr * torch.randn_like(model._xyz))
    return no_ops


def same(a: SimulatedModel, b: SimulatedModel) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ATTRIBUTES.values())


def test_without_parts_it_is_the_trainer() -> None:
    ours, theirs = made_model(splats()), made_model(splats())
    upgrade(ours, [])
    for model in (ours, theirs):
        run(model, 0, TOTAL)
    assert len(ours._xyz) > POINTS
    assert same(ours, theirs)


def test_a_training_with_iterations_that_step_nothing() -> None:
    """After an edit the new Parameters have no gradient; the clock counts those steps, too."""
    model = made_model(splats())
    phases = upgrade(model)
    no_ops = run(model, 0, TOTAL)
    assert no_ops == 7
    assert float(model.optimizer.state[model._xyz]["step"]) == TOTAL - no_ops
    assert phases.iteration == TOTAL - 1
    assert phases.end_line() is None
    for name in ("_opacity", "_scaling", "_features_dc"):
        param = getattr(model, name)
        assert torch.equal(model.optimizer.state[param]["averaging.mean"], param), name
    rates = [group["lr"] for group in model.optimizer.param_groups[1:]]
    assert rates == [2.5e-3, 2.5e-3 / 20, 5e-2, 5e-3, 1e-3]


@pytest.mark.parametrize("at", [20, 35, TOTAL - 1])
def test_capture_and_restore_are_bit_exact(at: int) -> None:
    """A stock Adam takes the state, before it is upgraded."""
    whole, first, second = (made_model(splats()) for _ in range(3))
    upgrade(whole)
    run(whole, 0, TOTAL)
    upgrade(first)
    run(first, 0, at)
    second.restore(through_a_file(first.capture()), OPTIONS)
    assert upgrade(second).iteration == at - 1
    run(second, at, TOTAL)
    assert same(whole, second)


def test_a_checkpoint_of_the_unchanged_trainer() -> None:
    """Its Adam has counted less; the page's further line puts the clock where it was."""
    stock, ours = made_model(splats()), made_model(splats())
    assert run(stock, 0, 40) == 5
    ours.restore(through_a_file(stock.capture()), OPTIONS)
    phases = upgrade(ours)
    assert phases.iteration == 40 - 5 - 1
    phases.observe(iteration=40)
    run(ours, 40, TOTAL)
    assert phases.iteration == TOTAL - 1
    assert phases.end_line() is None


def test_an_optimizer_made_anew_under_way() -> None:
    """mini-splatting: `training_setup` in the loop, and the line with `upgrade` below it."""
    model = made_model(splats())
    phases = upgrade(model)
    for start in range(0, TOTAL, 20):
        run(model, start, start + 20)
        assert phases.iteration == start + 19
        if start + 20 < TOTAL:
            model.training_setup(OPTIONS)
            phases.upgrade(model.optimizer)
    assert phases.end_line() is None


def test_the_kernel_that_relocates_on_a_cpu_is_called_as_3dgs_mcmc_calls_it() -> None:
    """The size of the table is last; two Gaussians of opacity 0.5 together have 0.75."""
    opacities, scales = torch.tensor([0.75]), torch.ones(1, 3)
    new, _ = relocation(opacities, scales, torch.tensor([2]), torch.zeros(51, 51), 51)
    torch.testing.assert_close(new, torch.tensor([0.5]))
