"""Break the .cu files on purpose, one place at a time, and see the comparison notice.

    python tests/cuda/kernel_mutants.py

prints one line per mutant and fails if one gets through. The kernels are compiled by g++ and run on
the host, as in tests/cuda/test_kernel_host.py; no GPU is needed.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import torch
from kernel_host import (
    SOURCES,
    HostKernels,
    compare_runs,
    compile_host,
    relative_difference,
    two_loop_case,
)

from opt3dgs_optim import two_loop

SIZE = 5
ROWS = 257  # not a multiple of a block: the tail guard has something to do


class Mutant(NamedTuple):
    """A change of one place in one file."""

    name: str
    file: str
    old: str
    new: str


MUTANTS = (
    Mutant("sign in the second loop", "two_loop.cuh", "alpha[j] - dot", "alpha[j] + dot"),
    Mutant(
        "slot of a pair", "two_loop.cuh", "s[j].v = s[j - 1].v", "s[j].v = s[j > 1 ? j - 2 : 0].v"
    ),
    Mutant("tail guard", "lqn.cu", "if (row >= rows) return;", "if (row > rows) return;"),
    Mutant("test of acceptance", "two_loop.cuh", "pair.cosine > min", "pair.cosine < min"),
    Mutant("count of the steps", "two_loop.cuh", "history.steps += T(1)", "history.steps += T(0)"),
    Mutant("gamma", "two_loop.cuh", "over(q, inverse_gamma)", "times(q, inverse_gamma)"),
    Mutant("length of a pair", "two_loop.cuh", "sqrt(of_s / of_y / cosine)", "sqrt(of_s / of_y)"),
    Mutant("length of the grafted step", "two_loop.cuh", "length(unit) /", "T(1) /"),
    Mutant("tail guard of the recursion", "two_loop.cu", "row >= rows", "row > rows"),
    Mutant(
        "scale of the gradient",
        "two_loop.cuh",
        "History<T, K>(row)), scale)",
        "History<T, K>(row)), T(1))",
    ),
    Mutant("a gradient of zero", "two_loop.cuh", "size == T(0) ? T(1) : size", "size"),
)


def complaint(kernels: HostKernels) -> str | None:
    """What the comparison with pure torch says of these kernels; None if nothing."""
    try:
        difference = compare_runs(kernels, ROWS, SIZE)
        grad, history = two_loop_case(ROWS, SIZE)
        recursion = relative_difference(
            kernels.two_loop(grad, history), two_loop(grad, history, SIZE)
        )
    except AssertionError as error:
        return str(error)
    if not difference < 1e-10:
        return f"lqn_direction differs by {difference:.1e}"
    return None if recursion < 1e-10 else f"two_loop differs by {recursion:.1e}"


def mutated(mutant: Mutant | None, folder: Path) -> HostKernels:
    """The kernels with one mutant applied, compiled in `folder`; None: as they are.

    Raises:
        ValueError: the text that the mutant replaces does not occur exactly once.
    """
    sources = folder / "sources"
    shutil.copytree(SOURCES, sources)
    if mutant is not None:
        path = sources / mutant.file
        text = path.read_text()
        if text.count(mutant.old) != 1:
            raise ValueError(
                f"mutant {mutant.name!r}: {mutant.old!r} occurs {text.count(mutant.old)} times in "
                f"{mutant.file}, but exactly once is needed"
            )
        path.write_text(text.replace(mutant.old, mutant.new))
    library = compile_host(folder / "kernels.so", SIZE, torch.float64, sources)
    return HostKernels.load(library, torch.float64, SIZE)


def main() -> int:
    survivors = 0
    for mutant in (None, *MUTANTS):
        with tempfile.TemporaryDirectory() as folder:
            said = complaint(mutated(mutant, Path(folder)))
        name = "unchanged" if mutant is None else mutant.name
        survivors += (said is None) != (mutant is None)
        print(f"{name}: {said or 'no difference'}")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
