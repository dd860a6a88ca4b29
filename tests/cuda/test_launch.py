"""A launch up to the driver's call: what it is given, what is made only once. No GPU is needed."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from kernel_host import two_loop_case
from torch import Tensor

from opt3dgs_optim import cuda

core = pytest.importorskip("cuda.core", reason="cuda.core is not installed (extra 'cuda')")
HERE = -1  # what torch calls the device of a CPU's tensors


class Machine:
    """A machine whose driver only keeps what it is given."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.launched: list[tuple[Any, ...]] = []
        self.compiled: list[tuple[Any, ...]] = []
        self.current, self.stream = HERE, 0
        monkeypatch.setattr(cuda, "several_gpus", lambda: True)
        monkeypatch.setattr(torch.cuda, "current_device", lambda: self.current)
        monkeypatch.setattr(torch.cuda, "device", self.on)
        monkeypatch.setattr(
            torch._C, "_cuda_getCurrentRawStream", lambda device: self.stream, raising=False
        )
        monkeypatch.setattr(cuda, "_kernel", lambda *what: self.compiled.append(what) or "kernel")
        monkeypatch.setattr(cuda, "_launcher", lambda: lambda *given: self.launched.append(given))

    @contextmanager
    def on(self, device: int) -> Iterator[None]:
        before, self.current = self.current, device
        yield
        self.current = before


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    return Machine(monkeypatch)


def case(rows: int, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    grad, history = two_loop_case(rows, 5)
    return grad.to(dtype), history.to(dtype).contiguous()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(("rows", "blocks"), [(1, 1), (128, 1), (129, 2), (300, 3)])
def test_the_recursions_launch(machine: Machine, rows: int, blocks: int, dtype: Any) -> None:
    machine.stream = 4096
    grad, history = case(rows, dtype)
    result = cuda.two_loop(grad, history, 5)
    ((stream, config, kernel, *values),) = machine.launched
    assert isinstance(stream, core.Stream)  # an object of others would be warned of
    assert stream.__cuda_stream__() == (0, 4096)
    assert (config.grid, config.block) == ((blocks, 1, 1), (cuda.BLOCK, 1, 1))
    assert kernel == "kernel"
    assert machine.compiled == [("two_loop", HERE, dtype, 5)]
    assert values == [grad.data_ptr(), history.data_ptr(), result.data_ptr(), rows]


def test_the_steps_launch(machine: Machine) -> None:
    grad, history = case(9)
    position = torch.ones_like(grad)
    found = cuda.lqn_direction(position, grad, history, 5, 0.25, True)
    ((_, _, _, *values),) = machine.launched
    tensors = (position, grad, history, *found)
    assert values[:6] == [each.data_ptr() for each in tensors]
    assert [(type(each).__name__, each) for each in values[6:]] == [
        ("int", 9),
        ("float32", 0.25),
        ("int32", 1),
    ]
    assert [each.dtype for each in found] == [torch.float32, torch.bool, torch.bool]


def test_what_does_not_change_is_made_once(machine: Machine) -> None:
    grad, history = case(300)
    for stream in (0, 0, 8, 0):
        machine.stream = stream
        cuda.two_loop(grad, history, 5)
    streams = [given[0] for given in machine.launched]
    assert streams[0] is streams[1] is streams[3]
    assert [stream.__cuda_stream__()[1] for stream in streams] == [0, 0, 8, 0]
    assert len({id(given[1]) for given in machine.launched}) == 1


def test_another_device_is_current_for_the_launch_alone(machine: Machine) -> None:
    current = []
    machine.current = 3
    machine.launched = type("At", (list,), {"append": lambda *_: current.append(machine.current)})()
    cuda.two_loop(*case(9), 5)
    assert (current, machine.current) == ([HERE], 3)


def test_a_look_whether_a_device_can_leaves_another_current(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)

    def kernel(_: str, device: int, *__: Any) -> None:
        machine.current = device  # as cuda.core's set_current

    monkeypatch.setattr(cuda, "_kernel", kernel)
    machine.current = 0
    assert inspect.unwrap(cuda.missing)(1) is None
    assert machine.current == 0


def test_no_rows_are_no_launch(machine: Machine) -> None:
    assert cuda.two_loop(*case(0), 5).shape == (0, 3)
    assert not machine.launched
    assert not machine.compiled


def test_what_the_kernel_cannot_read_is_copied(machine: Machine) -> None:
    grad, history = case(300)
    wide = torch.cat([grad, grad], 1)[:, 3:].requires_grad_()
    laid = history.movedim(0, -1).contiguous().movedim(-1, 0)
    moved = torch.cat([history.new_zeros(1), history.flatten()])[1:].view(history.shape)
    for given, cells in ((wide, history), (grad, laid), (grad, moved)):
        result = cuda.two_loop(given, cells, 5)
        *_, at_grad, at_history, at_result, _ = machine.launched[-1]
        assert (at_grad == given.data_ptr()) == given.is_contiguous()
        assert (at_history == cells.data_ptr()) == (cells is history)
        assert at_history % cuda.ALIGNMENT == 0
        assert at_result == result.data_ptr()
        assert not result.requires_grad
