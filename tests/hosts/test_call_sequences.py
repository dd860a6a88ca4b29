"""What the real trainers do to an upgraded optimizer, in their order, without the trainers.

From the sources: INRIA 54c035f, taming-3dgs fd0f7d9, mini-splatting c0d5581, gsplat 90d7b4b,
LightGaussian 6676b98, 4DGaussians 843d5ac, Scaffold-GS 59c833b.
"""

from __future__ import annotations

import logging
from typing import Any

import pytest
import torch
from inria_host import OPTIONS, SimulatedModel, fill
from torch import Tensor
from torch.nn import Parameter
from trainers import make_splats

from opt3dgs_optim import PhaseScheduler

POINTS, TOTAL = 30, 40


@torch.no_grad()
def masked_steps(optimizer: torch.optim.Optimizer, visibility: Tensor) -> None:
    """The kernel of both: no bias correction, no count of the steps."""
    for group in optimizer.param_groups:
        (param,) = group["params"]
        if param.grad is None:
            continue
        state = optimizer.state[param]
        if "exp_avg" not in state:
            state["step"] = torch.tensor(0.0)
            state["exp_avg"] = torch.zeros_like(param)
            state["exp_avg_sq"] = torch.zeros_like(param)
        assert len(param) == len(visibility)
        rows, (beta1, beta2) = visibility.bool(), group["betas"]
        first = state["exp_avg"][rows].lerp(param.grad[rows], 1 - beta1)
        second = state["exp_avg_sq"][rows] * beta2 + param.grad[rows].square() * (1 - beta2)
        state["exp_avg"][rows], state["exp_avg_sq"][rows] = first, second
        param[rows] -= group["lr"] * first / (second.sqrt() + group["eps"])


class SparseGaussianAdam(torch.optim.Adam):
    """INRIA's."""

    def step(self, visibility: Tensor, N: int) -> None:  # pyright: ignore
        assert len(visibility) == N
        masked_steps(self, visibility)


class SelectiveAdam(torch.optim.Adam):
    """gsplat's."""

    def step(self, visibility: Tensor) -> None:  # pyright: ignore
        masked_steps(self, visibility)


def sparse_model() -> SimulatedModel:
    model = SimulatedModel()
    fill(model, make_splats(POINTS))
    model.training_setup(OPTIONS)
    groups = [
        {key: g[key] for key in ("params", "lr", "name")} for g in model.optimizer.param_groups
    ]
    model.optimizer = SparseGaussianAdam(groups, lr=0.0, eps=1e-15)
    return model


def backward(model: Any, iteration: int) -> Tensor:
    torch.manual_seed(iteration)
    loss = sum(
        (g["params"][0] * torch.randn(g["params"][0].shape)).square().mean()
        for g in model.optimizer.param_groups
    )
    assert isinstance(loss, Tensor)
    loss.backward()
    return loss


def test_a_mask_made_before_the_densification() -> None:
    """All parameters are new and longer, none has a gradient: nothing happens, as upstream."""
    model = sparse_model()
    phases = PhaseScheduler(TOTAL)
    model.optimizer = phases.upgrade(model.optimizer)
    for iteration in range(1, 10):
        phases.observe(backward(model, iteration), iteration=iteration - 1)
        visible = torch.arange(len(model._xyz)) % 3 != 0
        if iteration % 3 == 0:
            model.append(torch.arange(5))
            before = [g["params"][0].detach().clone() for g in model.optimizer.param_groups]
            model.optimizer.step(visible, len(visible))
            for group, old in zip(model.optimizer.param_groups, before, strict=True):
                assert torch.equal(group["params"][0], old)
        else:
            model.optimizer.step(visible, len(visible))
        model.optimizer.zero_grad(set_to_none=True)
    assert len(model._xyz) == POINTS + 15


def test_a_reset_of_the_opacities_alone() -> None:
    """One parameter is new and has no gradient, the mask fits the others."""
    model = sparse_model()
    phases = PhaseScheduler(TOTAL)
    model.optimizer = phases.upgrade(model.optimizer)
    for iteration in range(1, 5):
        phases.observe(backward(model, iteration), iteration=iteration - 1)
        if iteration == 3:
            model.reset_opacity()
        before = model._opacity.detach().clone(), model._xyz.detach().clone()
        model.optimizer.step(torch.ones(POINTS, dtype=torch.bool), POINTS)
        model.optimizer.zero_grad(set_to_none=True)
        assert torch.equal(model._opacity, before[0]) == (iteration == 3)
        assert not torch.equal(model._xyz, before[1])


@pytest.mark.parametrize("kind", [SparseGaussianAdam, SelectiveAdam])
def test_sparse_adams_keep_their_arithmetic(kind: type) -> None:
    """With every part off each step is that of the optimizer that was upgraded."""
    ours, theirs = make_splats(POINTS), make_splats(POINTS)

    def make(splats: dict[str, Parameter]) -> dict[str, Any]:
        return {
            name: kind([{"params": p, "lr": 1e-2, "name": name}], eps=1e-15)
            for name, p in splats.items()
        }

    phases = PhaseScheduler(TOTAL, parts=[])
    ours_by_name, theirs_by_name = phases.upgrade(make(ours)), make(theirs)
    for iteration in range(12):
        torch.manual_seed(iteration)
        visible = torch.rand(POINTS) < 0.6
        arguments = (visible,) if kind is SelectiveAdam else (visible, POINTS)
        for splats, optimizers in ((ours, ours_by_name), (theirs, theirs_by_name)):
            torch.manual_seed(iteration)
            loss = torch.stack(
                [(p * torch.randn(p.shape)).square().mean() for p in splats.values()]
            )
            loss.sum().backward()
            if splats is ours:
                phases.observe(loss.sum())
            for optimizer in optimizers.values():
                optimizer.step(*arguments)
                optimizer.zero_grad(set_to_none=True)
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], rtol=1e-6, atol=1e-7)


def test_a_second_optimizer_of_gaussians() -> None:
    """taming-3dgs: the higher harmonics apart, stepped every 16th iteration; two states saved."""

    def model() -> tuple[dict[str, Parameter], Any, Any]:
        splats = make_splats(POINTS)
        rest = [{"params": [splats["shN"]], "lr": 1e-3, "name": "f_rest"}]
        first = [
            {"params": [splats["means"]], "lr": 1e-3, "name": "xyz"},
            {"params": [splats["opacities"]], "lr": 1e-3, "name": "opacity"},
        ]
        return splats, torch.optim.Adam(first, lr=0.0, eps=1e-15), torch.optim.Adam(rest, eps=1e-15)

    def run(splats: Any, phases: Any, one: Any, two: Any, first: int, last: int) -> None:
        for iteration in range(first, last + 1):
            torch.manual_seed(iteration)
            used = [splats[k] for k in ("means", "opacities", "shN")]
            loss = torch.stack([(p * torch.randn(p.shape)).square().mean() for p in used]).sum()
            loss.backward()
            phases.observe(loss, iteration=iteration - 1)
            one.step()
            one.zero_grad(set_to_none=True)
            if iteration % 16 == 0:
                two.step()
                two.zero_grad(set_to_none=True)

    whole, one, two = model()
    phases = PhaseScheduler(TOTAL)
    one, two = phases.upgrade(one), phases.upgrade(two)
    start = whole["shN"].detach().clone()
    run(whole, phases, one, two, 1, 32)
    plain, *adams = model()
    assert not torch.equal(whole["shN"], start)
    nothing = PhaseScheduler(TOTAL, parts=[])
    one, two = map(nothing.upgrade, adams)
    run(plain, nothing, one, two, 1, 32)
    assert not torch.equal(whole["shN"], plain["shN"])  # annealed: not plain Adam's

    half, *adams = model()
    before = PhaseScheduler(TOTAL)
    saved = [before.upgrade(o) for o in adams]
    run(half, before, saved[0], saved[1], 1, 16)
    again = [type(a)(a.param_groups, lr=0.0, eps=1e-15) for a in model()[1:]]
    for optimizer, old in zip(again, saved, strict=True):
        for group, there in zip(optimizer.param_groups, old.param_groups, strict=True):
            group["params"] = there["params"]
        optimizer.load_state_dict(old.state_dict())
    resumed = PhaseScheduler(TOTAL)
    again = [resumed.upgrade(o) for o in again]
    assert resumed.iteration == 16
    run(half, resumed, again[0], again[1], 17, 32)
    assert torch.equal(half["means"], whole["means"])
    assert torch.equal(half["shN"], whole["shN"])


def test_a_new_set_up_in_the_loop() -> None:
    """mini-splatting: another optimizer over new parameters; the schedule goes on."""
    model = SimulatedModel()
    fill(model, make_splats(POINTS))
    model.training_setup(OPTIONS)
    phases = PhaseScheduler(TOTAL)
    model.optimizer = phases.upgrade(model.optimizer)
    for iteration in range(1, 21):
        phases.observe(backward(model, iteration), iteration=iteration - 1)
        if iteration == 10:
            fill(model, make_splats(POINTS - 7))
            model.training_setup(OPTIONS)
            model.optimizer = phases.upgrade(model.optimizer)
        before = model._xyz.detach().clone()
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)
        assert torch.equal(model._xyz, before) == (iteration == 10)
    assert phases.iteration == 20
    state = model.optimizer.state[model._xyz]
    assert float(state["step"]) == 10


@pytest.mark.filterwarnings("error")
def test_a_checkpoint_of_the_stock_trainer() -> None:
    """It knows nothing of us: the schedule goes by the iteration that the trainer says."""
    model = SimulatedModel()
    fill(model, make_splats(POINTS))
    model.training_setup(OPTIONS)
    for iteration in range(1, 31):
        backward(model, iteration)
        model.optimizer.step()
        model.optimizer.zero_grad(set_to_none=True)
    model.restore(model.capture(), OPTIONS)
    phases = PhaseScheduler(TOTAL, 0.8)
    model.optimizer = phases.upgrade(model.optimizer)
    phases.pixel_loss(torch.zeros(3), torch.ones(3))
    phases.observe(backward(model, 31), iteration=30)
    model.optimizer.step()
    assert phases.iteration == 31
    assert float(model.optimizer.state[model._xyz]["step"]) == 31


@pytest.mark.filterwarnings("error")
def test_a_rate_scheduler_built_before() -> None:
    """LightGaussian's prune_finetune.py: ExponentialLR on gaussians.optimizer, then the loop."""
    model = SimulatedModel()
    fill(model, make_splats(POINTS))
    model.training_setup(OPTIONS)
    scheduler = torch.optim.lr_scheduler.ExponentialLR(model.optimizer, gamma=0.5)
    phases = PhaseScheduler(TOTAL)
    model.optimizer = phases.upgrade(model.optimizer)
    rates = [group["lr"] for group in model.optimizer.param_groups]
    phases.observe(backward(model, 1), iteration=0)
    model.optimizer.step()
    scheduler.step()
    assert [group["lr"] for group in model.optimizer.param_groups] == [r / 2 for r in rates]


def test_groups_of_networks_ride_along() -> None:
    """4DGaussians: groups with the many parameters of a network, in the Gaussians' Adam."""
    model = SimulatedModel()
    fill(model, make_splats(POINTS))
    model.training_setup(OPTIONS)
    network, twin = torch.nn.Linear(3, 3), torch.nn.Linear(3, 3)
    twin.load_state_dict(network.state_dict())
    model.optimizer.add_param_group(
        {"params": list(network.parameters()), "lr": 1e-2, "name": "deformation"}
    )
    phases = PhaseScheduler(TOTAL)
    model.optimizer = phases.upgrade(model.optimizer)
    plain = torch.optim.Adam(twin.parameters(), lr=1e-2, eps=1e-15)
    for _ in range(3):
        for one in (network, twin):
            one(torch.ones(3)).square().sum().backward()
        phases.observe(0.1)
        for optimizer in (model.optimizer, plain):
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
    assert torch.equal(network.weight, twin.weight)


def test_anchors_instead_of_positions() -> None:
    """Scaffold-GS: groups anchor, offset and networks beside opacity, scaling and rotation."""
    shapes = {"anchor": 3, "opacity": 1, "scaling": 6, "rotation": 4}
    groups = [
        {"params": [Parameter(torch.ones(POINTS, n))], "lr": 1e-3, "name": name}
        for name, n in shapes.items()
    ]
    optimizer: Any = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    phases = PhaseScheduler(TOTAL)
    optimizer = phases.upgrade(optimizer)
    for group in optimizer.param_groups:
        group["params"][0].grad = torch.ones_like(group["params"][0])
    phases.observe(0.1)
    optimizer.step()
    assert all(float(g["params"][0].detach().max()) < 1 for g in optimizer.param_groups)


def test_no_gaussians_at_all_are_refused() -> None:
    optimizer = torch.optim.Adam([{"params": [Parameter(torch.ones(2))], "name": "exposure"}])
    with pytest.raises(ValueError, match="exposure"):
        PhaseScheduler(TOTAL).upgrade(optimizer)


def test_a_line_at_upgrade(capsys: pytest.CaptureFixture, caplog: pytest.LogCaptureFixture) -> None:
    """With which parts, over how many steps; in a process that configures no logging."""
    model = SimulatedModel()
    fill(model, make_splats(POINTS))
    model.training_setup(OPTIONS)
    with caplog.at_level(logging.INFO):
        PhaseScheduler(12_345).upgrade(model.optimizer)
    printed = capsys.readouterr()
    said = (printed.out + printed.err + caplog.text).lower()
    assert "opt3dgs" in said
    assert "fading" in said
    assert "12345" in said.replace(",", "").replace("_", "")
