"""The step's kernels on a GPU: `pytest -m cuda tests/cuda/test_step.py` on a machine with one."""

from __future__ import annotations

import pytest
import torch
from step_cases import both, case, combinations, moved, tensors
from torch import Tensor

from opt3dgs_optim import PhaseScheduler, triton
from opt3dgs_optim.step import Step, chosen_rows

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device"),
]
CASES = list(combinations())
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
def test_a_training_neither_waits_nor_allocates() -> None:
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "shN": (15, 3)}
    adams = {}
    for name, shape in shapes.items():
        param = torch.nn.Parameter(torch.randn(10_000, *shape, device="cuda"))
        param.grad = torch.randn_like(param)
        adams[name] = torch.optim.Adam([param], lr=1e-3, eps=1e-15)
    PhaseScheduler(300).upgrade(adams)

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
    assert torch.cuda.max_memory_allocated() - before <= mean + 6 * 4 * 10_000 + 65_536
