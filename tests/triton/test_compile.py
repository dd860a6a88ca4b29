"""The step's kernels compile for a GPU, without one; and few of them in a training."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("triton.language", reason="Triton is not installed")

import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from opt3dgs_optim.triton import FRAME_BLOCK, ROWS_BLOCK, kernels

pytestmark = pytest.mark.compiles

FLOATS = ("p", "g", "m", "v", "quats", "scales", "mean", "began", "factor")
TENSORS = dict.fromkeys(FLOATS, "*fp32")
TENSORS |= {"held": "*u8", "nonfinite": "*i32"}
INTEGERS = {"numbers": "i32", "width": "i32", "key": "i32", "rows": "i32"}


def compiled(kernel: Any, absent: tuple[str, ...], numbers: str = "i32") -> Any:
    """A kernel for sm_90 where the arguments `absent` are None; pointers are multiples of 16."""
    names = kernel.arg_names
    constants = dict.fromkeys(absent)
    signature, attributes = {}, {}
    for i, name in enumerate(names):
        kind = {**TENSORS, **INTEGERS, "numbers": numbers}.get(name, "fp32")
        signature[name] = "constexpr" if name in constants else kind
        if signature[name].startswith("*"):
            attributes[(i,)] = [["tt.divisibility", 16]]
    values = {(names.index(name),): value for name, value in constants.items()}
    source = ASTSource(kernel, signature, values, attributes)
    options = {"enable_fp_fusion": False}
    return triton.compile(source, target=GPUTarget("cuda", 90, 32), options=options)


NOTHING = ("mean", "began", "held", "factor")
CASES = {
    "rows": NOTHING,
    "rows, held": ("mean", "began", "factor"),
    "rows, mean": ("held", "factor"),
    "rows, all": (),
    "rows, plain": (*NOTHING, "m", "v"),
    "rows, long": (),
}


@pytest.mark.parametrize("name", CASES)
def test_rows_compile_and_read_four_numbers_at_a_time(name: str) -> None:
    absent = CASES[name]
    made = compiled(kernels.step_rows, absent, "i64" if "long" in name else "i32")
    ptx = made.asm["ptx"]
    moments = 2 * int("m" not in absent)
    means = int("mean" not in absent)
    programs = ROWS_BLOCK // (4 * 128)  # times four numbers, of 128 threads
    assert ptx.count("ld.global.v4") == programs * (2 + moments + means)
    assert ptx.count("st.global.v4") == programs * (1 + moments + means)
    assert ".local" not in ptx  # all in registers


def test_the_sizes_of_programs() -> None:
    assert kernels.ROWS_BLOCK.value == ROWS_BLOCK
    assert kernels.FRAME_BLOCK.value == FRAME_BLOCK


@pytest.mark.parametrize("absent", [("mean", "began", "factor"), ()], ids=["step", "all"])
def test_own_frames_compile(absent: tuple[str, ...]) -> None:
    assert ".local" not in compiled(kernels.step_in_own_frame, absent).asm["ptx"]
