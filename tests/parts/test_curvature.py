"""Curvature in a training: which parameters, from when on, and what it says of itself."""

from __future__ import annotations

import copy
from typing import Any

import devices
import pytest
import torch
from torch.nn import Parameter
from trainers import (
    gsplat_optimizers,
    inria_optimizer,
    make_splats,
    only,
    state_of,
    train,
    upgraded,
)

from opt3dgs_optim import Course, Curvature, LQNAdam

TOTAL, SWITCH = 60, 40


@pytest.mark.parametrize("make", [gsplat_optimizers, inria_optimizer])
@pytest.mark.parametrize("names", [("means",), ("xyz", "scaling"), ("opacities", "quats"), None])
def test_it_acts_on_its_parameters_from_the_switch_on(make: Any, names: Any) -> None:
    curvature = Curvature(3, names=names)
    splats, phases, optimizers = upgraded(TOTAL, curvature, switch=SWITCH, make=make)
    train(splats, optimizers, phases, 0, SWITCH)
    assert not any("Curvature.history" in state_of(optimizers, p) for p in splats.values())
    train(splats, optimizers, phases, SWITCH, SWITCH + 3)
    holders = {name for name, p in splats.items() if "Curvature.history" in state_of(optimizers, p)}
    assert holders == (set(splats) if names is None else set(curvature.names))


def test_while_exploiting_the_positions_go_where_lqnadam_takes_them() -> None:
    ours, phases, optimizers = upgraded(TOTAL, Curvature(), switch=0)
    means, theirs = optimizers["means"], make_splats()
    twin = LQNAdam([theirs["means"]], lr=1e-2, eps=1e-15)
    for step in range(12):
        phases.observe(0.1)
        for param, optimizer in ((ours["means"], means), (theirs["means"], twin)):
            param.grad = param.detach() * torch.tensor([1.0, 5.0, 25.0]) + 0.1 * step
            optimizer.step()
    assert torch.equal(ours["means"], theirs["means"])


@pytest.mark.parametrize("scale", [1.0, 8.0])
@pytest.mark.parametrize("maximize", [False, True])
def test_it_sees_the_unscaled_gradient_of_what_is_minimised(maximize: bool, scale: float) -> None:
    """Whatever GradScaler and `maximize` do to it: the pairs are those of the plain problem."""
    histories = []
    for up, factor in ((False, 1.0), (maximize, scale)):
        x = Parameter(torch.ones(6, 3))
        phases = only(TOTAL, Curvature(3), switch=0)
        adam = torch.optim.Adam([x], lr=0.01, maximize=up, fused=True)
        means: Any = phases.upgrade({"means": adam})["means"]
        for step in range(5):
            phases.observe(0.1)
            gradient = x.detach() * torch.tensor([1.0, 5.0, 25.0]) + 0.1 * step
            x.grad = gradient * factor * (-1.0 if up else 1.0)
            means.grad_scale = torch.tensor(factor) if factor != 1.0 else None
            means.found_inf = torch.zeros(())
            means.step()
            assert torch.equal(x.grad, gradient * factor * (-1.0 if up else 1.0))
        histories.append(means.state[x]["Curvature.history"])
    torch.testing.assert_close(histories[0], histories[1])


def test_the_share_is_over_all_parameters_of_a_step() -> None:
    """Of each optimizer's last step: one whose pairs are refused, one whose are taken."""
    curvature = Curvature(names=("means", "scales"))
    x, y = Parameter(torch.zeros(3, 3)), Parameter(torch.zeros(5, 3))
    phases = only(TOTAL, curvature, switch=0)
    groups = [{"params": [x], "name": "xyz"}, {"params": [y], "name": "scaling"}]
    optimizer = phases.upgrade(torch.optim.Adam(groups, lr=0.1))
    for step in range(2):
        phases.observe(0.1)
        x.grad = torch.ones(3, 3) + x.detach()  # convex: accepted
        y.grad = torch.ones(5, 3) - y.detach()  # concave: refused
        optimizer.step()
        expected = 0.0 if step == 0 else 3 / 8
        assert float(curvature.accepted_share or 0.0) == pytest.approx(expected)
    assert phases.numbers().keys() == {"accepted"}
    assert float(phases.numbers()["accepted"]) == pytest.approx(3 / 8)


def test_no_number_is_said_before_the_first_step() -> None:
    assert Curvature().accepted_share is None
    assert Curvature().numbers(Course()) == {}


def test_what_it_has_counted_is_in_checkpoints() -> None:
    one, other = Curvature(), Curvature()
    counted = {"history_size": 5, "window": None, "seen": [3.0, 4.0, 0.5, 2.0], "probes": 6}
    one.load_state_dict({key: counted[key] for key in ("seen", "probes")})
    other.load_state_dict(one.state_dict())
    assert other.state_dict() == counted


@pytest.mark.parametrize(
    ("evidence", "probes", "said"),
    [
        ([0.0, 0.0, 0.0, 0.0], 9, None),  # nothing seen yet
        ([1.0, 100.0, 50.0, 100.0], 4, None),  # hardly looked
        ([1.0, 100.0, 50.0, 100.0], 5, "0.010 of the candidate pairs"),
        ([90.0, 100.0, 2.0, 100.0], 5, "cosine of only 0.020"),
        ([90.0, 100.0, 20.0, 100.0], 5, None),
    ],
)
def test_when_it_is_useless(evidence: list[float], probes: int, said: str | None) -> None:
    curvature = Curvature()
    curvature.load_state_dict({"seen": evidence, "probes": probes})
    found = curvature.useless(curvature.evidence(Course()).tolist(), Course())
    assert (found is None) == (said is None)
    assert said is None or said in (found or "")


def test_an_empty_parameter_and_one_without_dimensions() -> None:
    for start in (torch.zeros(0, 3), torch.ones(())):
        x = Parameter(start)
        phases = only(TOTAL, Curvature(), switch=0)
        means: Any = phases.upgrade({"means": torch.optim.Adam([x], lr=0.1)})["means"]
        for _ in range(3):
            phases.observe(0.1)
            x.grad = 2 * x.detach()
            means.step()
        assert x.shape == start.shape
        assert bool(torch.isfinite(x).all())


def test_a_step_that_the_device_drops_leaves_no_pair(monkeypatch: Any) -> None:
    """As zero gradients do: the point was not seen."""
    devices.on_a_device(monkeypatch)
    x = Parameter(torch.zeros(4, 3))
    phases = only(TOTAL, Curvature(3), switch=0)
    means: Any = phases.upgrade({"means": torch.optim.Adam([x], lr=0.1, fused=True)})["means"]
    before = torch.zeros(0)
    for loss, slope in ((0.1, 1.0), (float("nan"), 3.0)):
        x.grad = torch.full((4, 3), slope)
        before = means.state[x]["Curvature.history"].clone() if means.state else before
        phases.observe(loss)
        means.step()
    assert torch.equal(means.state[x]["Curvature.history"], before)


@pytest.mark.parametrize(("saved", "ours"), [(3, 4), (4, 3), (3, 5), (5, 3)])
def test_pairs_of_another_history_are_refused(saved: int, ours: int) -> None:
    """Of three coordinates, three pairs take as much room as four: the shape does not tell."""

    def trained(history_size: int, steps: int) -> tuple[Parameter, LQNAdam]:
        x = Parameter(torch.arange(12.0).reshape(4, 3))
        optimizer = LQNAdam([x], lr=0.1, history_size=history_size)
        for _ in range(steps):
            x.grad = x.detach() * torch.tensor([1.0, 2.0, 3.0])
            optimizer.step()
        return x, optimizer

    state = trained(saved, 6)[1].state_dict()
    x, optimizer = trained(ours, 2)
    before = copy.deepcopy(optimizer.state_dict())
    with pytest.raises(ValueError, match=r"history_size=|shape"):
        optimizer.load_state_dict(state)
    now = optimizer.state_dict()
    assert now["param_groups"] == before["param_groups"]
    for key, value in before["state"][0].items():
        assert torch.equal(optimizer.state[x][key], value), key
