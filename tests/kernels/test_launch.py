"""How the kernels are compiled and launched, for a GPU that is not there."""

from __future__ import annotations

import importlib.util
import inspect
import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_driver import FakeDriver, fake_driver
from interpreted import fresh_kernels
from step_cases import case

from opt3dgs_optim import triton
from opt3dgs_optim.mean import Mean
from opt3dgs_optim.step import Step
from opt3dgs_optim.triton import FRAME_BLOCK, ROWS_BLOCK

pytest.importorskip("triton.language", reason="Triton is not installed")
pytestmark = pytest.mark.compiles


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> FakeDriver:
    kernels = fresh_kernels({})
    monkeypatch.setattr(triton, "_kernels", lambda: kernels)
    monkeypatch.setattr(torch._C, "_cuda_getCurrentRawStream", lambda _: 0, raising=False)
    monkeypatch.setattr(triton, "_COMPILED", {})
    made = fake_driver()
    made.launched, made.loaded = [], []
    return made


def launched(driver: FakeDriver, shape: tuple[int, ...], **options: Any) -> list[Any]:
    """The grid and the arguments of a step's launch, tensors as their addresses."""
    step = case(shape, torch.Generator().manual_seed(0), **options)
    before = len(driver.launched)
    triton.launch(step)
    assert len(driver.launched) == before + 1
    return [x.data_ptr() if isinstance(x, torch.Tensor) else x for x in driver.launched[-1]]


@pytest.mark.parametrize(
    ("shape", "options"),
    [
        ((500, 3), {"frame": True, "mean": True}),
        ((500, 15, 3), {"fade": True}),
        ((500, 3), {"hold": True, "mean": True, "put": True}),
        ((500,), {"factor": torch.ones(1)}),
    ],
)
def test_a_compiled_kernel_is_launched_as_tritons_launcher_does(
    driver: FakeDriver, shape: tuple[int, ...], options: Any
) -> None:
    """The same arguments in the same places, with addresses for tensors; by this Triton."""
    first, again = (launched(driver, shape, **options) for _ in range(2))
    assert len(driver.loaded) == 1
    assert len(first) == len(again)
    addresses = 0
    for one, other in zip(first, again, strict=True):
        # Not above 2**32: where Python lies at a fixed place, its heap begins low.
        if isinstance(one, int) and one > 2**20 and one % 16 == 0:
            addresses += 1  # of other tensors, both of them aligned
            assert other % 16 == 0
        else:
            assert one == other
    assert addresses >= 4
    assert driver.launched[-1][:3] == (programs(shape, options), 1, 1)


def programs(shape: tuple[int, ...], options: Any) -> int:
    """How many programs there are."""
    if options.get("frame"):
        return -(shape[0] // -128)
    return -(torch.Size(shape).numel() // -1024)


def test_a_kernel_is_launched_on_the_gpu_of_its_tensors(
    driver: FakeDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    class There(torch.Tensor):
        def get_device(self) -> int:
            return 1

    current = [0]

    @contextmanager
    def on(device: int) -> Iterator[None]:
        current.append(device)
        yield
        current.append(0)

    monkeypatch.setattr(triton, "several_gpus", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: current[-1])
    monkeypatch.setattr(torch.cuda, "device", on)
    step = case((9, 3), torch.Generator().manual_seed(0))
    for _ in range(2):
        triton.launch(step)
    assert current == [0]  # that of the CPU is every GPU's
    step.param = step.param.as_subclass(There)
    for _ in range(2):
        triton.launch(step)
    assert current == [0, 1, 0, 1, 0]
    assert len(driver.launched) == 4


def test_nothing_that_changes_from_step_to_step_compiles_anew(driver: FakeDriver) -> None:
    """One kernel for every size, width, count, rate, event and weight decay; one for frames."""
    for shape in ((1, 1), (16, 3), (17, 3), (1000, 45), (5,), (4096, 4)):
        for steps in (1, 2, 16):
            for options in ({}, {"fade": True}, {"shrink": 0.9}, {"decay": 0.1}, {"factor": 0.5}):
                launched(driver, shape, steps=steps, **options)
    for rows in (1, 16, 1000):
        launched(driver, (rows, 3), frame=True, steps=rows)
    assert driver.loaded == ["step_rows", "step_in_own_frame"]


def test_tensors_that_begin_anywhere_have_a_kernel_of_their_own(driver: FakeDriver) -> None:
    """A view that begins at 4 bytes is compiled for by itself; others go on as they were."""
    whole, _ = launched(driver, (64, 3)), launched(driver, (64, 3))
    step = case((64, 3), torch.Generator().manual_seed(0))
    step.grad = torch.zeros(64 * 3 + 1)[1:].view(64, 3)
    for _ in range(2):
        triton.launch(step)
    assert len(driver.loaded) == 2
    assert driver.launched[-1][4] == step.grad.data_ptr()
    assert len(launched(driver, (64, 3))) == len(whole)
    assert len(driver.loaded) == 2


@pytest.mark.parametrize("frame", [False, True])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float16], ids=str)
def test_kernels_are_of_the_steps_dtypes(
    driver: FakeDriver, monkeypatch: pytest.MonkeyPatch, dtype: torch.dtype, frame: bool
) -> None:
    """Whatever a trainer makes torch's default, and those that later steps need, too."""
    monkeypatch.setattr(triton, "_PREPARED", set())
    step = case((9, 3), torch.Generator().manual_seed(0), frame=frame)
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        triton.take_step(step, ("factor", "mean") if frame else ("factor", "hold", "mean"))
    finally:
        torch.set_default_dtype(before)
    assert driver.loaded
    assert {kind for kinds in signatures() for kind in kinds if "*" in kind} <= {
        "*fp32", "*i32", "*u8", "*i8",  # the counter, rows that are held, and what is None
    }  # fmt: skip


def signatures() -> list[tuple[str, ...]]:
    """The types of the arguments of all kernels that were compiled."""
    return [tuple(made.src.signature.values()) for made in triton._COMPILED.values()]


def test_numbers_of_any_type_are_floats_in_a_kernel(driver: FakeDriver) -> None:
    """What a part sets: a 1 would be compiled as a constant, which other steps then have, too."""
    plain = case((9, 3), torch.Generator().manual_seed(0), fade=True, hold=True)
    odd = case((9, 3), torch.Generator().manual_seed(0), fade=True, hold=True)
    assert odd.fade is not None
    assert odd.hold is not None
    odd.factor = np.float32(0.5)
    odd.fade, odd.hold = odd.fade._replace(share=1, exp_avg=0), odd.hold._replace(weight=1)
    for step in (odd, plain):
        triton._COMPILED.clear()
        triton.launch(step)
        ((kinds),) = signatures()
        assert kinds.count("fp32") == 15
    assert len(driver.loaded) == 1


def test_large_tensors_have_a_kernel_of_their_own(driver: FakeDriver) -> None:
    """Triton compiles for ROCm anew from 2^31 bytes on."""
    for rows in (100, 12_000_000):
        p, g, m, v = (torch.empty(rows, 15, 3) for _ in range(4))  # nobody touches them
        triton.launch(Step(p, g, None, "", {}, {"exp_avg": m, "exp_avg_sq": v}, 0, -1))
    assert len(triton._COMPILED) == 2


COMPILED = {
    "step": {},
    "fading": {"fade": True},
    "held": {"hold": True},
    "mean": {"mean": True},
    "all": {"hold": True, "mean": True, "factor": torch.ones(1)},
    "long": {"numbers": 2**31 + 7},
}


@pytest.mark.parametrize("name", COMPILED)
def test_rows_are_read_four_numbers_at_a_time(
    driver: FakeDriver, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    options: dict[str, Any] = dict(COMPILED[name])
    long = options.pop("numbers", None)
    if long is not None:
        run = triton._run
        monkeypatch.setattr(
            triton, "_run", lambda *a: run(a[0], a[1], a[2], (long, *a[3][1:]), a[4])
        )
    launched(driver, (64, 4), **options)
    ((key, made),) = triton._COMPILED.items()
    ptx = made.asm["ptx"]
    means = 1 if "mean" in options else 0
    reads = ROWS_BLOCK // (4 * 32 * triton.WARPS["step_rows"])  # of four numbers, by its threads
    assert ptx.count("ld.global.v4") == reads * (4 + means)
    together = ptx[ptx.index("ld.global.v4") : ptx.rindex("ld.global.v4")]
    assert re.search(r"\b(st\.\w+|red|atom|bar)\b", together) is None  # nothing waits between them
    assert ptx.count("st.global.v4") == reads * (3 + means)
    assert ".local" not in ptx  # all in registers
    assert "sqrt.approx" not in ptx  # it takes small numbers for 0
    assert key[3] == (27 if long is None else 32)
    assert ".s64" in ptx or not long


def test_codes_are_read_four_at_a_time(driver: FakeDriver) -> None:
    """Of moments, and of a mean of 16 bits, which has a kernel of its own beside one of 32."""
    for mean in (False, True):
        launched(driver, (64, 4), coded=True, mean=mean)
    step = case((64, 4), torch.Generator().manual_seed(0), coded=True, mean=True)
    step.mean = Mean(False, 10, torch.zeros(64, 4), torch.zeros(64))
    triton.launch(step)
    assert len(driver.loaded) == 3
    reads = ROWS_BLOCK // (4 * 32 * triton.WARPS["step_rows"])
    for made, codes, numbers in zip(triton._COMPILED.values(), (2, 3, 2), (2, 2, 3), strict=True):
        ptx = made.asm["ptx"]
        assert ptx.count("ld.global.v4.b32") == reads * numbers
        assert ptx.count("ld.global.v2.b32") == reads * codes
        assert ".local" not in ptx


@pytest.mark.parametrize(
    ("options", "most"),
    [({}, 40), ({"coded": True}, 48), ({"mean": True}, 64), ({"mean": True, "coded": True}, 64)],
    ids=str,
)
def test_programs_have_few_registers(
    driver: FakeDriver, tmp_path: Path, options: Any, most: int
) -> None:
    """65,536 for the programs of 256 threads that run at a time: 6 with 40, 5 with 48, 4 with 64.

    The last program alone has a mask, which must not cost the others registers.
    """
    launched(driver, (64, 4), **options)
    ((_, made),) = triton._COMPILED.items()
    (path := tmp_path / "kernel.cubin").write_bytes(made.asm["cubin"])
    spec = importlib.util.find_spec("triton")
    assert spec is not None
    assert spec.origin is not None
    tool = Path(spec.origin).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    command = [str(tool), "--dump-resource-usage", str(path)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert next(int(n) for n in re.findall(r"REG:(\d+)", said)) <= most


@pytest.mark.parametrize("options", [{}, {"mean": True, "factor": torch.ones(1)}], ids=str)
def test_own_frames_are_in_registers(driver: FakeDriver, options: Any) -> None:
    launched(driver, (64, 3), frame=True, **options)
    ((_, made),) = triton._COMPILED.items()
    assert ".local" not in made.asm["ptx"]
    assert "bar.sync" not in made.asm["ptx"]  # nothing passes from thread to thread


@pytest.mark.parametrize("options", [{}, {"frame": True}], ids=str)
def test_moments_of_16_bits_are_compiled_beside_those_of_32(
    driver: FakeDriver, options: Any
) -> None:
    for coded in (True, False, True):
        launched(driver, (64, 3), coded=coded, **options)
    assert len(driver.loaded) == 2
    ptx = [made.asm["ptx"] for made in triton._COMPILED.values()]
    assert ["ld.global.b16" in each or "ld.global.v4.b16" in each for each in ptx] == [True, False]
    assert all(".local" not in each for each in ptx)


def test_the_sizes_of_programs() -> None:
    kernels = fresh_kernels({})
    assert kernels.ROWS_BLOCK.value == ROWS_BLOCK
    assert kernels.FRAME_BLOCK.value == FRAME_BLOCK


def test_a_triton_that_cannot_compile_is_said_with_the_cure(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(*_: Any) -> None:
        raise RuntimeError("Failed to find C compiler.")

    zeros = torch.zeros
    monkeypatch.setattr(triton, "launch", fails)
    monkeypatch.setattr(torch, "zeros", lambda *size, **_: zeros(*size))
    said = inspect.unwrap(triton.missing_on)(torch.device("cuda"))
    assert said is not None
    assert "Failed to find C compiler" in said
    assert "apt install gcc" in said
