"""What changes at the paper's switch: the loss, and the moments."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import FreshMoments, Part, PhaseScheduler, SquaredLoss

TOTAL, SWITCH = 12, 8


def made(switch: int = SWITCH, *parts: Any) -> tuple[Parameter, Any, PhaseScheduler]:
    x = Parameter(torch.arange(12.0).reshape(4, 3))
    phases = PhaseScheduler(TOTAL, switch, parts=list(parts or (FreshMoments(),)))
    return x, phases.upgrade({"means": torch.optim.Adam([x], lr=0.1)})["means"], phases


def step(x: Parameter, optimizer: Any, iteration: int) -> None:
    x.grad = x.detach().cos() * (1e3 if iteration < SWITCH else 1.0)
    optimizer.step()


def test_a_parameter_without_a_gradient_there_begins_anew_later() -> None:
    x, optimizer, phases = made()
    for i in range(SWITCH - 1):
        step(x, optimizer, i)
    phases.observe(iteration=SWITCH + 2)
    step(x, optimizer, SWITCH + 2)
    assert float(optimizer.state[x]["step"]) == 1.0


def test_an_edit_of_the_rows_after_the_switch_does_not_begin_anew() -> None:
    x, optimizer, _ = made()
    for i in range(SWITCH + 2):
        step(x, optimizer, i)
    state, fewer = optimizer.state.pop(x), Parameter(x.detach()[:2])
    for key in ("exp_avg", "exp_avg_sq"):
        state[key] = state[key][:2]
    optimizer.state[fewer], optimizer.param_groups[0]["params"] = state, [fewer]
    step(fewer, optimizer, SWITCH + 2)
    assert float(optimizer.state[fewer]["step"]) == 3.0


class Fourth(Part):
    """A stranger's photometric term."""

    def pixel_loss(self, error: Tensor) -> Tensor:
        return error.pow(4).sum()


@pytest.mark.compiles
@pytest.mark.parametrize(("part", "late"), [(SquaredLoss(), 0.08), (Fourth(), 0.0256), (None, 0.2)])
def test_a_compiled_loss_changes_its_kind_at_the_switch(part: Any, late: float) -> None:
    """It is compiled once for each kind, and not for each iteration."""
    x, optimizer, phases = made(SWITCH, part or FreshMoments())
    compiled: list[Any] = []

    def backend(graph: Any, _: Any) -> Any:
        compiled.append(graph)
        return graph.forward

    loss_of = torch.compile(lambda error: phases.pixel_loss(error, torch.zeros(2)), backend=backend)
    for i in range(TOTAL):
        expected = 0.2 if i < SWITCH and not isinstance(part, Fourth) else late
        assert float(loss_of(torch.tensor([0.4, 0.0]))) == pytest.approx(expected)
        step(x, optimizer, i)
    assert len(compiled) <= 2
