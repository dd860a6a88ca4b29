"""The step's kernels on a GPU: `pytest -m cuda tests/cuda/test_step.py` on a machine with one."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from step_cases import (
    both,
    case,
    coded_combinations,
    codes_apart,
    combinations,
    moved,
    numbers_and_codes,
    tensors,
)
from torch import Tensor

from opt3dgs_optim import PhaseScheduler, triton
from opt3dgs_optim.parts.out_of_view import look_at_positions
from opt3dgs_optim.step import Step, chosen_rows

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device"),
]
CASES, CODED = list(combinations()), list(coded_combinations())
# exp, sqrt and division of a GPU are right to some units in the last place, thrice in a row.
TOLERANCE = 2e-5


def test_triton_launches_here() -> None:
    assert triton.missing() is None


def on_gpu(step: Step) -> Step:
    """The step, made on the GPU."""
    step = moved(step, Tensor.cuda)
    assert triton.takes(step)
    triton.take_step(step)
    return step


@pytest.mark.parametrize("at", range(len(CASES)))
def test_a_step_is_that_of_a_cpu(at: int) -> None:
    options, shape = CASES[at]
    made = both(options, shape, by=on_gpu)
    assert torch.equal(made[0].nonfinite, made[1].nonfinite.cpu())
    for ours, theirs in zip(tensors(made[0]), tensors(made[1]), strict=True):
        size = ours.abs()
        size = size.amax(1, keepdim=True) if options.get("frame") and ours.dim() > 1 else size
        assert ((ours - theirs.cpu()).abs() <= TOLERANCE * size.clamp(min=1.0)).all()


@pytest.mark.parametrize("at", range(len(CODED)))
def test_codes_are_those_of_a_cpu(at: int) -> None:
    """But where a rounding before them lies on the border of two."""
    options, shape = CODED[at]
    ours, theirs = both(options, shape, by=on_gpu)
    theirs = moved(theirs, Tensor.cpu)
    for away in codes_apart(ours, theirs):
        assert away.max() <= 1
        assert (away > 0).sum() <= 1 + 0.01 * away.numel()
    for one, other in zip(numbers_and_codes(ours)[0], numbers_and_codes(theirs)[0], strict=True):
        size = one.abs().amax(1, keepdim=True) if one.dim() > 1 else one.abs()
        assert ((one - other).abs() <= TOLERANCE * size.clamp(min=1.0)).all()


@pytest.mark.parametrize("options", [{"mean": True, "hold": True}, {"mean": True, "coded": True}])
def test_tensors_that_begin_anywhere(options: dict[str, Any]) -> None:
    """As views into a larger buffer do: they are not read by vectors."""

    def amid(tensor: Tensor) -> Tensor:
        larger = tensor.new_zeros(tensor.numel() + 1, device="cuda")
        return larger[1:].view(tensor.shape).copy_(tensor)

    found = []
    for place in (Tensor.cuda, amid):
        step = moved(case((257, 3), torch.Generator().manual_seed(0), **options), place)
        triton.take_step(step)
        found.append(tensors(step))
    assert all(map(torch.equal, *found))


def test_positions_are_looked_at_as_by_torch() -> None:
    draw = torch.Generator().manual_seed(0)
    grad, second = torch.randn(2, 5_001, 3, generator=draw)
    grad[torch.rand(5_001, generator=draw) < 0.7] = 0.0
    second[torch.rand(5_001, generator=draw) < 0.3] = 0.0
    found = []
    for look in (triton.look, look_at_positions):
        out_of_view = torch.empty(5_001, dtype=torch.bool, device="cuda")
        counter = torch.zeros(1, dtype=torch.int64, device="cuda")
        look(grad.cuda(), second.cuda(), out_of_view, counter)
        found.append((out_of_view, counter))
    assert all(map(torch.equal, *found))


def test_the_same_rows_fade() -> None:
    step = case((4099, 3), torch.Generator().manual_seed(0), fade=True)
    step.state["exp_avg"].fill_(1.0)
    step = moved(step, Tensor.cuda)
    step.grad.zero_()
    triton.take_step(step)
    assert step.fade is not None
    chosen = chosen_rows(step.fade, 4099, torch.device("cpu"))
    assert torch.equal((step.state["exp_avg"] < 0.5).any(1).cpu(), chosen)


QUIET = pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype:UserWarning")


@QUIET
@pytest.mark.parametrize("moments", [32, 16])
def test_a_training_neither_waits_nor_allocates(moments: Any) -> None:
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "shN": (15, 3)}
    adams = {}
    for name, shape in shapes.items():
        param = torch.nn.Parameter(torch.randn(10_000, *shape, device="cuda"))
        param.grad = torch.randn_like(param)
        adams[name] = torch.optim.Adam([param], lr=1e-3, eps=1e-15)
    PhaseScheduler(300, moments=moments).upgrade(adams)

    def iterate(count: int) -> None:
        for _ in range(count):
            for adam in adams.values():
                adam.step()

    iterate(10)
    torch.cuda.synchronize()
    before = torch.cuda.memory_allocated()
    for count in (90, 99, 59):  # to iterations 99, 199 and 259
        torch.cuda.reset_peak_memory_stats()
        torch.cuda.set_sync_debug_mode("error")
        try:
            iterate(count)
            assert torch.cuda.max_memory_allocated() == before
            if count > 59:
                iterate(1)  # sorts the longest axes
        finally:
            torch.cuda.set_sync_debug_mode("default")
    torch.cuda.set_sync_debug_mode("error")
    try:
        iterate(40)  # the last thirtieth, which keeps the mean
    finally:
        torch.cuda.set_sync_debug_mode("default")
    mean = sum(4 * p.numel() for a in adams.values() for p in a.param_groups[0]["params"])
    mean += 4 * 10_000 * (len(adams) + 3)  # where rows began, and the rest of the positions' means
    assert torch.cuda.max_memory_allocated() - before <= mean + 65_536
