"""Where a step of the curvature runs, and what memory and calls it takes."""

from __future__ import annotations

import inspect
import sys
import weakref
from contextlib import nullcontext
from types import ModuleType
from typing import Any

import pytest
import torch
from simulated_device import on_device, on_host
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from opt3dgs_optim import cuda
from opt3dgs_optim.lbfgs import lqn_direction, new_history, two_loop
from opt3dgs_optim.lbfgs import pairs as columns_of
from opt3dgs_optim.lbfgs.backend import backend_info, obstacle

OPTIONS: dict[str, Any] = {"min_cosine": 1e-6, "graft": True}


def points(n: int, dim: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """Position, gradient and a history with two pairs."""
    draws = torch.randn(5, n, dim, generator=torch.Generator().manual_seed(n))
    history = new_history(draws[0], 5)
    for x in draws[:3]:
        lqn_direction(x, 2 * x, history, 5, **OPTIONS)
    return draws[3], draws[4], history


@pytest.mark.compiles
@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")  # inductor's, of torch's own
def test_pure_torch_compiles_with_inductor() -> None:
    """The path of ROCm, MPS and CPU."""
    _, grad, history = points(1000)
    compiled = torch.compile(two_loop, fullgraph=True)(grad, history, 5)
    torch.testing.assert_close(compiled, two_loop(grad, history, 5), rtol=1e-5, atol=1e-6)


def test_chunks_make_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Directions, pairs and the history, which is written where it lies."""
    x, grad, history = points(40)
    outcomes = []
    for chunk in (40, 7):
        monkeypatch.setattr(columns_of, "CHUNK", chunk)
        copy = history.clone()
        outcomes.append([*lqn_direction(x, grad, copy, 5, **OPTIONS), copy])
    # other SIMD lanes: equal to rounding
    torch.testing.assert_close(outcomes[1], outcomes[0], rtol=1e-5, atol=1e-6)
    assert not torch.equal(outcomes[0][-1], history)


def test_columns_of_a_device_are_those_of_a_cpu() -> None:
    """There and back."""
    points = torch.randn(2, 9, 3)
    found = columns_of.columns(*(on_device(each) for each in points))
    assert torch.equal(on_host(found), points.mT)
    there = on_device(torch.empty(9, 3))
    columns_of.put(there, found[1])
    assert torch.equal(on_host(there), points[1])


# -- what it costs ---------------------------------------------------------------------------------


class Operators(TorchDispatchMode):
    """Counts the operators of its scope, and the most bytes of tensors made in it."""

    def __init__(self) -> None:
        super().__init__()
        self.alive: list[tuple[weakref.ref[Tensor], int, int]] = []  # tensor, address, bytes
        self.count = self.most = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        self.count += not func.is_view
        given = {a.untyped_storage().data_ptr() for a in args if isinstance(a, Tensor)}
        for one in found if isinstance(found, (list, tuple)) else [found]:
            if isinstance(one, Tensor):
                storage = one.untyped_storage()
                ours = any(at == storage.data_ptr() for _, at, _ in self.alive)
                if ours or storage.data_ptr() not in given:  # not a view of an argument
                    self.alive.append((weakref.ref(one), storage.data_ptr(), storage.nbytes()))
        self.alive = [entry for entry in self.alive if entry[0]() is not None]
        self.most = max(self.most, sum({at: size for _, at, size in self.alive}.values()))
        return found


@pytest.mark.parametrize("dim", [1, 3, 4])
def test_memory_is_that_of_the_results_and_one_chunk(
    dim: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """10^7 points: 14 bytes each beside history, position and gradient, whatever D is."""
    n, chunk = 20_000, 500
    monkeypatch.setattr(columns_of, "CHUNK", chunk)
    x, grad, history = points(n, dim)
    with Operators() as memory:
        lqn_direction(x, grad, history, 5, **OPTIONS, backend="torch")
    results = n * (4 * dim + 2)
    # of a chunk: less than its history, three times
    assert results <= memory.most < results + 3 * chunk * history[0].numel() * 4


def test_operators_of_a_chunk() -> None:
    """Seven for each of the five pairs, and what is about them; a GPU has a million rows in one."""
    x, grad, history = points(100)
    with Operators() as of_a_step:
        lqn_direction(x, grad, history, 5, **OPTIONS)
    assert of_a_step.count <= 86
    chunks = columns_of.row_chunks(torch.empty(2_500_000, 3, device="meta"))
    assert [c.stop for c in chunks] == [1 << 20, 2 << 20, 2_500_000]


# -- which backend runs ----------------------------------------------------------------------------


def test_a_gpu_that_nothing_compiles_for_has_plain_torch(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As with an NVRTC that does not know it; of each GPU by itself."""
    asked = []

    def kernel(_: str, device: int, *__: Any) -> None:
        asked.append(device)
        if device == 1:
            raise RuntimeError("invalid value for --gpu-architecture")

    monkeypatch.setitem(sys.modules, "cuda.core", ModuleType("cuda.core"))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device", nullcontext)
    monkeypatch.setattr(cuda, "_kernel", kernel)
    monkeypatch.setattr(cuda, "missing", inspect.unwrap(cuda.missing))
    assert backend_info("cuda:0").backend == "cuda"
    found = backend_info("cuda:1")
    assert (found.backend, asked) == ("torch", [0, 1])
    assert "cannot compile for this GPU: RuntimeError: invalid value" in found.reason
    assert found.reason in caplog.text


def test_what_insists_on_a_kernel_is_told_why_there_is_none() -> None:
    gpu, (x, grad, history) = torch.device("cuda"), points(7)
    assert torch.equal(two_loop(grad, history, 5, backend="torch"), two_loop(grad, history, 5))
    with pytest.raises(RuntimeError, match="backend='cuda' was asked for on cpu, but"):
        two_loop(grad, history, 5, backend="cuda")
    with pytest.raises(RuntimeError, match="asked for on cpu, but"):
        lqn_direction(x, grad, history, 5, **OPTIONS, backend="cuda")
    with pytest.raises(RuntimeError, match=r"points of 2 coordinates, .* at most 5 of 3"):
        lqn_direction(*points(7, dim=2), 5, **OPTIONS, backend="cuda")
    with pytest.raises(RuntimeError, match="no kernel for 6 pairs of points of 3 coordinates"):
        obstacle("cuda", gpu, 3, 6)
    assert obstacle("auto", gpu, 3, 6)  # more than a thread holds are torch's
    with pytest.raises(ValueError, match=r"two_loop: backend='gpu', but 'auto' or 'cuda' or"):
        two_loop(grad, history, 5, backend="gpu")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("wrong", [{"size": (5, 3)}, {"device": "meta"}, {"dtype": torch.float64}])
def test_a_position_that_is_not_the_gradients_is_refused(wrong: dict[str, Any]) -> None:
    position = torch.zeros(**{"size": (4, 3), **wrong})
    _, grad, history = points(4)
    message = r"position is \(\d, \d\) torch\.\w+ on \w+, but \(4, 3\) torch\.float32 on cpu is"
    with pytest.raises(ValueError, match=message):
        lqn_direction(position, grad, history, 5, **OPTIONS)


class There(Tensor):
    """On a GPU, as far as it says."""

    is_cuda = True  # pyright: ignore[reportAssignmentType]


@pytest.mark.parametrize("name", ["two_loop", "lqn_direction"])
def test_points_on_a_gpu_are_one_launch(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody asks for a kernel for points on a host, or where torch.compile traces."""
    x, grad, history = points(7)
    asked: list[Any] = []
    monkeypatch.setattr(
        sys.modules["opt3dgs_optim.lbfgs.two_loop"], "obstacle", lambda *given: asked.append(given)
    )
    monkeypatch.setattr(cuda, name, lambda *_: "launched")

    def called(grad: Tensor, **options: Any) -> Any:
        if name == "two_loop":
            return two_loop(grad, history, 5, **options)
        return lqn_direction(x, grad, history, 5, **OPTIONS, **options)

    assert called(grad.as_subclass(There)) == "launched"
    assert asked == [("auto", grad.device, 3, 5)]
    assert called(grad) != "launched"
    assert len(asked) == 1
    assert called(grad, backend="cuda") == "launched"
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert name != "two_loop" or called(grad.as_subclass(There)) != "launched"
