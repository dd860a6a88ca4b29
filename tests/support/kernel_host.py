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

from opt3dgs_optim import cuda
from opt3dgs_optim.cuda import BLOCK, macros
from opt3dgs_optim.lbfgs import history_from_pairs, lqn_direction, new_history

SHIM = Path(__file__).parents[1] / "cuda"  # what makes the kernels a library of the host
SOURCES = Path(cuda.__file__).parent
GUARD_ROWS = 300  # written by nobody: more than one block beyond the last row
GUARD = 77
OPTIONS = {"min_cosine": 1e-6, "graft": True}
BUILDS = Path(tempfile.gettempdir()) / "opt3dgs_optim_host_kernels"

# As it is: tests put a kernel on the host in its place.
LQN_DIRECTION = cuda.lqn_direction


def compiler() -> str | None:
    """g++, or None: then the tests that need it skip with this as the reason."""
    return shutil.which("g++")


def compile_host(
    out: Path, size: int, dtype: torch.dtype, sources: Path = SOURCES, *extra: str
) -> Path:
    """Compile the kernels for one history size: a library, or a program for the sanitizers."""
    defines = [f"-D{name}={value}" for name, value in macros(dtype, size)]
    program = any(flag.startswith("-fsanitize") for flag in extra)
    library = ["-shared", "-fPIC", str(SHIM / "cuda_host_kernels.cpp")]
    what = [str(SHIM / "cuda_host_main.cpp")] if program else library
    flags = ["-std=c++17", "-O1", "-Wall", "-Werror", "-Wno-unknown-pragmas", *extra]
    command = ["g++", *flags, *defines, f"-I{SHIM}", f"-I{sources}", *what, "-o", str(out)]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return out


@cache
def host_kernels(size: int, dtype: torch.dtype) -> HostKernels:
    """The kernels for one history size; see `built`."""
    return HostKernels.load(built(size, dtype), dtype, size)


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
    files = sorted([*SOURCES.glob("*.cu*"), *SHIM.glob("cuda_host_*"), Path(__file__)])
    version = subprocess.run(["g++", "--version"], check=True, capture_output=True).stdout
    contents = b"".join(file.name.encode() + file.read_bytes() for file in files)
    return hashlib.sha256(version + contents).hexdigest()


@dataclass
class HostKernels:
    """The compiled kernels, called as the operators are."""

    library: ctypes.CDLL
    dtype: torch.dtype
    history_size: int

    @classmethod
    def load(cls, path: Path, dtype: torch.dtype, history_size: int) -> HostKernels:
        return cls(ctypes.CDLL(str(path)), dtype, history_size)

    def lqn(
        self, position: Tensor, grad: Tensor, history: Tensor, *, min_cosine: float, graft: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """`cuda.lqn_direction` with the kernel run on the host; changes `history` in place."""
        x, g, cells = (t.to(self.dtype) for t in (position, grad, history))
        size = self.history_size
        with self.launched():
            result = LQN_DIRECTION(x, g, cells, size, min_cosine, graft)
        history.copy_(cells)
        return result

    def two_loop(self, grad: Tensor, history: Tensor) -> Tensor:
        """`cuda.two_loop` with the kernel run on the host."""
        with self.launched():
            return cuda.two_loop(grad.to(self.dtype), history.to(self.dtype), self.history_size)

    def launched(self) -> Any:
        """A context in which `cuda.launch` runs these kernels on the host."""
        return mock.patch.object(cuda, "launch", self.launch)

    def launch(self, kernel: str, like: Tensor, *arguments: Any, history_size: int) -> None:
        """As `cuda.launch`; AssertionError if something beyond a tensor's end was written."""
        assert (like.dtype, history_size) == (self.dtype, self.history_size)
        tensors = [a for a in arguments if isinstance(a, Tensor)]
        assert all(tensor.is_contiguous() for tensor in tensors)
        # The inputs have room behind them, too, for what a missing tail guard would read.
        # Each has its own value there, so that a copy from one into another is noticed.
        buffers = [guarded(t.reshape(-1, *t.shape[1:]), GUARD + i) for i, t in enumerate(tensors)]
        left = iter(buffers)
        values = [
            ctypes.c_void_p(next(left).data_ptr()) if isinstance(a, Tensor) else C_TYPES[type(a)](a)
            for a in arguments
        ]
        getattr(self.library, f"run_{kernel}")(ctypes.c_uint(BLOCK), *values)
        for i, (tensor, buffer) in enumerate(zip(tensors, buffers, strict=True)):
            written, behind = buffer[:-GUARD_ROWS], buffer[-GUARD_ROWS:]
            assert bool((behind == GUARD + i).all()), "rows beyond the last one were written"
            tensor.copy_(written.reshape(tensor.shape))


C_TYPES = {
    np.float32: ctypes.c_float,
    np.float64: ctypes.c_double,
    np.int32: ctypes.c_int,
    int: ctypes.c_longlong,
}


def guarded(tensor: Tensor, guard: float) -> Tensor:
    """A contiguous copy, booleans as bytes, with rows behind it that nobody may write."""
    if tensor.dtype == torch.bool:
        tensor = tensor.view(torch.uint8)
    return torch.cat([tensor, tensor.new_full((GUARD_ROWS, *tensor.shape[1:]), guard)])


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
    history = new_history(x, size)
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


def two_loop_case(rows: int, size: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Gradients [N, 3] and histories of all kinds: full, partly filled, empty; some not finite.

    A tenth of the pairs have little curvature, and a tenth negative curvature, which is left out.
    """
    g = torch.Generator().manual_seed(seed)
    s = torch.randn(size, rows, 3, generator=g, dtype=torch.float64)
    half = torch.randn(rows, 3, 3, generator=g, dtype=torch.float64)
    y = torch.einsum("nij,knj->kni", half @ half.mT + 0.1 * torch.eye(3), s)
    kind = torch.rand(size, rows, generator=g)
    y[kind < 0.1] *= -1
    empty = torch.rand(rows, generator=g) < 0.1
    y[:, empty] = 0.0
    grad = torch.randn(rows, 3, generator=g, dtype=torch.float64)
    grad *= 10.0 ** torch.randint(-30, 31, (rows, 1), generator=g)
    of_row = torch.rand(rows, generator=g)
    grad[of_row < 0.1] = 0.0
    grad[of_row > 0.96, 0] = torch.nan
    grad[of_row > 0.98, 2] = torch.inf
    return grad, history_from_pairs(s, y)


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
