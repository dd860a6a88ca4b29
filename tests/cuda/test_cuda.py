"""What only a GPU shows: launch, streams, graph capture. `pytest -m cuda` on a machine with one."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import pytest
import torch
from kernel_host import (
    OPTIONS,
    Problem,
    free_run,
    relative_difference,
    two_loop_case,
)
from torch import Tensor

from opt3dgs_optim import backend_info
from opt3dgs_optim.lbfgs import lqn_direction, new_history, two_loop

REASON = "torch sees no CUDA device"
if torch.cuda.is_available():
    REASON = backend_info("cuda").reason
pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(
        not torch.cuda.is_available() or backend_info("cuda").backend != "cuda", reason=REASON
    ),
]
# torch says once that its debug mode does not see every wait.
QUIET = pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype:UserWarning")
KERNEL = {**OPTIONS, "backend": "cuda"}
ROWS = (0, 1, 255, 256, 257, 1000, 4096)


def on_gpu(x: Tensor, grad: Tensor, history: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """The operator on the GPU, for tensors of the CPU."""
    cells = history.cuda()
    result = lqn_direction(x.cuda(), grad.cuda(), cells, size, **KERNEL)  # pyright: ignore
    history.copy_(cells)
    return tuple(part.cpu() for part in result)  # pyright: ignore


@pytest.mark.parametrize("size", [1, 3, 4, 5])
@pytest.mark.parametrize("rows", ROWS)
def test_free_running_in_float64(rows: int, size: int) -> None:
    problem = Problem(rows)
    result = free_run(lambda x, g, h: on_gpu(x, g, h, size), problem, size)
    expected = free_run(
        lambda x, g, h: lqn_direction(x, g, h, size, **OPTIONS),  # pyright: ignore
        problem,
        size,
    )
    for a, b in zip(result, expected, strict=True):
        assert relative_difference(a, b) < 1e-10


@pytest.mark.parametrize("rows", ROWS)
def test_single_step_in_float32(rows: int) -> None:
    options = {**OPTIONS, "min_cosine": 0.1}
    x, grad = Problem(rows).start.float(), Problem(rows, 1).start.float()
    history = new_history(x, 5)
    for k in range(4):
        lqn_direction(x + 0.1 * k * grad, grad * (1 + k), history, 5, **options)  # pyright: ignore
    twin = history.cuda()
    options["backend"] = "cuda"
    result = lqn_direction(x.cuda(), grad.cuda(), twin, 5, **options)  # pyright: ignore
    del options["backend"]
    expected = lqn_direction(x, grad, history, 5, **options)  # pyright: ignore
    same = (result[1].cpu() == expected[1]) & (result[2].cpu() == expected[2])
    assert bool(same.all()) or float((~same).float().mean()) < 1e-3
    assert relative_difference(result[0].cpu()[same], expected[0][same]) < 1e-5


@pytest.mark.parametrize("size", [1, 3, 4, 5])
@pytest.mark.parametrize("rows", ROWS)
def test_the_recursion_alone(rows: int, size: int) -> None:
    grad, history = two_loop_case(rows, size)
    expected = two_loop(grad, history, size)
    for cells in (history.cuda(), history.contiguous().cuda()):
        found = two_loop(grad.cuda(), cells, size)
        insisted = two_loop(grad.cuda(), cells, size, backend="cuda")
        assert torch.equal(found.nan_to_num(), insisted.nan_to_num())
        assert relative_difference(found.cpu(), expected) < 1e-10


@QUIET
def test_the_recursion_does_not_synchronise_and_can_be_captured() -> None:
    grad, history = (t.float().cuda() for t in two_loop_case(1000, 5))
    expected = two_loop(grad, history, 5)  # compiles
    torch.cuda.set_sync_debug_mode("error")
    try:
        found = two_loop(grad, history, 5)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(found.nan_to_num(), expected.nan_to_num())
    given, result = torch.zeros_like(grad), torch.empty_like(grad)
    graph = capture(lambda: result.copy_(two_loop(given, history, 5)))  # pyright: ignore
    given.copy_(grad)
    graph.replay()
    assert torch.equal(result.nan_to_num(), expected.nan_to_num())


@QUIET
def test_side_stream_and_no_synchronisation() -> None:
    x, grad = torch.randn(5000, 3, device="cuda"), torch.randn(5000, 3, device="cuda")
    history = new_history(x, 5)
    lqn_direction(x, grad, history, 5, **KERNEL)  # pyright: ignore
    expected, _, _ = lqn_direction(x + 1, 2 * grad, history.clone(), 5, **KERNEL)  # pyright: ignore
    stream = torch.cuda.Stream()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        with torch.cuda.stream(stream):
            moved, turned = x + 1, 2 * grad
            result, _, _ = lqn_direction(moved, turned, history, 5, **KERNEL)  # pyright: ignore
    finally:
        torch.cuda.set_sync_debug_mode("default")
    stream.synchronize()
    assert torch.equal(result, expected)


def test_a_launch_costs_little_of_python() -> None:
    """At most 25 us with all that Python does; a launch of torch's own takes five."""
    grad, history = (t.float().cuda().contiguous() for t in two_loop_case(10_000, 5))
    times = []
    for _ in range(200):
        torch.cuda.synchronize()
        begun = time.perf_counter()
        for _ in range(10):  # no more than a queue takes
            two_loop(grad, history, 5)
        times.append((time.perf_counter() - begun) / 10)
    assert statistics.median(times) < 25e-6


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one GPU only")
def test_second_device() -> None:
    x, grad = torch.randn(300, 3, device="cuda:1"), torch.randn(300, 3, device="cuda:1")
    history = new_history(x, 5)
    result, _, _ = lqn_direction(x, grad, history, 5, **KERNEL)  # pyright: ignore
    assert torch.equal(result, grad)


def capture(body: Callable[[], None]) -> torch.cuda.CUDAGraph:
    """Warm up on a side stream (compiles, loads, allocates), then capture."""
    side = torch.cuda.Stream()
    with torch.cuda.stream(side):
        for _ in range(3):
            body()
    side.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        body()
    return graph
