"""The table of the kernels: how it reads PTX, and that it is of the kernels that there are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from studies.bench import kernels

from opt3dgs_optim import cuda

PTX = """
.visible .entry first(.param .u64 a)
{ ld.global.nc.v4.f32 {%f1,%f2,%f3,%f4}, [%rd1]; ld.global.f32 %f5, [%rd2];
  ld.global.L1::no_allocate.v2.u64 {%rd3,%rd4}, [%rd5]; st.global.u8 [%rd6], %rs1; }
.visible .entry second(.param .u64 a)
{ ld.param.u64 %rd1, [a]; st.global.v2.b32 [%rd1], {%r1,%r2}; }
"""


def committed() -> dict[str, Any]:
    return json.loads((kernels.OUT / "kernels.json").read_text(encoding="utf-8"))


def test_loads_and_stores_are_counted_by_width() -> None:
    found = kernels.entries(PTX)
    assert list(found) == ["first", "second"]
    assert kernels.widths(found["first"], "ld") == {4: 1, 16: 2}
    assert kernels.widths(found["first"], "st") == {1: 1}
    assert kernels.widths(found["second"], "ld") == {}
    assert kernels.widths(found["second"], "st") == {8: 1}
    assert kernels.total({4: 1, 16: 2}) == 36
    assert kernels.total({4: 1, 16: 2}, kernels.WIDE) == 32


def test_the_committed_table_is_of_todays_kernels() -> None:
    """Where a kernel was changed: `python examples/studies/bench/kernels.py`."""
    made = committed()
    assert made["sources_sha256"] == kernels.fingerprint()
    rows = made["kernels"]
    assert {row["kernel"] for row in rows} == set(cuda.KERNELS)
    assert {row["arch"] for row in rows} == {f"sm_{arch}" for arch in kernels.ARCHITECTURES}
    assert all(row["spill_bytes"] == row["stack_bytes"] == 0 for row in rows)
    assert (kernels.OUT / "kernels.md").read_text(encoding="utf-8") == kernels.page(made)


def test_the_roofline_is_bytes_over_bandwidth() -> None:
    rows = {row["what"]: row for row in committed()["roofline"]}
    adams, direction = (
        next(row for what, row in rows.items() if name in what)
        for name in ("six fused Adams", "`lqn_direction`")
    )
    assert adams["bytes_per_point"] == 59 * (4 * 4 + 3 * 4)
    # Five pairs of 160 bytes in and out, position and gradient in, direction and two flags out.
    assert direction["bytes_per_point"] == 160 + 24 + 160 + 12 + 2
    for row in (adams, direction):
        for card, (rate, _) in kernels.CARDS.items():
            least = 1e6 * row["bytes_per_point"] * kernels.POINTS / rate
            assert row["microseconds"][card] == pytest.approx(least, abs=0.06)


@pytest.mark.compiles
def test_the_table_is_what_the_compiler_says() -> None:
    pytest.importorskip("cuda.core")
    found = kernels.compiled("lqn.cu", "90", 5)["lqn_direction"]
    (row,) = (
        row
        for row in committed()["kernels"]
        if (row["kernel"], row["arch"], row["history_size"]) == ("lqn_direction", "sm_90", 5)
    )
    assert found["spill_bytes"] == 0
    assert {str(size): count for size, count in found["loads"].items()} == row["loads"]


@pytest.mark.compiles
def test_the_command_writes_both_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cuda.core")
    monkeypatch.setattr(kernels, "ARCHITECTURES", {"90": "H100"})
    monkeypatch.setattr(kernels, "SIZES", (5,))
    assert kernels.main(["-o", str(tmp_path)]) == 0
    page = (tmp_path / "kernels.md").read_text(encoding="utf-8")
    assert "| `lqn_direction`, K = 5 | sm_90 (H100) |" in page
    assert len(json.loads((tmp_path / "kernels.json").read_text())["kernels"]) == len(cuda.KERNELS)
