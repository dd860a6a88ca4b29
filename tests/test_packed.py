"""Half-size pairs: what bfloat16 costs, what a trainer may do to the rows, and the kernel."""

from __future__ import annotations

import io
import subprocess
from pathlib import Path

import pytest
import torch
from kernel_host import (
    OPTIONS,
    SOURCES,
    HostKernels,
    Problem,
    compile_all,
    compile_host,
    compiler,
    relative_difference,
)
from torch import Tensor
from torch.nn import Parameter

from opt3dgs_optim import LQNAdam, curvature
from opt3dgs_optim._history import stored_pairs
from opt3dgs_optim.lqnadam import CurvatureOptions

SIZES = (1, 3, 5, 8, 9, 16)
ROWS = (0, 1, 255, 257, 1000)
PACKED: dict = {"pair_dtype": "bfloat16"}


def bits(history: Tensor) -> Tensor:
    """NaN-proof, and tells -0 from 0."""
    return history.contiguous().view(torch.int32)


def convex_pairs(n: int, size: int = 5) -> tuple[Tensor, Tensor]:
    """Pairs of N quadratics with eigenvalues 0.1 .. 10, [K, N, D] each."""
    problem = Problem(n)
    hessian = problem.hessian @ problem.hessian.mT  # eigenvalues 0.01 .. 100, all positive
    hessian = hessian / torch.linalg.matrix_norm(hessian)[:, None, None]
    hessian = hessian + 0.1 * torch.eye(3, dtype=hessian.dtype)
    s = torch.randn(size, n, 3, generator=problem.generator, dtype=torch.float64)
    return s.float(), (hessian @ s.unsqueeze(3)).squeeze(3).float()


# -- what is stored --------------------------------------------------------------------------------


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dim", [1, 2, 3, 4, 7])
def test_stored_pairs_are_the_rounded_ones(size: int, dim: int) -> None:
    g = torch.Generator().manual_seed(0)
    s = torch.randn(size, 50, dim, generator=g) * 1e6
    y = s * 10 ** (6 * torch.rand(size, 50, dim, generator=g) - 3)
    full = stored_pairs(curvature.history_from_pairs(s, y), size)
    half = curvature.history_from_pairs(s, y, **PACKED)
    for wide, narrow in zip(full, stored_pairs(half, size), strict=True):
        assert torch.equal(narrow, wide.bfloat16().float())
        # Eight significant bits: half a unit in the last place is 2^-8 of the smallest.
        assert bool(((narrow - wide).abs() <= 2**-8 * wide.abs()).all())
    newest_s, newest_y = (pairs[0] for pairs in stored_pairs(half, size))
    gamma = curvature.newest_gamma(half, size)
    torch.testing.assert_close(gamma, (newest_s * newest_y).sum(0))


def test_directions_are_close_to_those_of_float32() -> None:
    s, y = convex_pairs(2000)
    grad = torch.randn(2000, 3, generator=torch.Generator().manual_seed(3))
    full, half = (
        curvature.direction(grad, curvature.history_from_pairs(s, y, **dtype), 5, graft=True)
        for dtype in ({}, PACKED)
    )
    assert not torch.equal(half, full)
    assert float(torch.cosine_similarity(half, full).min()) > 0.99


def test_the_header_is_not_rounded_and_the_lanes_are_finite() -> None:
    x = torch.randn(64, 3, generator=torch.Generator().manual_seed(0))
    history = curvature.new_history(x, 5, **PACKED)
    position = grad = x
    for k in range(8):  # of a diagonal that leaves y only one coordinate: lanes like denormals
        position = 1.1**k * x + k
        grad = position * torch.tensor([0.0, 1e-3, 3.0])
        curvature.step(position, grad, history, 5, **OPTIONS)  # pyright: ignore
    head = curvature.header(history, 5)
    assert torch.equal(head.position, position)
    assert torch.equal(head.gradient, grad)
    assert head.counter.tolist() == [6.0] * 64
    assert bool(torch.isfinite(history).all())


def test_a_pair_whose_curvature_is_lost_in_rounding_is_rejected() -> None:
    x = torch.tensor([[1.0, 1.0, 0.0], [1.0, -0.999, 0.0]])  # the second: s.y is 1e-3 of |s| |y|
    step = torch.tensor([1.0, 1.0, 0.0]).expand(2, 3)
    for dtype, accepts in (({}, [True, True]), (PACKED, [True, False])):
        history = curvature.new_history(x, 5, **dtype)
        visible = torch.ones(2, dtype=torch.bool)
        curvature.record(history, 5, 0 * x, 0 * x, visible, min_cosine=1e-6)
        accepted, _ = curvature.record(history, 5, step, x, visible, min_cosine=1e-6)
        assert accepted.tolist() == accepts


def test_bytes_per_point() -> None:
    points = torch.zeros(10, 3)
    for size in range(1, 17):
        half, full = (curvature.new_history(points, size, **d) for d in (PACKED, {}))
        assert half.nbytes <= 10 * (12 * size + 44)
        assert half.nbytes < full.nbytes
        assert half.dtype == torch.float32
        assert half.shape[1] % 4 == 0
    assert curvature.new_history(points, 5, **PACKED).nbytes == 10 * 96


# -- the optimizer ---------------------------------------------------------------------------------


def gradient(x: Tensor) -> Tensor:
    return x * torch.tensor([1.0, 7.0, 30.0]) + 0.1


def trained(n: int, steps: int = 9, **options: object) -> tuple[Parameter, LQNAdam]:
    x = Parameter(torch.randn(n, 3, generator=torch.Generator().manual_seed(n)))
    optimizer = LQNAdam([x], lr=0.01, **{**PACKED, **options})  # pyright: ignore
    train(x, optimizer, steps)
    return x, optimizer


def train(x: Parameter, optimizer: LQNAdam, steps: int) -> None:
    for _ in range(steps):
        x.grad = gradient(x.detach())
        optimizer.step()


@pytest.mark.parametrize("dtype", ["float16", None, torch.bfloat16], ids=str)
def test_other_types_are_refused(dtype: object) -> None:
    for make in (lambda **o: LQNAdam([Parameter(torch.ones(2, 3))], **o), CurvatureOptions):
        with pytest.raises(ValueError, match=r"LQNAdam: pair_dtype=.*'float32', 'bfloat16'"):
            make(pair_dtype=dtype)  # pyright: ignore


def test_float64_parameters_are_refused() -> None:
    x = Parameter(torch.ones(2, 3, dtype=torch.float64))
    x.grad = torch.ones_like(x)
    with pytest.raises(
        ValueError, match=r"pair_dtype='bfloat16' for a parameter of torch\.float64"
    ):
        LQNAdam([x], **PACKED).step()


@pytest.mark.parametrize("backend", ["auto", "torch"])
@pytest.mark.parametrize("shape", [(6, 3), (6, 2, 2), (6,)], ids=str)
def test_it_minimises(shape: tuple[int, ...], backend: str) -> None:
    x = Parameter(torch.ones(shape))
    optimizer = LQNAdam([x], lr=0.05, backend=backend, **PACKED)  # pyright: ignore
    for _ in range(100):
        x.grad = 10 * x.detach()
        optimizer.step()
    assert float(x.detach().abs().max()) < 0.2
    assert optimizer.state[x]["history"].dim() == 2


def test_epoch_pairs() -> None:
    x, optimizer = trained(20, 12, pairs="epoch", epoch_steps=3)
    assert curvature.header(optimizer.state[x]["history"], 5).counter.tolist() == [4.0] * 20


def test_row_edits_keep_the_bits_of_other_rows() -> None:
    x, optimizer = trained(12)
    state, before = optimizer.state[x], bits(optimizer.state[x]["history"])
    keep = torch.tensor([11, 3, 3, 0, 7])
    new = Parameter(torch.cat([x.detach()[keep], torch.ones(2, 3)]))
    rows = {  # as gsplat: gather, cat with zeros, then set one to zero
        key: torch.cat([v[keep], torch.zeros(2, *v.shape[1:])])
        for key, v in state.items()
        if key != "step"
    }
    rows["history"][3] = 0
    after = bits(rows["history"])
    assert torch.equal(after[[0, 1, 2, 4]], before[keep][[0, 1, 2, 4]])
    assert not bool(after[[3, 5, 6]].any())
    optimizer.state[new] = {"step": optimizer.state.pop(x)["step"], **rows}
    optimizer.param_groups[0]["params"] = [new]
    optimizer.reset_points(torch.tensor([3, 5, 6]))
    train(new, optimizer, 1)
    counter = curvature.header(optimizer.state[new]["history"], 5).counter
    assert counter.tolist() == [6.0, 6.0, 6.0, 1.0, 6.0, 1.0, 1.0]


def test_rows_with_a_non_finite_or_no_gradient_keep_their_bits() -> None:
    x, optimizer = trained(6)
    before = bits(optimizer.state[x]["history"]).clone()
    x.grad = gradient(x.detach())
    x.grad[1], x.grad[2, 0] = 0.0, torch.nan
    optimizer.step()
    after = bits(optimizer.state[x]["history"])
    assert (after == before).all(1).tolist() == [False, True, True, False, False, False]


def test_checkpoint_is_bit_exact() -> None:
    x, optimizer = trained(12)
    file = io.BytesIO()
    torch.save(optimizer.state_dict(), file)
    file.seek(0)
    twin = Parameter(x.detach().clone())
    loaded = LQNAdam([twin], lr=0.01, **PACKED)
    loaded.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(bits(loaded.state[twin]["history"]), bits(optimizer.state[x]["history"]))
    train(x, optimizer, 3)
    train(twin, loaded, 3)
    assert torch.equal(twin, x)


@pytest.mark.parametrize(("before", "after"), [("float32", "bfloat16"), ("bfloat16", "float32")])
def test_pairs_of_the_other_size_are_dropped(before: str, after: str) -> None:
    x, optimizer = trained(4, pair_dtype=before)
    loaded = LQNAdam([x], lr=0.01, pair_dtype=after)  # pyright: ignore
    loaded.load_state_dict(optimizer.state_dict())
    train(x, loaded, 1)
    assert curvature.header(loaded.state[x]["history"], 5).counter.tolist() == [1.0] * 4


def test_half_precision_parameters_collect_their_pairs_anew_after_loading() -> None:
    """torch casts a loaded state to the parameter's dtype, which lanes do not survive."""
    x = Parameter(torch.ones(4, 3, dtype=torch.bfloat16))
    make = [LQNAdam([x], lr=0.01, **PACKED) for _ in "ab"]
    for optimizer in make:
        if optimizer is make[1]:
            optimizer.load_state_dict(make[0].state_dict())
        x.grad = torch.ones_like(x)
        optimizer.step()
        assert curvature.header(optimizer.state[x]["history"], 5).counter.tolist() == [1.0] * 4
        assert optimizer.state[x]["history"].dtype == torch.float32


# -- the kernel ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kernels(tmp_path_factory: pytest.TempPathFactory) -> dict[int, HostKernels]:
    if compiler() is None:
        pytest.skip("g++ is not installed")
    folder = tmp_path_factory.mktemp("packed")
    paths = compile_all([lambda k=k: compiled(folder / f"k{k}.so", k) for k in SIZES])
    return {k: HostKernels.load(p, torch.float32) for k, p in zip(SIZES, paths, strict=True)}


def compiled(out: Path, size: int, sources: Path = SOURCES) -> Path:
    return compile_host(out, size, torch.float32, sources, "-DPACKED_PAIRS=1")


def run(step, n: int, size: int, steps: int = 13) -> list[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Position, gradient, history before and after of each step of a run on its own state."""
    problem = Problem(n)
    x = problem.start.float()
    history = curvature.new_history(x, size, contiguous=True, **PACKED)
    problem.generator.manual_seed(1)
    seen = []
    for noise, kind, reset in problem.views(steps):
        history[reset] = 0
        before, grad = history.clone(), problem.gradient(x.double(), noise, kind).float()
        direction, _, _ = step(x, grad, history)
        seen.append((x, grad, before, history.clone()))
        x = x - 0.05 * torch.nan_to_num(direction, nan=0.0, posinf=0.0, neginf=0.0)
    return seen


@pytest.mark.parametrize("powell", [False, True])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("rows", ROWS)
def test_kernel_single_steps(kernels: dict, rows: int, size: int, powell: bool) -> None:
    """1e-5 as in test_kernel_host.py; storage differs at most where rounding is at a tie."""
    options = {**OPTIONS, "min_cosine": 0.1, "powell": powell}
    differing = 0
    for x, grad, before, _ in run(
        lambda x, g, h: curvature.step(x, g, h, size, **options),  # pyright: ignore
        rows,
        size,
    ):
        ours, theirs = before.clone(), before.clone()
        expected = curvature.step(x, grad, ours, size, **options)  # pyright: ignore
        result = kernels[size].lqn(x, grad, theirs, **options)
        same = (bits(ours) == bits(theirs)).all(1)
        differing += int((~same).sum())
        assert torch.equal(result[1][same], expected[1][same])
        assert torch.equal(result[2], expected[2])
        assert relative_difference(result[0][same], expected[0][same]) < 1e-5
    assert differing <= 13 * rows * 1e-3


@pytest.mark.parametrize("size", SIZES)
def test_kernel_free_running(kernels: dict, size: int) -> None:
    """A rounding at a tie moves a pair by 2^-8: not so in practically every row of 13 steps."""
    options = {**OPTIONS, "min_cosine": 0.1}
    a = run(lambda x, g, h: curvature.step(x, g, h, size, **options), 1000, size)[-1]  # pyright: ignore
    b = run(lambda x, g, h: kernels[size].lqn(x, g, h, **options), 1000, size)[-1]
    lanes = (bits(a[3])[:, 8:] == bits(b[3])[:, 8:]).all(1)
    assert float(lanes.float().mean()) >= 0.99
    gap = (a[0] - b[0]).abs().amax(1) / a[0].abs().amax(1)
    assert float((gap < 1e-4).float().mean()) >= 0.99


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("bits_of(s) >> 16 |", "bits_of(s) >> 16 |"),  # unchanged
        ("lane(to < 3 ? 0 : to - 3)", "lane(to < 2 ? 0 : to - 2)"),
        ("bits_of(s) >> 16 |", "bits_of(s) >> 17 |"),
        ("(bits >> 16 & 1u)", "0u"),
        ("store(row + 4, Lanes<float>{gradient, 0.0f});", ""),
    ],
)
def test_mutants_of_the_packing_are_caught(tmp_path: Path, old: str, new: str) -> None:
    if compiler() is None:
        pytest.skip("g++ is not installed")
    for file in SOURCES.glob("*.cu*"):
        text = file.read_text()
        assert text.count(old) == (file.name == "packed.cuh")
        (tmp_path / file.name).write_text(text.replace(old, new))
    mutant = HostKernels.load(compiled(tmp_path / "mutant.so", 5, tmp_path), torch.float32)
    # |y| = 1 exactly and s of nine bits: half of the odd ones are ties.
    g = torch.Generator().manual_seed(0)
    x = (2 * torch.randint(-256, 256, (4096, 3), generator=g) + 1) / 512
    grad = x.sign() * torch.tensor([1.0, 0.0, 0.0])
    ours = curvature.new_history(x, 5, contiguous=True, **PACKED)
    theirs = ours.clone()
    for k in range(1, 5):
        curvature.step(k * x, k * grad, ours, 5, **OPTIONS)  # pyright: ignore
        mutant.lqn(k * x, k * grad, theirs, **OPTIONS)  # pyright: ignore
    assert torch.equal(bits(ours), bits(theirs)) == (old == new)


@pytest.mark.parametrize("size", [5, 16])
def test_kernel_under_sanitizers(tmp_path: Path, size: int) -> None:
    """Buffers of exactly as many rows; compiled without the program that reads float64 files."""
    if compiler() is None:
        pytest.skip("g++ is not installed")
    main = tmp_path / "main.cpp"
    main.write_text(SANITIZED)
    folders = [f"-I{Path(__file__).parent}", f"-I{SOURCES}"]
    defines = [f"-DHISTORY_SIZE={size}", "-DPACKED_PAIRS=1"]
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1"]
    program = str(tmp_path / "program")
    command = ["g++", "-std=c++17", *checks, *folders, *defines, str(main), "-o", program]
    subprocess.run(command, check=True, capture_output=True, text=True)
    outcome = subprocess.run([program], capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stderr


SANITIZED = """
#include <vector>
#include "cuda_host_kernels.cpp"
int main() {
  for (long long rows : {0, 1, 257}) {
    std::vector<float> x(3 * rows), g(3 * rows), d(3 * rows);
    std::vector<float> history(PackedHistory<HISTORY_SIZE>::lanes * rows);
    std::vector<unsigned char> accepted(rows), candidates(rows);
    for (int step = 0; step < 20; ++step) {
      for (long long i = 0; i < 3 * rows; ++i) {
        x[i] += 0.01f * (i % 11) - d[i];
        g[i] = (1 + i % 7) * x[i];
      }
      run_lqn(128, x.data(), g.data(), history.data(), d.data(), accepted.data(),
              candidates.data(), rows, 1e-6f, 0, 0, step % 2, 1, 0);
    }
    if (rows && history[3] != HISTORY_SIZE + 1) return 2;
  }
}
"""
