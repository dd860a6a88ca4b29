"""Every mutant of the kernels is caught, and the kernels as they are are not."""

from __future__ import annotations

from pathlib import Path

import pytest
from kernel_host import compiler
from kernel_mutants import MUTANTS, Mutant, complaint, mutated

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="g++ is not installed"),
    pytest.mark.compiles,
]


def test_unchanged_kernels_pass(tmp_path: Path) -> None:
    assert complaint(mutated(None, tmp_path)) is None


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_mutant_is_caught(tmp_path: Path, mutant: Mutant) -> None:
    assert complaint(mutated(mutant, tmp_path)) is not None


def test_a_mutant_that_no_longer_applies_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="occurs 0 times"):
        mutated(Mutant("stale", "lqn.cu", "no such text", ""), tmp_path)
