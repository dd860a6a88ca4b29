"""One step of the curvature: its routing, its memory and its calls."""

from __future__ import annotations

import sys
import weakref
from pathlib import Path
from typing import Any

import pytest
import torch
from points_first import direction, header, record
from simulated_device import on_device, on_host
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from opt3dgs_optim import cuda
from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history, two_loop
from opt3dgs_optim.lbfgs import pairs as columns_of
from opt3dgs_optim.lbfgs.backend import obstacle
from opt3dgs_optim.lbfgs.history import laid_out

# inductor imports parts of torch that torch itself has deprecated
pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")


def points(
    n: int, dtype: torch.dtype = torch.float32, dim: int = 3
) -> tuple[Tensor, Tensor, Tensor]:
    """Position, gradient and a history with two pairs."""
    g = torch.Generator().manual_seed(n)
    draws = torch.randn(6, n, dim, generator=g, dtype=torch.float64).to(dtype)
    history = new_history(draws[0], 5)
    for x in draws[:3]:
        record(history, 5, x, 2 * x, torch.ones(n, dtype=torch.bool), min_cosine=1e-6)
    return draws[3], draws[4], history


@pytest.mark.slow
def test_pure_torch_compiles_with_inductor() -> None:
    """The path of ROCm, MPS and CPU; slow only because of the compiler."""
    _, grad, history = points(1000)
    compiled = torch.compile(two_loop, fullgraph=True)(grad, history, 5)
    torch.testing.assert_close(compiled, two_loop(grad, history, 5), rtol=1e-5, atol=1e-6)


def test_both_memory_layouts_give_the_same_numbers() -> None:
    x, grad, history = points(40)
    outcomes = []
    for contiguous in (False, True):
        copy = laid_out(history.clone(), contiguous=contiguous)
        assert copy.is_contiguous() == contiguous
        fed, _, _ = lqn_direction(x, grad, copy, 5, min_cosine=1e-6, graft=True)
        outcomes.append((fed, copy))
    assert torch.equal(outcomes[0][0], outcomes[1][0])
    assert torch.equal(outcomes[0][1], outcomes[1][1])


@pytest.mark.parametrize("contiguous", [False, True])
def test_chunks_make_the_whole(contiguous: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Directions, pairs and the history, which is written where it lies."""
    x, grad, history = points(40)
    outcomes = []
    for chunk in (7, 40):
        monkeypatch.setattr(columns_of, "CHUNK", chunk)
        copy = laid_out(history.clone(), contiguous=contiguous)
        found = lqn_direction(x, grad, copy, 5, min_cosine=1e-6, graft=True)
        outcomes.append([*found, copy])
    # other SIMD lanes: equal to rounding
    torch.testing.assert_close(*outcomes, rtol=1e-5, atol=1e-6)
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


class LiveBytes(TorchDispatchMode):
    """The most bytes that the tensors made in its scope have held at a time."""

    def __init__(self) -> None:
        super().__init__()
        self.alive: list[tuple[weakref.ref[Tensor], int, int]] = []  # tensor, address, bytes
        self.most = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
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


@pytest.mark.parametrize("contiguous", [False, True])
@pytest.mark.parametrize("dim", [1, 3, 4])
def test_memory_is_that_of_the_results_and_one_chunk(
    dim: int, contiguous: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """10^7 points: 14 bytes each beside history, position and gradient, whatever D is."""
    n, chunk = 20_000, 500
    monkeypatch.setattr(columns_of, "CHUNK", chunk)
    x, grad, history = points(n, dim=dim)
    history = laid_out(history, contiguous=contiguous)
    with LiveBytes() as memory:
        lqn_direction(x, grad, history, 5, min_cosine=1e-6, graft=True, backend="torch")
    results = n * (4 * dim + 2)
    # of a chunk: less than its history, three times
    assert results <= memory.most < results + 3 * chunk * history[0].numel() * 4


def test_a_gpu_works_on_a_million_rows_at_a_time() -> None:
    chunks = columns_of.row_chunks(torch.empty(2_500_000, 3, device="meta"))
    assert [c.stop for c in chunks] == [1 << 20, 2 << 20, 2_500_000]
    assert columns_of.row_chunks(torch.empty(0, 3, device="meta")) == [slice(0, 0)]


@pytest.mark.parametrize("dim", [2, 3, 7])
def test_python_calls(dim: int) -> None:
    """Of the package, in one call; at 1,000 points they are what it costs."""
    x, grad, history = points(100, dim=dim)
    calls = 0

    def count(frame: Any, event: str, _: Any) -> None:
        nonlocal calls
        home = str(Path(cuda.__file__).parents[1])
        calls += event == "call" and frame.f_code.co_filename.startswith(home)

    sys.setprofile(count)
    try:
        lqn_direction(x, grad, history, 5, min_cosine=1e-6, graft=True)
    finally:
        sys.setprofile(None)
    assert 10 < calls <= 52


class Operators(TorchDispatchMode):
    """Counts the operators of its scope, and those of them that are views."""

    count = views = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        self.views += func.is_view
        return func(*args, **(kwargs or {}))


def test_operators_of_a_chunk() -> None:
    """Seven for each of the five pairs, and what is about them; views are made once a chunk."""
    x, grad, history = points(100)
    with Operators() as of_a_step:
        lqn_direction(x, grad, history, 5, min_cosine=1e-6, graft=True)
    with Operators() as of_the_recursion:
        two_loop(grad, history, 5)
    assert of_a_step.count - of_a_step.views <= 84
    assert of_a_step.views <= 63
    assert of_the_recursion.count - of_the_recursion.views <= 47


# -- which backend runs ----------------------------------------------------------------------------


def test_cuda_is_for_three_coordinates() -> None:
    with pytest.raises(RuntimeError, match=r"points of 2 coordinates, .* at most 5 of 3"):
        lqn_direction(*points(7, dim=2), 5, min_cosine=0.0, graft=True, backend="cuda")
    with pytest.raises(RuntimeError, match=r"asked for on cpu in torch\.float32"):
        lqn_direction(*points(7), 5, min_cosine=0.0, graft=True, backend="cuda")


@pytest.mark.parametrize(
    "position",
    [
        torch.zeros(5, 3),
        torch.zeros(4, 2),
        torch.zeros(4, 3, device="meta"),
        torch.zeros(4, 3, dtype=torch.float64),
    ],
    ids=["other rows", "other columns", "another device", "another dtype"],
)
def test_a_position_that_is_not_the_gradients_is_refused(position: Tensor) -> None:
    grad = torch.ones(4, 3)
    history = new_history(grad, 5)
    message = r"position is \(\d, \d\) torch\.\w+ on \w+, but \(4, 3\) torch\.float32 on cpu is"
    with pytest.raises(ValueError, match=message):
        lqn_direction(position, grad, history, 5, min_cosine=0.0, graft=True)


def test_more_pairs_than_a_thread_holds_are_torchs() -> None:
    gpu = torch.device("cuda")
    assert obstacle("auto", gpu, torch.float32, 3, 6)
    with pytest.raises(RuntimeError, match="no kernel for 6 pairs of points of 3 coordinates"):
        obstacle("cuda", gpu, torch.float32, 3, 6)


class There(Tensor):
    """On a GPU, as far as it says."""

    is_cuda = True  # pyright: ignore[reportAssignmentType]


def test_points_on_a_gpu_are_one_launch(monkeypatch: pytest.MonkeyPatch) -> None:
    x, grad, history = points(7)
    module = sys.modules["opt3dgs_optim.lbfgs.two_loop"]
    asked: list[Any] = []
    monkeypatch.setattr(module, "obstacle", lambda *given: asked.append(given))
    monkeypatch.setattr(cuda, "lqn_direction", lambda *_: "launched")
    options = {"min_cosine": 0.0, "graft": True}
    assert lqn_direction(x, grad.as_subclass(There), history, 5, **options) == "launched"
    assert asked == [("auto", grad.device, grad.dtype, 3, 5)]
    assert lqn_direction(x, grad, history, 5, **options) != "launched"
    assert len(asked) == 1  # nobody asks for points on a host


def test_the_recursion_on_a_gpu_is_one_launch(monkeypatch: pytest.MonkeyPatch) -> None:
    _, grad, history = points(7)
    module = sys.modules["opt3dgs_optim.lbfgs.two_loop"]
    asked: list[Any] = []
    monkeypatch.setattr(module, "obstacle", lambda *given: asked.append(given))
    monkeypatch.setattr(cuda, "two_loop", lambda *_: "launched")
    assert two_loop(grad.as_subclass(There), history, 5) == "launched"
    assert asked == [("auto", grad.device, grad.dtype, 3, 5)]
    # Nobody asks for points on a host, or where torch.compile traces.
    assert two_loop(grad, history, 5) != "launched"
    monkeypatch.setattr(torch.compiler, "is_compiling", lambda: True)
    assert two_loop(grad.as_subclass(There), history, 5) != "launched"
    assert len(asked) == 1
    assert two_loop(grad, history, 5, backend="cuda") == "launched"


def test_the_recursion_insists_as_it_is_told() -> None:
    _, grad, history = points(7)
    assert torch.equal(two_loop(grad, history, 5, backend="torch"), two_loop(grad, history, 5))
    with pytest.raises(RuntimeError, match=r"backend='cuda' was asked for on cpu"):
        two_loop(grad, history, 5, backend="cuda")
    with pytest.raises(ValueError, match=r"two_loop: backend='gpu', but 'auto' or 'cuda' or"):
        two_loop(grad, history, 5, backend="gpu")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("kernel", [False, True])
def test_a_history_is_laid_out_for_what_reads_it(
    kernel: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = sys.modules["opt3dgs_optim.lbfgs.history"]
    monkeypatch.setattr(module, "obstacle", lambda *_: None if kernel else "no")
    s = torch.randn(5, 9, 3)
    history = history_from_pairs(s.as_subclass(There), s.as_subclass(There))
    assert history.is_contiguous() == kernel
    assert torch.equal(history, history_from_pairs(s, s))


def test_gradients_too_small_for_products() -> None:
    """Pairs of much curvature are short: their product with the gradient has no digits left."""
    s = torch.tensor([[[0.0, 1e-9, 0.0]], [[1.0, 0.0, 0.0]]])
    y = torch.tensor([[[0.0, 1.0, 0.5]], [[1.0, 0.0, 0.0]]])
    grad, history = torch.ones(1, 3), history_from_pairs(s, y)
    expected = two_loop(grad.double(), history_from_pairs(s.double(), y.double()), 2)
    small = 1e-36 * grad
    for found in (two_loop(small, history, 2), direction(small, history, 2, graft=False)):
        torch.testing.assert_close(found.double() * 1e36, expected, rtol=1e-6, atol=1e-6)


def test_a_direction_beyond_float32_leaves_the_gradient() -> None:
    """Long along x, and as long as a gradient of three components of 3e38."""
    y = torch.eye(3)[:2, None]
    s = y * torch.tensor([1e3, 1e-3]).reshape(2, 1, 1)
    history = history_from_pairs(torch.cat([s[:1], s]), torch.cat([y[:1], y]))
    header(history, 3).gradient.fill_(3e38)
    grad = torch.full((1, 3), 3e38)
    fed, *_ = lqn_direction(grad, grad, history, 3, min_cosine=1e-6, graft=True)
    assert torch.equal(fed, grad)
