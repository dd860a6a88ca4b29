"""What only a GPU shows: launch, streams, graph capture. `pytest -m cuda` on a machine with one."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from kernel_host import (
    OPTIONS,
    Problem,
    frame_case,
    frames,
    free_run,
    relative_difference,
    two_loop_case,
)
from torch import Tensor
from trainers import AveragedThroughout, everything

from opt3dgs_optim import (
    AWSGLD,
    Annealing,
    Curvature,
    EnergyHistogram,
    Fading,
    LQNAdam,
    PositionNoise,
    backend_info,
    cuda,
)
from opt3dgs_optim.lbfgs import lqn_direction, new_history, two_loop
from opt3dgs_optim.names import GAUSSIAN
from opt3dgs_optim.parts.noise import covariance_noise

REASON = "torch sees no CUDA device"
if torch.cuda.is_available():
    REASON = backend_info("cuda").reason
pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(
        not torch.cuda.is_available() or backend_info("cuda").backend != "cuda", reason=REASON
    ),
]
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
    history = new_history(x, 5, contiguous=True)
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("rows", [0, 1, 7, 255, 256, 257, 1000, 4096])
@pytest.mark.parametrize("min_aspect", [0.0, 0.1])
def test_the_own_frame(rows: int, dtype: torch.dtype, min_aspect: float) -> None:
    case = frame_case(rows, dtype)
    vectors, quats, scales = (each.double() for each in case)
    size = vectors.norm(dim=1, keepdim=True) * scales.exp().amax(1, keepdim=True)
    v, q, s = (each.cuda() for each in case)
    assert cuda.has_own_frames(q)
    for function, sums in (
        (cuda.own_frame_gradient, "nij,ni->nj"),
        (cuda.own_frame_displacement, "nij,nj->ni"),
    ):
        expected = torch.einsum(sums, frames(quats, scales, min_aspect), vectors)
        gap = function(v, q, s, min_aspect).cpu().double() - expected
        # In a component they may cancel.
        assert bool((gap.abs() <= size * (2e-15 if dtype == torch.float64 else 1e-6)).all())


def test_the_own_frame_does_not_synchronise() -> None:
    v, q, s = (each.cuda() for each in frame_case(1000, torch.float32))
    expected = cuda.own_frame_displacement(v, q, s)  # compiles
    torch.cuda.set_sync_debug_mode("error")
    try:
        found = cuda.own_frame_displacement(v, q, s)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(found, expected)


def noise_case(n: int, dtype: torch.dtype) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """Means, Gaussians whose gate is half open, and eta."""
    g = torch.Generator().manual_seed(2)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)

    gaussians = {"scales": draw(n, 3) - 1, "quats": 3 * draw(n, 4), "opacities": draw(n) - 5.3}
    return draw(n, 3), gaussians, draw(n, 3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("rows", ROWS)
def test_noise(rows: int, dtype: torch.dtype) -> None:
    _, gaussians, eta = noise_case(rows, dtype)
    tensors = {name: tensor.cuda() for name, tensor in gaussians.items()}
    result = covariance_noise(**tensors, eta=eta.cuda())
    # In float32 the gate's exponential turns an error of x into 100 x.
    limit = 1e-12 if dtype == torch.float64 else 1e-5
    assert relative_difference(result.cpu(), covariance_noise(**gaussians, eta=eta)) < limit


def test_noise_is_reproduced_by_the_seed() -> None:
    outcomes = []
    for _ in range(2):
        means, gaussians, _ = noise_case(1000, torch.float32)
        x = means.cuda()
        torch.manual_seed(7)
        on_device = {name: tensor.cuda() for name, tensor in gaussians.items()}
        PositionNoise(on_device, 1.0).add_to(x, 0.1)
        outcomes.append(x)
    assert torch.equal(*outcomes)


def test_side_stream_and_no_synchronisation() -> None:
    x, grad = torch.randn(5000, 3, device="cuda"), torch.randn(5000, 3, device="cuda")
    history = new_history(x, 5, contiguous=True)
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


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="one GPU only")
def test_second_device() -> None:
    x, grad = torch.randn(300, 3, device="cuda:1"), torch.randn(300, 3, device="cuda:1")
    history = new_history(x, 5, contiguous=True)
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


@pytest.mark.parametrize("kind", ["exploration", "exploitation"])
def test_a_captured_step_is_refused(kind: str) -> None:
    """A replay would freeze the factors and the phase."""
    x = torch.nn.Parameter(noise_case(1000, torch.float32)[0].cuda())
    x.grad = torch.ones_like(x)
    if kind == "exploration":
        histogram = EnergyHistogram(energy_range=(0.0, 1.0), temperature=0.1)
        optimizer = AWSGLD([x], histogram=histogram, fused=True, capturable=True)
        histogram.observe(torch.tensor(0.5, device="cuda"))
    else:
        optimizer = LQNAdam([x], backend="cuda", fused=True, capturable=True)
    optimizer.step()
    torch.cuda.synchronize()
    with (
        pytest.raises(RuntimeError, match="captured"),
        torch.cuda.graph(torch.cuda.CUDAGraph()),
    ):
        optimizer.step()


def test_captured_noise_follows_the_learning_rate() -> None:
    means, gaussians, _ = noise_case(1000, torch.float32)
    x, lr = means.cuda(), torch.tensor(1e-3, device="cuda")
    noise = PositionNoise({k: v.cuda() for k, v in gaussians.items()}, 1.0)
    graph = capture(lambda: noise.add_to(x, lr))
    moves = []
    for rate in (0.0, 1.0, 2.0):
        lr.fill_(rate)
        before = x.clone()
        graph.replay()
        moves.append(float((x - before).norm()))
    assert moves[0] == 0.0
    assert moves[2] / moves[1] == pytest.approx(2.0, rel=0.5)  # another draw of eta


def test_phase_scheduler_steps_without_synchronisation() -> None:
    means, gaussians, _ = noise_case(1000, torch.float32)
    splats = {k: torch.nn.Parameter(v.cuda()) for k, v in {"means": means, **gaussians}.items()}
    adams = {
        name: torch.optim.Adam([{"params": [p], "lr": 1e-3, "name": name}], fused=True)
        for name, p in splats.items()
    }
    others = (
        Annealing(names=GAUSSIAN),
        Fading(events=10),
        AveragedThroughout(),
        PositionNoise(splats, 1.0),
    )
    phases = everything(40, 20, *others, curvature=Curvature(backend="cuda"))
    optimizers = phases.upgrade(adams)
    loss = torch.tensor(0.1, device="cuda")
    for step in range(40):
        for p in splats.values():
            p.grad = torch.randn_like(p)
        quiet = step not in (0, 1, 20, 21)  # first use of a phase compiles and allocates
        torch.cuda.set_sync_debug_mode("error" if quiet else "default")
        try:
            phases.observe(loss)
            for optimizer in optimizers.values():
                optimizer.step()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    assert all(bool(torch.isfinite(p).all()) for p in splats.values())


def test_the_histogram_has_the_cpus_numbers_without_synchronisation() -> None:
    g = torch.Generator().manual_seed(0)
    values = (0.1 + 0.01 * torch.randn(600, generator=g)).tolist()
    values[0] = values[300] = float("nan")
    here, there = EnergyHistogram(), EnergyHistogram()
    there.observe(torch.tensor(values[0], device="cuda"))  # compiles
    energies = torch.tensor(values, device="cuda").unbind()
    here.observe(values[0])
    torch.cuda.set_sync_debug_mode("error")
    try:
        for energy in energies[1:]:
            there.observe(energy)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    for value in values[1:]:
        here.observe(value)
    assert there.state_dict()["num_taken"] == here.state_dict()["num_taken"] == 598
    # float32 over 600 updates that forget
    assert float(there.multiplier) == pytest.approx(float(here.multiplier), abs=1e-3)
    assert float(there.mean_multiplier) == pytest.approx(float(here.mean_multiplier), abs=1e-3)
    assert float(there.multiplier_std) == pytest.approx(float(here.multiplier_std), abs=1e-3)
