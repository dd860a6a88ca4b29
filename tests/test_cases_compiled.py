"""`pixel_loss` in a function that torch.compile has compiled, whose scheduler is a global."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.nn import Parameter

from opt3dgs_optim import DEFAULTS, PhaseScheduler, SquaredLoss, paper_parts

TOTAL, SWITCH = 60, 40
PARTS: dict[str, Any] = {
    "the defaults": lambda: list(DEFAULTS),
    "the paper's": lambda: paper_parts(TOTAL),
    "SquaredLoss": lambda: [SquaredLoss()],
    "none": lambda: [],
}
GLOBALS: dict[str, Any] = {}


def loss_of_globals() -> torch.Tensor:
    return GLOBALS["phases"].pixel_loss(GLOBALS["p"], GLOBALS["target"])


def loss_of_arguments(phases: Any, p: Any, target: Any) -> torch.Tensor:
    return phases.pixel_loss(p, target)


def trained(parts: str, compiled: str) -> tuple[torch.Tensor, int]:
    """Where a parameter ends, and how often torch has compiled."""
    torch._dynamo.reset()
    compilations = 0

    def backend(module: Any, inputs: Any) -> Any:
        nonlocal compilations
        compilations += 1
        return module.forward

    draw = torch.Generator().manual_seed(0)
    p = Parameter(torch.rand(8, 3, generator=draw))
    phases, target = PhaseScheduler(TOTAL, SWITCH, PARTS[parts]()), torch.zeros(8, 3)
    GLOBALS.update(phases=phases, p=p, target=target)
    adam = phases.upgrade(torch.optim.Adam([{"params": [p], "name": "means"}], lr=0.01))
    options: dict[str, Any] = {"backend": backend, "fullgraph": True}
    of_globals = torch.compile(loss_of_globals, **options)
    of_arguments = torch.compile(loss_of_arguments, **options)
    for _ in range(TOTAL):
        if compiled == "globals":
            loss = of_globals()
        elif compiled == "arguments":
            loss = of_arguments(phases, p, target)
        else:
            loss = loss_of_arguments(phases, p, target)
        loss.backward()
        phases.observe(loss)
        adam.step()
        adam.zero_grad()
    return p.detach(), compilations


@pytest.mark.compiles
@pytest.mark.parametrize("parts", PARTS)
@pytest.mark.parametrize("compiled", ["globals", "arguments"])
def test_it_is_compiled_once_for_each_phase(parts: str, compiled: str) -> None:
    expected, _ = trained(parts, "not at all")
    found, compilations = trained(parts, compiled)
    assert torch.allclose(found, expected, rtol=0, atol=1e-6)
    # Once for the first, once for the phase's other term, and once where a size becomes symbolic.
    assert compilations <= 3


@pytest.mark.filterwarnings("ignore:The .grad attribute:UserWarning")  # the compiler's own look
@pytest.mark.compiles
def test_observe_and_the_step_in_a_compiled_function() -> None:
    """They run as they are, in a break of its graph."""
    ends = []
    for is_compiled in (False, True):
        torch._dynamo.reset()
        p = Parameter(torch.ones(4, 3))
        phases = PhaseScheduler(20)
        adam = phases.upgrade(torch.optim.Adam([{"params": [p], "name": "means"}], lr=0.01))

        def iterate(p: Any = p, phases: Any = phases) -> torch.Tensor:
            loss = p.square().sum()
            phases.observe(loss)
            return loss

        run = torch.compile(iterate, backend="eager") if is_compiled else iterate
        for _ in range(20):
            run().backward()
            adam.step()
            adam.zero_grad()
        ends.append(p.detach())
    assert torch.equal(*ends)
