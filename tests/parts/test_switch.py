"""What changes at the paper's switch: the loss, and the moments."""

from __future__ import annotations

from typing import Any

import pytest
import row_edits
import torch
from gaussians import steps
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import FreshMoments, Part, PhaseScheduler, SquaredLoss

TOTAL, SWITCH = 12, 8


def test_moments_begin_anew_once_in_a_parameters_first_step_after_the_switch() -> None:
    """Which may come later, and an edit of the rows is no other parameter."""
    params: Any = {"means": Parameter(torch.ones(4, 3))}
    phases = PhaseScheduler(TOTAL, parts=[FreshMoments()], switch=SWITCH / TOTAL)
    adam = phases.upgrade(torch.optim.Adam([{"params": [params["means"]], "name": "means"}]))
    for iteration, count in ((SWITCH - 2, 1), (SWITCH - 1, 2), (SWITCH + 2, 1), (SWITCH + 3, 2)):
        phases.observe(iteration=iteration)
        steps({"all": adam}, params, 1)
        assert adam.state[params["means"]]["step"] == count
        row_edits.apply(row_edits.removed(torch.tensor([0])), params, [adam], ["means"], False)


class Fourth(Part):
    """A stranger's photometric term."""

    def pixel_loss(self, error: Tensor) -> Tensor:
        return error.pow(4).sum()


@pytest.mark.compiles
@pytest.mark.parametrize(("part", "late"), [(SquaredLoss(), 0.08), (Fourth(), 0.0256), (None, 0.2)])
def test_a_compiled_loss_changes_its_kind_at_the_switch(part: Any, late: float) -> None:
    """It is compiled once for each kind, and not for each iteration."""
    x = Parameter(torch.ones(4, 3))
    phases = PhaseScheduler(TOTAL, parts=[part or FreshMoments()], switch=SWITCH / TOTAL)
    optimizer = phases.upgrade(torch.optim.Adam([{"params": [x], "name": "means"}]))
    compiled: list[Any] = []

    def backend(graph: Any, _: Any) -> Any:
        compiled.append(graph)
        return graph.forward

    loss_of = torch.compile(lambda error: phases.pixel_loss(error, torch.zeros(2)), backend=backend)
    for i in range(TOTAL):
        expected = 0.2 if i < SWITCH and not isinstance(part, Fourth) else late
        assert float(loss_of(torch.tensor([0.4, 0.0]))) == pytest.approx(expected)
        optimizer.step()
    assert len(compiled) <= 2
