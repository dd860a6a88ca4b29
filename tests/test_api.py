"""What the docs name can be imported from the top."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

import opt3dgs_optim

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_a_page_imports_from_the_top_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"from opt3dgs_optim import (\([^)]*\)|[^\n(]+)", text)
    plain = [re.sub(r"#[^\n]*|[()`]", "", each) for each in named]
    names = {name for each in plain for name in re.findall(r"\w+", each)}
    assert {name for name in names if not hasattr(opt3dgs_optim, name)} == set()


def test_the_names_that_must_stay() -> None:
    steps = "AWSGLD LQNAdam PhaseScheduler Phase Part Course two_loop backend_info DEFAULTS"
    steps += " history_from_pairs"
    parts = "EnergyHistogram Annealing Fading Averaging Curvature ConstantMultiplier FreshMoments"
    parts += " OutOfView SquaredLoss IsotropicNoise PositionNoise"
    needed = [*steps.split(), *parts.split(), "__version__"]
    assert set(needed) <= set(opt3dgs_optim.__all__)
    assert sorted(opt3dgs_optim.__all__) == sorted(set(opt3dgs_optim.__all__))
    assert all(hasattr(opt3dgs_optim, name) for name in opt3dgs_optim.__all__)
    for optimizer in (opt3dgs_optim.AWSGLD, opt3dgs_optim.LQNAdam):
        assert issubclass(optimizer, torch.optim.Adam)
    scheduler = opt3dgs_optim.PhaseScheduler
    for name in ("upgrade", "observe", "pixel_loss", "phase", "paper"):
        assert hasattr(scheduler, name)
