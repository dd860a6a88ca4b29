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

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="g++ is not installed"),
    pytest.mark.compiles,
]

SIZES = pytest.mark.parametrize("size", [1, 3, 5])
ROWS = (0, 1, 255, 256, 257, 1000, 4096)
F64 = torch.float64


@SIZES
@pytest.mark.parametrize(
    ("rows", "changed"),
    [
        *((rows, {}) for rows in ROWS),
        (257, {"graft": False}),
        (257, {"graft": False, "min_cosine": 0.3}),
    ],
    ids=str,
)
def test_free_running_in_float64(rows: int, size: int, changed: dict) -> None:
    """13 steps on its own state: rounding is 1e-16, its growth over the steps the rest of 1e-10."""
    assert compare_runs(host_kernels(size, F64), rows, size, **changed) < 1e-10


def recorded_steps(
    rows: int, size: int, min_cosine: float = OPTIONS["min_cosine"]
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Position, gradient and the history before it, of each step of a run of pure torch."""
    problem, options = Problem(rows), {**OPTIONS, "min_cosine": min_cosine}
    x = problem.start.clone()
    history = new_history(x, size)
    states = []
    for noise, kind, reset in problem.views(13):
        history[reset] = 0
        grad = problem.gradient(x, noise, kind)
        states.append((x.clone(), grad, history.clone()))
        direction, _, _ = lqn_direction(x, grad, history, size, **options)  # pyright: ignore
        x = x - 0.05 * torch.nan_to_num(direction, nan=0.0, posinf=0.0, neginf=0.0)
    return states


@SIZES
def test_single_steps_in_float32(size: int) -> None:
    """Each step from the same float32 state; 1e-5 is eps times what the recursion amplifies.

    Pairs of little curvature amplify without bound, in any order of summation: a min_cosine of 0.1
    keeps them out here.
    """
    options = {**OPTIONS, "min_cosine": 0.1}
    for state in recorded_steps(1000, size, min_cosine=0.1):
        x, grad, before = (t.float() for t in state)
        ours, theirs = before.clone(), before.contiguous()
        expected = lqn_direction(x, grad, ours, size, **options)  # pyright: ignore
        result = host_kernels(size, torch.float32).lqn(x, grad, theirs, **options)
        agree = (result[1] == expected[1]) & (result[2] == expected[2])
        assert float((~agree).float().mean()) <= 1e-3  # a cosine within rounding of the bound
        for a, b in [(result[0], expected[0]), (theirs, ours)]:
            assert relative_difference(a[agree], b[agree]) < 1e-5


def test_rows_that_are_not_visible_stay_bit_for_bit() -> None:
    """And a point without pairs keeps every bit of its gradient."""
    x, grad, history = recorded_steps(256, 5)[-1]
    grad[::3], grad[1::3, 2] = 0.0, torch.nan
    before = history.contiguous().clone()
    after = before.clone()
    direction, accepted, candidates = host_kernels(5, F64).lqn(x, grad, after, **OPTIONS)
    unseen = torch.arange(256) % 3 != 2
    assert torch.equal(after[unseen], before[unseen])
    assert torch.equal(direction[unseen].nan_to_num(9.0), grad[unseen].nan_to_num(9.0))
    assert not bool((accepted | candidates)[unseen].any())
    fresh = new_history(x, 5)
    assert torch.equal(host_kernels(5, F64).lqn(x, x / 3, fresh, **OPTIONS)[0], x / 3)


@SIZES
@pytest.mark.parametrize("rows", ROWS)
def test_the_recursion_in_float64(rows: int, size: int) -> None:
    """Rounding is 1e-16; pairs of little curvature amplify it."""
    grad, history = two_loop_case(rows, size)
    before = history.clone()
    found = host_kernels(size, F64).two_loop(grad, history)
    expected = two_loop(grad, history, size)
    assert relative_difference(found, expected) < 1e-10
    assert torch.equal(history, before)
    assert rows < 255 or bool(expected.isnan().any(1).any())  # not finite, in both


@SIZES
def test_the_recursion_in_float32(size: int) -> None:
    """1e-5 is eps times what the recursion amplifies: no pairs of little curvature here."""
    generator = torch.Generator().manual_seed(1)
    s = torch.randn(size, 1000, 3, generator=generator)
    y = s * (0.5 + torch.rand(size, 1000, 3, generator=generator))
    grad, history = two_loop_case(1000, size)[0].float(), history_from_pairs(s, y)
    found = host_kernels(size, torch.float32).two_loop(grad, history)
    assert relative_difference(found, two_loop(grad, history, size)) < 1e-5


@pytest.mark.parametrize("aligned", [True, False])
def test_any_place_is_read_and_written(aligned: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A view that begins between two vectors of 16 bytes would be a fault on a GPU."""
    grad, history = two_loop_case(300, 5)
    expected, given = two_loop(grad, history, 5), history.clone()
    if not aligned:
        history = torch.cat([torch.zeros(1, dtype=F64), given.flatten()])[1:].view(given.shape)
        assert history.data_ptr() % cuda.ALIGNMENT != 0
    kernels, wide = host_kernels(5, F64), torch.cat([grad, grad], 1)[:, 3:]  # not contiguous
    assert relative_difference(kernels.two_loop(wide, history), expected) < 1e-10
    # The public function, on a GPU that the host plays.
    monkeypatch.setattr(sys.modules["opt3dgs_optim.lbfgs.two_loop"], "obstacle", lambda *_: None)
    with kernels.launched():
        found = two_loop(wide, history, 5, backend="cuda")
    assert relative_difference(found, expected) < 1e-10
    x = torch.ones(300, 3, dtype=F64)
    steps = [kernels.lqn(x, grad, each, **OPTIONS) for each in (history, given)]
    assert torch.equal(history, given)
    assert torch.equal(torch.stack(steps[0][1:]), torch.stack(steps[1][1:]))
    assert relative_difference(steps[0][0], steps[1][0]) == 0.0


# -- the same under the sanitizers -----------------------------------------------------------------


@SIZES
def test_under_address_and_undefined_sanitizers(tmp_path: Path, size: int) -> None:
    """A program of its own, with buffers of exactly N rows; its output is compared all the same."""
    flags = ("-g", "-fsanitize=address", "-fsanitize=undefined", "-fno-sanitize-recover=all")
    program = built(size, F64, *flags)
    quiet = {"ASAN_OPTIONS": "detect_leaks=1", "UBSAN_OPTIONS": "print_stacktrace=1"}
    for rows in (0, 1, 255, 257, 1000):
        expected = _write_input(tmp_path / "in", rows, size)
        command = [str(program), str(tmp_path / "in"), str(tmp_path / "out")]
        run = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, **quiet}
        )
        assert run.returncode == 0, run.stderr
        result = torch.from_numpy(np.fromfile(tmp_path / "out", dtype=np.float64))
        result = result.reshape(len(expected), rows, 3)
        for part, reference in zip(result, expected, strict=True):
            assert relative_difference(part, reference) < 1e-10


def _write_input(path: Path, rows: int, size: int) -> list[Tensor]:
    """Steps as the program reads them; what it should write.

    That is directions, as they are fed to Adam and of the recursion alone.
    """
    states = recorded_steps(rows, size)
    history = new_history(states[0][0], size)
    parts: list[Tensor] = [torch.tensor([rows, len(states)], dtype=F64)]
    expected = []
    for x, grad, before in states:
        reset = (before.abs().sum(dim=(1, 2)) == 0).double()
        parts += [x, grad, reset]
        history[reset.bool()] = 0
        expected.append(lqn_direction(x, grad, history, size, **OPTIONS)[0])  # pyright: ignore
        expected.append(two_loop(grad, history, size))
    torch.cat([part.flatten() for part in parts]).numpy().tofile(path)
    return expected
