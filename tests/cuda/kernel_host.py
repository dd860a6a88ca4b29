"""The package's .cu files, compiled by g++ and compared with pure torch: what the tests share."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

import opt3dgs_optim
from opt3dgs_optim import cuda, partitions
from opt3dgs_optim.cuda import BLOCK, macros
from opt3dgs_optim.lbfgs import lqn_direction, new_history
from opt3dgs_optim.partitions import UNLIMITED, MovingPartitions

HERE = Path(__file__).parent
SOURCES = Path(opt3dgs_optim.__file__).parent / "cuda"
GUARD_ROWS = 300  # written by nobody: more than one block beyond the last row
GUARD = 12345.0
OPTIONS = {"min_cosine": 1e-6, "graft": True}
BUILDS = Path(tempfile.gettempdir()) / "opt3dgs_optim_host_kernels"


def compiler() -> str | None:
    """g++, or None: then the tests that need it skip with this as the reason."""
    return shutil.which("g++")


def compile_host(
    out: Path, size: int, dtype: torch.dtype, sources: Path = SOURCES, *extra: str
) -> Path:
    """Compile the kernels for one history size: a library, or a program for the sanitizers."""
    defines = [f"-D{name}={value}" for name, value in macros(dtype, size)]
    program = any(flag.startswith("-fsanitize") for flag in extra)
    library = ["-shared", "-fPIC", str(HERE / "cuda_host_kernels.cpp")]
    what = [str(HERE / "cuda_host_main.cpp")] if program else library
    flags = ["-std=c++17", "-O1", "-Wall", "-Werror", "-Wno-unknown-pragmas", *extra]
    command = ["g++", *flags, *defines, f"-I{HERE}", f"-I{sources}", *what, "-o", str(out)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return out


@cache
def host_kernels(size: int, dtype: torch.dtype) -> HostKernels:
    """The kernels for one history size; see `built`."""
    return HostKernels.load(built(size, dtype), dtype)


def built(size: int, dtype: torch.dtype, *extra: str) -> Path:
    """`compile_host` of the package's sources, once for all processes and runs.

    The name says what went in: sources, flags and compiler. Two workers that build the same thing
    at a time each rename a whole file of their own into place.
    """
    digest = hashlib.sha256(repr((_digest(), size, dtype, extra)).encode()).hexdigest()[:24]
    path = BUILDS / f"k{size}_{dtype.itemsize}_{digest}"
    if not path.exists():
        BUILDS.mkdir(parents=True, exist_ok=True)
        own = path.with_suffix(f".{os.getpid()}")
        compile_host(own, size, dtype, SOURCES, *extra)
        own.replace(path)
    return path


@cache
def _digest() -> str:
    """Of all that a build is made of."""
    files = sorted([*SOURCES.glob("*.cu*"), *HERE.glob("cuda_host_*"), Path(__file__)])
    version = subprocess.run(["g++", "--version"], check=True, capture_output=True).stdout
    contents = b"".join(file.name.encode() + file.read_bytes() for file in files)
    return hashlib.sha256(version + contents).hexdigest()


@dataclass
class HostKernels:
    """The compiled kernels, called as the operators are."""

    library: ctypes.CDLL
    dtype: torch.dtype

    @classmethod
    def load(cls, path: Path, dtype: torch.dtype) -> HostKernels:
        return cls(ctypes.CDLL(str(path)), dtype)

    def _call(self, name: str, tensors: list[Tensor], rows: int, *scalars: object) -> None:
        real = ctypes.c_double if self.dtype == torch.float64 else ctypes.c_float
        values = [real(v) if isinstance(v, float) else v for v in scalars]
        pointers = [ctypes.c_void_p(t.data_ptr()) for t in tensors]
        values.insert(0 if name == "run_lqn" else len(values), ctypes.c_longlong(rows))
        getattr(self.library, name)(ctypes.c_uint(BLOCK), *pointers, *values)

    def lqn(
        self,
        position: Tensor,
        grad: Tensor,
        history: Tensor,
        *,
        min_cosine: float,
        graft: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """As `lqn_direction`; raises AssertionError if a row beyond the last one was written."""
        n = grad.shape[0]
        inputs = [t.to(self.dtype).contiguous() for t in (position, grad)]
        cells = guarded(history.to(self.dtype))
        direction = guarded(torch.zeros(n, 3, dtype=self.dtype))
        flags = [guarded(torch.zeros(n, dtype=torch.uint8)) for _ in range(2)]
        # The inputs end with the last row: room for what a missing tail guard reads.
        tensors = [guarded(t) for t in inputs] + [cells, direction, *flags]
        self._call("run_lqn", tensors, n, float(min_cosine), int(graft))
        for tensor in tensors:
            check_guard(tensor, n)
        history.copy_(cells[:n])
        return direction[:n], flags[0][:n].bool(), flags[1][:n].bool()

    def launch(self, kernel: str, like: Tensor, threads: int, *arguments: Any) -> None:
        """As `cuda.launch` of a kernel that takes no rows."""
        assert (like.dtype, threads) == (self.dtype, 1)
        types = {
            np.float32: ctypes.c_float,
            np.float64: ctypes.c_double,
            np.int64: ctypes.c_longlong,
        }
        values = [
            ctypes.c_void_p(a.data_ptr() if isinstance(a, Tensor) else None)
            if isinstance(a, (Tensor, int))
            else types[type(a)](a.item())
            for a in arguments
        ]
        getattr(self.library, f"run_{kernel}")(ctypes.c_uint(BLOCK), *values)


def guarded(tensor: Tensor) -> Tensor:
    """A contiguous copy with rows behind it that nobody may write."""
    value = 77 if tensor.dtype == torch.uint8 else GUARD
    return torch.cat([tensor, tensor.new_full((GUARD_ROWS, *tensor.shape[1:]), value)])


def check_guard(tensor: Tensor, rows: int) -> None:
    value = 77 if tensor.dtype == torch.uint8 else GUARD
    assert bool((tensor[rows:] == value).all()), "rows beyond the last one were written"


# -- what the kernels are run on -------------------------------------------------------------------


class Problem:
    """N quadratics in three dimensions, a fifth of them with a negative eigenvalue."""

    def __init__(self, n: int, seed: int = 0) -> None:
        g = self.generator = torch.Generator().manual_seed(seed)
        basis = torch.linalg.qr(torch.randn(n, 3, 3, generator=g, dtype=torch.float64)).Q
        eigenvalues = 10 ** (2 * torch.rand(n, 3, generator=g, dtype=torch.float64) - 1)
        eigenvalues[: n // 5, 0] *= -1
        self.hessian = basis @ torch.diag_embed(eigenvalues) @ basis.mT
        self.start = torch.randn(n, 3, generator=g, dtype=torch.float64)
        self.n = n

    def views(self, steps: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Per step: gradient noise [N, 3], what each row is (visible, unseen, NaN, inf), resets."""
        g, n = self.generator, self.n
        for step in range(steps):
            noise = 0.01 * torch.randn(n, 3, generator=g, dtype=torch.float64)
            kind = torch.rand(n, generator=g)
            reset = torch.rand(n, generator=g) < (0.1 if step in (5, 9) else 0.0)
            yield noise, kind, reset

    def gradient(self, x: Tensor, noise: Tensor, kind: Tensor) -> Tensor:
        grad = (self.hessian @ x.unsqueeze(2)).squeeze(2) + noise
        grad[kind < 0.15] = 0.0
        grad[(kind > 0.96)] = torch.nan
        grad[kind > 0.98, 1] = torch.inf
        return grad


def free_run(
    step: Callable[..., tuple[Tensor, Tensor, Tensor]], problem: Problem, size: int, steps: int = 13
) -> list[Tensor]:
    """Positions, directions, flags and history of a run on its own state."""
    x = problem.start.clone()
    history = new_history(x, size, contiguous=True)
    problem.generator.manual_seed(1)
    seen = []
    for noise, kind, reset in problem.views(steps):
        history[reset] = 0
        grad = problem.gradient(x, noise, kind)
        direction, accepted, candidates = step(x, grad, history)
        x = x - 0.05 * torch.nan_to_num(direction, nan=0.0, posinf=0.0, neginf=0.0)
        seen += [x, direction, accepted.double(), candidates.double()]
    return [*seen, history]


def compare_runs(kernels: HostKernels, n: int, size: int, **changed: object) -> float:
    """The largest relative difference from pure torch over 13 free-running steps, in float64."""
    options = {**OPTIONS, **changed}
    problem = Problem(n)
    reference = free_run(lambda x, g, h: lqn_direction(x, g, h, size, **options), problem, size)  # pyright: ignore
    result = free_run(lambda x, g, h: kernels.lqn(x, g, h, **options), problem, size)  # pyright: ignore
    return max(map(relative_difference, result, reference), default=0.0)


def relative_difference(result: Tensor, reference: Tensor) -> float:
    """Largest difference over the reference's row size; infinite where only one is NaN."""
    if reference.numel() == 0:
        return 0.0
    result, reference = result.double().flatten(1 if result.dim() > 1 else 0), reference.double()
    reference = reference.reshape(result.shape)
    same = (result == reference) | (result.isnan() & reference.isnan())
    # Values of one row belong together: rounding is relative to the largest of them.
    size = reference.abs().nan_to_num(posinf=0.0)
    size = size.amax(dim=-1, keepdim=True).clamp(min=1e-300) if size.dim() > 1 else size + 1e-300
    gap = torch.where(same, 0.0, (result - reference).abs() / size)
    return float(gap.nan_to_num(nan=torch.inf).max())


# -- the histogram ---------------------------------------------------------------------------------


def energies(name: str, count: int = 3_000) -> Tensor:
    """A script of energies, [count] in float64."""
    g = torch.Generator().manual_seed(3)
    z, k = torch.randn(count, generator=g, dtype=torch.float64), torch.arange(count)
    result = {
        "falling": 10 ** (-4 * k / count) * (0.2 * z).exp(),
        "two levels": 5 + (z > 0) + 0.02 * z,
        "spike": 5 + 0.3 * z + 300 * (k == count // 2),
        "constant": torch.full_like(z, 0.25),
        "broken": 5 + 0.3 * z,
    }[name]
    if name == "broken":
        for start, value in enumerate((torch.nan, torch.inf, -torch.inf)):
            result[7 + 5 * start :: 31] = value
    return result


def taken(values: Tensor) -> Tensor:
    """Which energies change anything: most of those that are finite."""
    return torch.isfinite(values) & (torch.arange(len(values)) % 40 != 9)


def take_all(values: Tensor, dtype: torch.dtype, before: Tensor | None = None) -> Tensor:
    """Nu and the state after each energy, [T, 1 + 3 + m], of a new law.

    Args:
        values: [T] energies; those of `taken` False are said not to be finite.
        dtype: of the law; a CPU's is float64 otherwise.
        before: the same of another run: every step is one from there.
    """
    law = MovingPartitions(48, 0.75, (-1.0, 3.0))
    with mock.patch.object(torch, "float64", dtype):
        law.allocate(torch.device("cpu"))
    found = []
    for count, (energy, valid) in enumerate(zip(values.to(dtype), taken(values), strict=True), 1):
        if before is not None and count > 1:
            row = before[count - 2]
            law.nu.copy_(row[0])
            law._state.copy_(row[1:])
        law.take(energy, True if valid else valid, count)
        found.append(torch.cat([law.nu.reshape(1), law._state]))
    return torch.stack(found)


def take_all_on_host(kernels: HostKernels, values: Tensor, before: Tensor | None = None) -> Tensor:
    """`take_all` with the kernel in the place of the torch operators."""
    with (
        mock.patch.object(cuda, "launch", kernels.launch),
        mock.patch.object(partitions, "obstacle", return_value=None),
    ):
        return take_all(values, kernels.dtype, before)


def compare_energies(kernels: HostKernels, values: Tensor, *, free: bool = True) -> float:
    """The largest difference from pure torch, free-running or of each single step.

    Relative in what has a unit (mean, deviation). The first four energies are left out: up to 1e6
    deviations from the mean, pure torch's sums cancel there.
    """
    reference = take_all(values, kernels.dtype)
    result = take_all_on_host(kernels, values, None if free else reference)
    counts, before = taken(values), result if free else reference
    assert torch.equal(result[1:][~counts[1:]], before[:-1][~counts[1:]]), "one more was taken"
    assert torch.equal(reference[1:][~counts[1:]], reference[:-1][~counts[1:]]), "and by torch"
    size = torch.ones_like(reference)
    size[:, 1:3] = reference[:, 1:3].abs()
    gap = torch.where(result == reference, 0.0, (result - reference).abs() / size)
    return float(gap[UNLIMITED:][counts[UNLIMITED:]].nan_to_num(nan=torch.inf).max())
