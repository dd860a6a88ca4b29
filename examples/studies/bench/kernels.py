"""The CUDA kernels without a GPU: what the compiler made of them, and a roofline on paper.

    python examples/studies/bench/kernels.py

Compiles every kernel of the package with NVRTC for every architecture from Turing to Blackwell
(`pip install -e ".[test]"` brings it; no driver is needed), and reads registers, spills and stack
from ptxas, the widths of the loads from the PTX. The roofline is bytes over published bandwidth:
the least time that a step can take on that card, to be held against the first real run
(`python examples/gpu.py`). Writes `kernels.json` and `kernels.md` to `--out`.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import io
import json
import platform
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import torch
from splatting.stopping import command
from tqdm import tqdm

from opt3dgs_optim import cuda
from studies.bench.steps import ADAM_BYTES
from studies.bench.subjects import NUMBERS
from studies.pages import table

OUT = Path(__file__).resolve().parents[3] / "docs" / "benchmarks"
ARCHITECTURES = {
    "75": "Turing",
    "80": "A100",
    "86": "RTX 30",
    "89": "RTX 40, L4",
    "90": "H100",
    "100": "B200",
    "120": "RTX 50",
}
SIZES = (1, 3, 4, 5)  # pairs of a history
WIDE = 16  # bytes of the loads that a thread should make
# Bytes per second, as NVIDIA publishes them.
CARDS = {
    "H100 SXM": (3.35e12, "https://www.nvidia.com/en-us/data-center/h100/"),
    "RTX 4090": (
        1.008e12,
        "https://images.nvidia.com/aem-dam/Solutions/geforce/ada/nvidia-ada-gpu-architecture.pdf",
    ),
}
POINTS = 1_000_000


def compiled(file: str, arch: str, size: int | None) -> dict[str, dict[str, Any]]:
    """What became of the kernels of a file: kernel -> registers, spills, loads."""
    log = io.StringIO()
    options = {"history_size": size, "ptxas_options": ["-v"]}
    cuda.compile_cubin(file, torch.float32, f"sm_{arch}", logs=log, **options)
    said, found = log.getvalue(), {}
    for name, text in entries(ptx_of(file, arch, size)).items():
        part = said[said.index(f"'{name}'") :]
        stack = re.search(r"(\d+) bytes stack frame, (\d+) \D+, (\d+) bytes spill loads", part)
        registers = re.search(r"Used (\d+) registers", part)
        if stack is None or registers is None:
            raise ValueError(f"{file}, sm_{arch}: ptxas said nothing of {name}: {said}")
        found[name] = {
            "registers": int(registers[1]),
            "stack_bytes": int(stack[1]),
            "spill_bytes": int(stack[2]) + int(stack[3]),
            "loads": widths(text, "ld"),
            "stores": widths(text, "st"),
        }
    return found


def ptx_of(file: str, arch: str, size: int | None) -> str:
    """cuda.core asks the driver before it gives PTX; NVRTC itself does not."""
    from cuda.bindings import nvrtc  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

    options = ["-std=c++17", f"-arch=compute_{arch}"]
    options += [f"-D{key}={value}" for key, value in cuda.macros(torch.float32, size)]
    _, program = nvrtc.nvrtcCreateProgram(cuda.source(file).encode(), b"kernel.cu", 0, [], [])
    (error,) = nvrtc.nvrtcCompileProgram(program, len(options), [o.encode() for o in options])
    if int(error) != 0:
        raise ValueError(f"{file}, sm_{arch}: NVRTC failed with {error}")
    _, length = nvrtc.nvrtcGetPTXSize(program)
    ptx = b" " * length
    nvrtc.nvrtcGetPTX(program, ptx)
    return ptx.decode()


def entries(ptx: str) -> dict[str, str]:
    """Kernel -> its part of the PTX."""
    parts = re.split(r"\.entry\s+(\w+)", ptx)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def widths(ptx: str, kind: str) -> dict[int, int]:
    """Bytes of an instruction -> how many of them load from (or store to) global memory.

    As they stand in the PTX: what is in a branch counts, what is in a loop counts once.
    """
    pattern = kind + r"\.global(?:\.[\w:]+)*?(?:\.v(\d))?\.[bfus](\d+)"
    sizes = [int(many or 1) * int(bits) // 8 for many, bits in re.findall(pattern, ptx)]
    return {size: sizes.count(size) for size in sorted(set(sizes))}


def inspect() -> list[dict[str, Any]]:
    """Every kernel, for every architecture and size of history."""
    made = []
    cases = [
        (file, arch, size)
        for file in dict.fromkeys(cuda.KERNELS.values())
        for arch in ARCHITECTURES
        for size in (SIZES if "HISTORY_SIZE" in text_of(file) else (None,))
    ]
    for file, arch, size in tqdm(cases, desc="compiling"):
        for kernel, found in compiled(file, arch, size).items():
            made.append({"kernel": kernel, "arch": f"sm_{arch}", "history_size": size, **found})
    return made


def text_of(file: str) -> str:
    """A kernel file without the header that goes in front of all."""
    return Path(cuda.__file__).with_name(file).read_text(encoding="utf-8")


def fingerprint() -> str:
    """Of all kernel sources: the table is out of date where it is another one."""
    sources = "".join(cuda.source(file) for file in sorted(set(cuda.KERNELS.values())))
    return hashlib.sha256(sources.encode()).hexdigest()


def total(counts: dict[int, int], least: int = 0) -> int:
    """Bytes of the instructions that move so many or more at once."""
    return sum(int(size) * count for size, count in counts.items() if int(size) >= least)


def roofline(found: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Bytes per point of what a step does, and the least microseconds of a million points."""
    work = {
        "six fused Adams: 4 numbers read, 3 written of each of 59": ADAM_BYTES,
        "averaging, in the last thirtieth: the mean read and written, the parameter read": 12
        * NUMBERS,
    }
    for row in found:
        if (row["arch"], row["history_size"]) == ("sm_90", SIZES[-1]):
            name = f"`{row['kernel']}`, {SIZES[-1]} pairs: its loads and stores, all taken"
            work[name] = total(row["loads"]) + total(row["stores"])
    return [
        {
            "what": what,
            "bytes_per_point": size,
            "microseconds": {
                card: round(1e6 * size * POINTS / rate, 1) for card, (rate, _) in CARDS.items()
            },
        }
        for what, size in work.items()
    ]


def page(result: dict[str, Any]) -> str:
    """Markdown."""

    def said(counts: dict[int, int]) -> str:
        return ", ".join(f"{count} of {size}" for size, count in counts.items()) or "none"

    rows = [
        (
            f"`{row['kernel']}`" + (f", K = {row['history_size']}" if row["history_size"] else ""),
            f"{row['arch']} ({ARCHITECTURES[row['arch'].removeprefix('sm_')]})",
            row["registers"],
            row["spill_bytes"] + row["stack_bytes"],
            said(row["loads"]),
            f"{total(row['loads'], WIDE) / max(total(row['loads']), 1):.0%}",
            said(row["stores"]),
        )
        for row in result["kernels"]
    ]
    heads = ("kernel", "for", "registers", "spills and stack, bytes", "loads, bytes each")
    heads += ("of them in 16 or more", "stores, bytes each")
    cards = [f"{card}, µs" for card in CARDS]
    paper = [
        (row["what"], f"{row['bytes_per_point']:,}", *row["microseconds"].values())
        for row in result["roofline"]
    ]
    sources = [
        f"{card}: {rate / 1e12:g} TB/s ([NVIDIA]({url}))" for card, (rate, url) in CARDS.items()
    ]
    return "\n".join(
        [
            "# Kernels and roofline, without a GPU",
            "",
            f"By `{result['command']}`, {result['date']}: {result['machine']}.",
            "",
            "## What the compiler made of the kernels",
            "",
            "float32. One thread has one point. Loads and stores are of global memory, as they "
            "stand in the PTX: those in a branch count, too.",
            "",
            table(heads, "llrrlrl", rows),
            "",
            "## A roofline on paper",
            "",
            f"The least microseconds for {POINTS:,} points, harmonics of degree 3: bytes that must "
            "move over the bandwidth of the card. Nothing was run; what is beyond these times in "
            "the first run of `python examples/gpu.py` is launches, and what a memory does not "
            "reach of its bandwidth. "
            f"{'; '.join(sources)}.",
            "",
            table(("", "bytes per point", *cards), "lr", paper),
            "",
        ]
    )


@command("kernels")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--out", type=Path, default=OUT, metavar="DIR")
    args = parser.parse_args(arguments)
    found = inspect()
    nvrtc = importlib.metadata.version("nvidia-cuda-nvrtc")
    result = {
        "command": "python examples/studies/bench/kernels.py",
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "machine": f"{platform.system()} {platform.machine()}, NVRTC {nvrtc}",
        "sources_sha256": fingerprint(),
        "kernels": found,
        "roofline": roofline(found),
    }
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "kernels.json").write_text(json.dumps(result) + "\n", encoding="utf-8")
    (args.out / "kernels.md").write_text(page(result), encoding="utf-8")
    print(args.out / "kernels.json", args.out / "kernels.md", sep="\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
