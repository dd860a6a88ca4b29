"""What the real trainers do to an upgraded optimizer, in their order, without the trainers.

From the sources: taming-3dgs fd0f7d9, mini-splatting c0d5581, Scaffold-GS 59c833b. Masks, sparse
Adams, other groups and foreign checkpoints are in tests/test_masks.py and tests/test_phases.py.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from inria_host import OPTIONS, SimulatedModel, fill
from torch.nn import Parameter
from torch.optim import Adam
from trainers import assert_same, make_splats

from opt3dgs_optim import PhaseScheduler

POINTS, TOTAL = 30, 40


def squares(params: list[Parameter], iteration: int) -> torch.Tensor:
    """A loss of its own for each iteration, and its gradients."""
    torch.manual_seed(iteration)
    loss = torch.stack([(p * torch.randn(p.shape)).square().mean() for p in params]).sum()
    loss.backward()
    return loss


def test_a_second_optimizer_of_gaussians() -> None:
    """taming-3dgs: the higher harmonics apart, stepped every 16th iteration; two states saved."""

    def begin(parts: Any = None) -> tuple[dict[str, Parameter], PhaseScheduler, list[Adam]]:
        splats, phases = make_splats(POINTS), PhaseScheduler(TOTAL, parts=parts)
        slots = ({"means": "xyz", "opacities": "opacity"}, {"shN": "f_rest"})
        made = [
            Adam([{"params": [splats[k]], "lr": 1e-3, "name": n} for k, n in names.items()])
            for names in slots
        ]
        return splats, phases, [phases.upgrade(each) for each in made]

    def run(splats: Any, phases: Any, optimizers: list[Adam], first: int, last: int) -> None:
        for iteration in range(first, last + 1):
            loss = squares([splats[k] for k in ("means", "opacities", "shN")], iteration)
            phases.observe(loss, iteration=iteration - 1)
            for optimizer in optimizers if iteration % 16 == 0 else optimizers[:1]:
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)

    whole, phases, optimizers = begin()
    run(whole, phases, optimizers, 1, 32)
    plain, phases, optimizers = begin([])
    run(plain, phases, optimizers, 1, 32)
    assert not torch.equal(whole["shN"], plain["shN"])  # annealed: not plain Adam's
    assert not torch.equal(whole["shN"], make_splats(POINTS)["shN"])

    half, phases, before = begin()
    run(half, phases, before, 1, 16)
    again, resumed, optimizers = begin()
    for name, value in half.items():
        again[name].data.copy_(value.data)
    for optimizer, old in zip(optimizers, before, strict=True):
        optimizer.load_state_dict(old.state_dict())
    assert resumed.iteration == 16
    run(again, resumed, optimizers, 17, 32)
    assert_same(again, whole)


def test_a_new_set_up_in_the_loop() -> None:
    """mini-splatting: another optimizer over new parameters; the schedule goes on."""
    model, phases = SimulatedModel(), PhaseScheduler(TOTAL)

    def set_up(points: int) -> None:
        fill(model, make_splats(points))
        model.training_setup(OPTIONS)
        model.optimizer = phases.upgrade(model.optimizer)

    set_up(POINTS)
    for iteration in range(20):
        loss = squares([g["params"][0] for g in model.optimizer.param_groups], iteration)
        phases.observe(loss, iteration=iteration)
        if iteration == 9:
            set_up(POINTS - 7)
        before = model._xyz.detach().clone()
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)
        assert torch.equal(model._xyz, before) == (iteration == 9)
    assert phases.iteration == 20
    assert float(model.optimizer.state[model._xyz]["step"]) == 10


def test_anchors_instead_of_positions() -> None:
    """Scaffold-GS: groups anchor, offset and networks beside opacity, scaling and rotation."""
    shapes = {"anchor": 3, "opacity": 1, "scaling": 6, "rotation": 4}
    groups = [
        {"params": [Parameter(torch.ones(POINTS, n))], "lr": 1e-3, "name": name}
        for name, n in shapes.items()
    ]
    phases = PhaseScheduler(TOTAL)
    with pytest.warns(UserWarning, match="anchor stay as they are"):
        optimizer = phases.upgrade(Adam(groups, lr=0.0, eps=1e-15))
    for group in optimizer.param_groups:
        group["params"][0].grad = torch.ones_like(group["params"][0])
    phases.observe(0.1)
    optimizer.step()
    assert all(float(g["params"][0].detach().max()) < 1 for g in optimizer.param_groups)
