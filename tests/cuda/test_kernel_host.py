"""The unchanged .cu files, run on the host, against pure torch. No GPU is needed."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from kernel_host import (
    OPTIONS,
    HostKernels,
    Problem,
    There,
    built,
    compare_energies,
    compare_extreme_frames,
    compare_frames,
    compare_runs,
    compiler,
    energies,
    frame_case,
    frames,
    host_kernels,
    relative_difference,
    taken,
    two_loop_case,
)
from torch import Tensor

from opt3dgs_optim import cuda
from opt3dgs_optim.frames import Frames
from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history, two_loop
from opt3dgs_optim.lbfgs.history import laid_out
from opt3dgs_optim.partitions import LIMIT, MEAN_ABS, MEMORY, UNLIMITED, MovingPartitions, Tally

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


def recorded_steps(rows: int, size: int, steps: int = 13) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Position, gradient and the history before it, of each step of a run of pure torch."""
    problem = Problem(rows)
    x = problem.start.clone()
    history = new_history(x, size)
    states = []
    for noise, kind, reset in problem.views(steps):
        history[reset] = 0
        grad = problem.gradient(x, noise, kind)
        states.append((x.clone(), grad, history.clone()))
        direction, _, _ = lqn_direction(x, grad, history, size, **OPTIONS)  # pyright: ignore
        x = x - 0.05 * torch.nan_to_num(direction, nan=0.0, posinf=0.0, neginf=0.0)
    return states


@pytest.mark.parametrize("size", SIZES)
def test_single_steps_in_float32(kernels: dict, size: int) -> None:
    """Each step from the same float32 state; 1e-5 is eps times what the recursion amplifies.

    Pairs of little curvature amplify without bound, in any order of summation: a min_cosine of 0.1
    keeps them out here.
    """
    options = {**OPTIONS, "min_cosine": 0.1}
    for state in recorded_steps(1000, size):
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


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("rows", [0, 1, 7, 255, 256, 257, 1000, 4096])
@pytest.mark.parametrize("min_aspect", [0.0, 0.1, 1.0])
def test_the_own_frame(kernels: dict, rows: int, dtype: torch.dtype, min_aspect: float) -> None:
    """A dozen roundings, of 1e-16 and of 6e-8."""
    limit = 2e-15 if dtype == torch.float64 else 1e-6
    assert compare_frames(kernels[5, dtype], rows, min_aspect) < limit


@pytest.mark.parametrize("function", [cuda.own_frame_gradient, cuda.own_frame_displacement])
@pytest.mark.parametrize("how", ["columns", "buffer", "parameters"])
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_the_own_frame_of_any_layout(
    kernels: dict, dtype: torch.dtype, how: str, function: Callable[..., Tensor]
) -> None:
    def lay(each: Tensor) -> Tensor:
        if how == "columns":
            return each.T.contiguous().T
        if how == "parameters":
            return torch.nn.Parameter(each)
        return torch.cat([each.new_zeros(1), each.flatten()])[1:].view(each.shape)

    case = frame_case(300, dtype)
    laid = [lay(each) for each in case]
    # Begins between two vectors of 16 bytes.
    assert (laid[1].data_ptr() % cuda.ALIGNMENT != 0) == (how == "buffer")
    with kernels[5, dtype].launched():
        found, expected = function(*laid), function(*case)
    assert torch.equal(found, expected)
    assert found.is_contiguous()
    assert not found.requires_grad


@pytest.mark.parametrize("of_vectors", [torch.float16, torch.bfloat16, *DTYPES], ids=str)
@pytest.mark.parametrize("of_frames", [torch.float16, torch.bfloat16, *DTYPES], ids=str)
def test_the_own_frame_of_several_dtypes(
    kernels: dict, of_vectors: torch.dtype, of_frames: torch.dtype
) -> None:
    """The arithmetic is float32, or float64 where one of them is; the result is the vectors'."""
    vectors, quats, scales = frame_case(300)
    given = vectors.to(of_vectors), quats.to(of_frames), scales.to(of_frames)
    wide = torch.float64 if torch.float64 in (of_vectors, of_frames) else torch.float32
    with kernels[5, wide].launched():
        found = cuda.own_frame_gradient(*given)
        v, q, s = (each.to(wide) for each in given)
        expected = cuda.own_frame_gradient(v, q, s)
    assert found.dtype == of_vectors
    assert torch.equal(found, expected.to(of_vectors))


def test_which_gaussians_have_frames_by_a_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    _, quats, _ = frame_case(9, torch.float32)
    assert not cuda.has_own_frames(quats)
    assert cuda.has_own_frames(quats.as_subclass(There)) == (cuda.missing() is None)
    monkeypatch.setattr(cuda, "missing", lambda: None)
    assert cuda.has_own_frames(quats.as_subclass(There))
    assert cuda.has_own_frames(quats.half().as_subclass(There))
    assert not cuda.has_own_frames(quats.long().as_subclass(There))
    assert not cuda.has_own_frames(quats)


@pytest.mark.parametrize("wrong", ["vectors", "quats", "scales"])
def test_shapes_of_the_own_frame_are_checked_first(
    wrong: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernels read by them: one row less would be read beyond its end."""
    monkeypatch.setattr(cuda, "launch", None)
    case: dict[str, Tensor] = dict(zip(("vectors", "quats", "scales"), frame_case(9), strict=True))
    own = case[wrong]
    for bad in (own[:8], own[:, :2], own[0], own[0, 0], own[:, :, None], own.to("meta")):
        for function in (cuda.own_frame_gradient, cuda.own_frame_displacement):
            message = rf"{function.__name__}: \w+ of shape .* on .* is needed"
            v, q, s = {**case, wrong: bad}.values()
            with pytest.raises(ValueError, match=message):
                function(v, q, s)


@pytest.mark.parametrize("dtype", [*DTYPES, torch.float16, torch.bfloat16], ids=str)
def test_what_adam_squares_stays_finite(kernels: dict, dtype: torch.dtype) -> None:
    """Of Gaussians of any size, with gradients of any size, by kernels as by torch."""
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    compare_extreme_frames(kernels[5, wide], dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16], ids=str)
def test_a_part_has_the_same_frames_from_kernels_and_from_torch(
    kernels: dict, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    vectors, quats, scales = (each.to(dtype) for each in frame_case(300))
    plain = Frames(quats, scales, dtype, 0.0)
    monkeypatch.setattr(cuda, "has_own_frames", lambda _: True)
    by_kernel = Frames(quats, scales, dtype, 0.0)
    quats += 1  # as one optimizer of all groups moves them before the step is asked for
    unit = vectors.double().norm(dim=1, keepdim=True) * scales.double().exp().amax(1, keepdim=True)
    wide = torch.float64 if dtype == torch.float64 else torch.float32
    with kernels[5, wide].launched():
        pairs = [
            (by_kernel.gradient(vectors), plain.gradient(vectors)),
            (by_kernel.displacement(vectors.clone()), plain.displacement(vectors.clone())),
        ]
    for found, expected in pairs:
        assert found.dtype == expected.dtype == dtype
        gap = ((found.double() - expected.double()) / unit).abs().max()
        assert float(gap) < 10 * torch.finfo(dtype).eps  # two dozen roundings


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("name", ["falling", "two levels", "spike", "constant", "broken"])
def test_energies(kernels: dict, name: str, dtype: torch.dtype) -> None:
    """Free-running in float64; in float32 each step from the same state.

    1e-5: pure torch's exponents are up to 100 in float32, before softmax takes the largest away.
    """
    exact = dtype == torch.float64
    difference = compare_energies(kernels[5, dtype], energies(name), free=exact)
    assert difference < (1e-10 if exact else 1e-5)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_energy_that_is_not_finite_changes_nothing(
    kernels: dict, value: float, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is said of it: it may be a large one of float64, in float32."""
    state, nu, sums = (torch.full((n,), 0.25, dtype=dtype) for n in (51, 1, 3))
    numbers = (5.0, -1.0, 3.0, 6.0, 0.4, 0.05, 0.8, 1e-6, 1e-30)
    monkeypatch.setattr(cuda, "launch", kernels[5, dtype].launch)
    for before in (0, 1, 500):
        count = torch.tensor(before)
        given = (torch.tensor(value), True, state, nu, count, sums, (0, MEMORY, UNLIMITED))
        cuda.take_energy(*given, *numbers)
        assert int(count) == before
        assert bool((torch.cat([state, nu, sums]) == 0.25).all())


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
        *expected, learnt = expected
        assert relative_difference(result[-len(learnt) :], learnt) < 1e-10
        result = result[: -len(learnt)].reshape(len(expected), rows, 3)
        for part, reference in zip(result, expected, strict=True):
            assert relative_difference(part, reference) < 1e-10


def _quiet() -> dict[str, str]:
    return {**os.environ, "ASAN_OPTIONS": "detect_leaks=1", "UBSAN_OPTIONS": "print_stacktrace=1"}


def _write_input(path: Path, rows: int, size: int) -> list[Tensor]:
    """Steps as the program reads them; what it should write.

    That is directions, as they are fed to Adam and of the recursion alone, and what the histogram
    has learnt.
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
    expected += _add_frames(parts, rows)
    learnt = _add_energies(parts)
    torch.cat([part.flatten() for part in parts]).numpy().tofile(path)
    return [*expected, learnt]


def _add_frames(parts: list[Tensor], rows: int) -> list[Tensor]:
    """Put Gaussians into the program's input; B^T g, and B B^T g."""
    grad, quats, scales = frame_case(rows)
    parts += [quats, scales, grad]
    axes = frames(quats, scales, 0.1)  # as in the program
    turned = torch.einsum("nij,ni->nj", axes, grad)
    return [turned, torch.einsum("nij,nj->ni", axes, turned)]


def _add_energies(parts: list[Tensor], m: int = 24) -> Tensor:
    """Put 100 energies into the program's input; the state and nu after them."""
    law = MovingPartitions(m, 0.75, (-1.0, 3.0))
    law.allocate(torch.device("cpu"))
    tally, values = Tally(7, law.nu), energies("broken", 100)
    numbers = (tally.warmup, MEMORY, UNLIMITED, LIMIT / MEAN_ABS, *law.clamp, *law._constants)
    parts += [torch.tensor([100, m, *numbers], dtype=torch.float64), law._state.clone()]
    for k, (energy, valid) in enumerate(zip(values, taken(values), strict=True)):
        known = 1 + k % 3 % 2 if valid else 0  # 2: a null pointer
        parts.append(torch.tensor([energy, known], dtype=torch.float64))
        law.take_on_device(energy, valid, tally)
    return torch.hstack([law._state, law.nu, tally.sums, tally.count])
