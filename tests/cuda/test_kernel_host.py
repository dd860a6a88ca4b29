"""The unchanged .cu files, run on the host, against pure torch. No GPU is needed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from kernel_host import (
    OPTIONS,
    HostKernels,
    Problem,
    built,
    compare_runs,
    compiler,
    host_kernels,
    relative_difference,
    two_loop_case,
)
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history, two_loop
from opt3dgs_optim.lbfgs.history import laid_out

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="g++ is not installed"),
    pytest.mark.compiles,
]

SIZES = (1, 3, 5)
ROWS = (0, 1, 255, 256, 257, 1000, 4096)
DTYPES = (torch.float64, torch.float32)


@pytest.fixture(scope="session")
def kernels() -> dict[tuple[int, torch.dtype], HostKernels]:
    return {(size, dtype): host_kernels(size, dtype) for size in SIZES for dtype in DTYPES}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("rows", ROWS)
def test_free_running_in_float64(kernels: dict, rows: int, size: int) -> None:
    """13 steps on its own state: rounding is 1e-16, its growth over the steps the rest of 1e-10."""
    assert compare_runs(kernels[size, torch.float64], rows, size) < 1e-10


@pytest.mark.parametrize(
    "changed", [{"graft": False}, {"graft": False, "min_cosine": 0.3}], ids=str
)
@pytest.mark.parametrize("size", SIZES)
def test_free_running_with_every_option(kernels: dict, size: int, changed: dict) -> None:
    assert compare_runs(kernels[size, torch.float64], 257, size, **changed) < 1e-10


def recorded_steps(
    rows: int, size: int, steps: int = 13, min_cosine: float = OPTIONS["min_cosine"]
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Position, gradient and the history before it, of each step of a run of pure torch."""
    problem = Problem(rows)
    x = problem.start.clone()
    history = new_history(x, size)
    states = []
    for noise, kind, reset in problem.views(steps):
        history[reset] = 0
        grad = problem.gradient(x, noise, kind)
        states.append((x.clone(), grad, history.clone()))
        options = {**OPTIONS, "min_cosine": min_cosine}
        direction, _, _ = lqn_direction(x, grad, history, size, **options)  # pyright: ignore
        x = x - 0.05 * torch.nan_to_num(direction, nan=0.0, posinf=0.0, neginf=0.0)
    return states


@pytest.mark.parametrize("size", SIZES)
def test_single_steps_in_float32(kernels: dict, size: int) -> None:
    """Each step from the same float32 state; 1e-5 is eps times what the recursion amplifies.

    Pairs of little curvature amplify without bound, in any order of summation: a min_cosine of 0.1
    keeps them out here.
    """
    options = {**OPTIONS, "min_cosine": 0.1}
    for state in recorded_steps(1000, size, min_cosine=0.1):
        x, grad, before = (t.float() for t in state)
        ours, theirs = before.clone(), before.contiguous()
        expected = lqn_direction(x, grad, ours, size, **options)  # pyright: ignore
        result = kernels[size, torch.float32].lqn(x, grad, theirs, **options)
        agree = (result[1] == expected[1]) & (result[2] == expected[2])
        assert float((~agree).float().mean()) <= 1e-3  # a cosine within rounding of the bound
        for a, b in [(result[0], expected[0]), (theirs, ours)]:
            assert relative_difference(a[agree], b[agree]) < 1e-5


def test_rows_that_are_not_visible_stay_bit_for_bit(kernels: dict) -> None:
    x, grad, history = recorded_steps(256, 5)[-1]
    grad[::3] = 0.0
    grad[1::3, 2] = torch.nan
    before = history.contiguous().clone()
    after = before.clone()
    direction, accepted, candidates = kernels[5, torch.float64].lqn(x, grad, after, **OPTIONS)
    unseen = torch.arange(256) % 3 != 2
    assert torch.equal(after[unseen], before[unseen])
    assert torch.equal(direction[unseen].nan_to_num(9.0), grad[unseen].nan_to_num(9.0))
    assert not bool((accepted | candidates)[unseen].any())


@pytest.mark.parametrize("size", SIZES)
def test_a_point_without_pairs_keeps_its_gradient_bit_for_bit(kernels: dict, size: int) -> None:
    for dtype in DTYPES:
        x, grad = torch.randn(300, 3, dtype=dtype), torch.randn(300, 3, dtype=dtype)
        history = new_history(x, size, contiguous=True)
        direction, _, _ = kernels[size, dtype].lqn(x, grad, history, **OPTIONS)
        assert torch.equal(direction, grad)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("rows", ROWS)
def test_the_recursion_in_float64(kernels: dict, rows: int, size: int) -> None:
    """Rounding is 1e-16; pairs of little curvature amplify it."""
    grad, history = two_loop_case(rows, size)
    before = history.clone()
    found = kernels[size, torch.float64].two_loop(grad, history)
    expected = two_loop(grad, history, size)
    assert relative_difference(found, expected) < 1e-10
    assert torch.equal(history, before)
    assert rows < 255 or bool(expected.isnan().any(1).any())  # not finite, in both


@pytest.mark.parametrize("size", SIZES)
def test_the_recursion_in_float32(kernels: dict, size: int) -> None:
    """1e-5 is eps times what the recursion amplifies: no pairs of little curvature here."""
    generator = torch.Generator().manual_seed(1)
    s = torch.randn(size, 1000, 3, generator=generator)
    y = s * (0.5 + torch.rand(size, 1000, 3, generator=generator))
    grad, history = two_loop_case(1000, size)[0].float(), history_from_pairs(s, y)
    found = kernels[size, torch.float32].two_loop(grad, history)
    assert relative_difference(found, two_loop(grad, history, size)) < 1e-5


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("layout", ["of torch", "of the kernel", "anywhere in a buffer"])
def test_the_recursion_reads_any_layout(kernels: dict, layout: str, dtype: torch.dtype) -> None:
    """A view that begins between two vectors of 16 bytes would be a fault on a GPU."""
    grad, history = (t.to(dtype) for t in two_loop_case(300, 5))
    expected = two_loop(grad, history, 5)
    history = laid_out(history, contiguous=layout != "of torch")
    if layout == "anywhere in a buffer":
        buffer = torch.cat([torch.zeros(1, dtype=dtype), history.flatten()])
        history = buffer[1:].view(history.shape)
        assert history.data_ptr() % cuda.ALIGNMENT != 0
    grad = torch.cat([grad, grad], 1)[:, 3:]  # not contiguous
    found = kernels[5, dtype].two_loop(grad, history)
    assert found.is_contiguous()
    assert relative_difference(found, expected) < (1e-10 if dtype == torch.float64 else 1e-3)


def test_a_step_writes_an_unaligned_history_in_place(kernels: dict) -> None:
    x, grad, history = (t.contiguous() for t in recorded_steps(300, 5)[-1])
    buffer = torch.cat([torch.zeros(1, dtype=history.dtype), history.flatten()])
    twin = buffer[1:].view(history.shape)
    found = kernels[5, torch.float64].lqn(x, grad, twin, **OPTIONS)
    expected = kernels[5, torch.float64].lqn(x, grad, history, **OPTIONS)
    assert torch.equal(twin, history)
    assert all(map(torch.equal, found[1:], expected[1:]))
    assert relative_difference(found[0], expected[0]) == 0.0


def test_a_point_is_told_its_pairs_wherever_two_loop_runs(
    kernels: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The public function and its kernel, from pairs to H g, on a GPU that the host plays."""
    module = sys.modules["opt3dgs_optim.lbfgs.two_loop"]
    monkeypatch.setattr(module, "obstacle", lambda *_: None)
    grad, history = two_loop_case(257, 5)
    with kernels[5, torch.float64].launched():
        found = two_loop(grad, history, 5, backend="cuda")
    assert relative_difference(found, two_loop(grad, history, 5)) < 1e-10
    assert not torch.equal(found.nan_to_num(), two_loop(grad, history, 5).nan_to_num())


# -- the same under the sanitizers -----------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
def test_under_address_and_undefined_sanitizers(tmp_path: Path, size: int) -> None:
    """A program of its own, with buffers of exactly N rows; its output is compared all the same."""
    flags = ("-g", "-fsanitize=address", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    program = built(size, torch.float64, *flags)
    for rows in (0, 1, 255, 257, 1000):
        expected = _write_input(tmp_path / "in", rows, size)
        command = [str(program), str(tmp_path / "in"), str(tmp_path / "out")]
        run = subprocess.run(command, capture_output=True, text=True, check=False, env=_quiet())
        assert run.returncode == 0, run.stderr
        result = torch.from_numpy(np.fromfile(tmp_path / "out", dtype=np.float64))
        result = result.reshape(len(expected), rows, 3)
        for part, reference in zip(result, expected, strict=True):
            assert relative_difference(part, reference) < 1e-10


def _quiet() -> dict[str, str]:
    return {**os.environ, "ASAN_OPTIONS": "detect_leaks=1", "UBSAN_OPTIONS": "print_stacktrace=1"}


def _write_input(path: Path, rows: int, size: int) -> list[Tensor]:
    """Steps as the program reads them; what it should write.

    That is directions, as they are fed to Adam and of the recursion alone.
    """
    states = recorded_steps(rows, size)
    history = new_history(states[0][0], size, contiguous=True)
    parts: list[Tensor] = [torch.tensor([rows, len(states)], dtype=torch.float64)]
    expected = []
    for x, grad, before in states:
        reset = (before.abs().sum(dim=(1, 2)) == 0).double()
        parts += [x, grad, reset]
        history[reset.bool()] = 0
        expected.append(lqn_direction(x, grad, history, size, **OPTIONS)[0])  # pyright: ignore
        expected.append(two_loop(grad, history, size))
    torch.cat([part.flatten() for part in parts]).numpy().tofile(path)
    return expected
