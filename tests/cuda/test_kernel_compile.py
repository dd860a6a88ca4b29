"""NVRTC compiles the kernels for every architecture, without spills. No GPU is needed."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import NamedTuple

import pytest
import torch

from opt3dgs_optim import cuda

pytestmark = pytest.mark.compiles

ARCHITECTURES = ("75", "80", "86", "89", "90", "100", "120")
MAX_REGISTERS = 96
SIZES = (1, 3, 4, 5)


@pytest.fixture
def core() -> object:
    return pytest.importorskip("cuda.core", reason="cuda.core is not installed (extra 'cuda')")


class Compiled(NamedTuple):
    """What ptxas said, and the PTX."""

    log: str
    ptx: str


def compiled_for(name: str, arch: str, dtype: torch.dtype, size: int) -> Compiled:
    log = io.StringIO()
    options = {"history_size": size, "ptxas_options": ["-v"]}
    cuda.compile_cubin(name, dtype, f"sm_{arch}", logs=log, **options)
    return Compiled(log.getvalue(), nvrtc_ptx(name, arch, dtype, size))


def nvrtc_ptx(name: str, arch: str, dtype: torch.dtype, size: int) -> str:
    """cuda.core asks the driver before it gives PTX; NVRTC itself does not."""
    from cuda.bindings import nvrtc  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

    options = ["-std=c++17", f"-arch=compute_{arch}"]
    options += [f"-D{key}={value}" for key, value in cuda.macros(dtype, size)]
    _, program = nvrtc.nvrtcCreateProgram(cuda.source(name).encode(), b"kernel.cu", 0, [], [])
    (error,) = nvrtc.nvrtcCompileProgram(program, len(options), [o.encode() for o in options])
    assert int(error) == 0
    _, length = nvrtc.nvrtcGetPTXSize(program)
    ptx = b" " * length
    nvrtc.nvrtcGetPTX(program, ptx)
    return ptx.decode()


def vector_bytes(ptx: str) -> int:
    """Bytes read by loads of 16 bytes or more (32 from sm_100 on)."""
    widths = re.findall(r"ld\.global(?:\.nc)?\.v(\d)\.[bfu](\d+)", ptx)
    sizes = [int(count) * int(bits) // 8 for count, bits in widths]
    return sum(size for size in sizes if size >= 16)


def check(compiled: Compiled, dtype: torch.dtype, vector_loads: int) -> None:
    """Of every kernel in the file: no stack, no spills, few registers, wide loads."""
    stack = r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads"
    used = re.findall(stack, compiled.log)
    entries = re.split(r"\.entry", compiled.ptx)[1:]
    assert len(entries) == len(used) >= 1
    assert set(used) == {("0", "0", "0")}
    for entry in entries:
        assert vector_bytes(entry) >= 16 * vector_loads
    assert ".local" not in compiled.ptx
    if dtype == torch.float32:
        registers = list(map(int, re.findall(r"Used (\d+) registers", compiled.log)))
        assert len(registers) == len(entries)
        assert max(registers) <= MAX_REGISTERS
        assert re.search(r"\.f64\b", compiled.ptx) is None


@pytest.mark.parametrize("arch", ARCHITECTURES)
def test_float32_kernels(core: object, arch: str) -> None:
    for size in SIZES:
        for name in ("lqn.cu", "two_loop.cu"):
            check(compiled_for(name, arch, torch.float32, size), torch.float32, 2 * size)


def test_float64_kernels_for_tests(core: object) -> None:
    check(compiled_for("lqn.cu", "80", torch.float64, 5), torch.float64, 20)
    # Of each vector of three coordinates two; the spare lane beside the third is not read.
    check(compiled_for("two_loop.cu", "80", torch.float64, 5), torch.float64, 10)


def test_compiled_kernels_are_cached_on_disk(core: object, tmp_path: Path) -> None:
    from cuda.core.utils import FileStreamProgramCache  # pyright: ignore[reportMissingImports]

    compiled_now = True
    with FileStreamProgramCache(tmp_path / "cache") as cache:
        for _ in range(2):
            log = io.StringIO()
            code = cuda.compile_cubin(
                "lqn.cu",
                torch.float32,
                "sm_90",
                history_size=5,
                cache=cache,
                logs=log,
                ptxas_options=["-v"],
            )
            compiled_now = "registers" in log.getvalue()
            assert len(code.code) > 1000
    assert not compiled_now  # the second time it came from the disk


def test_sources_need_no_include_path() -> None:
    for kernel, name in cuda.KERNELS.items():
        assert "#include" not in cuda.source(name)
        assert f" {kernel}(" in cuda.source(name)
