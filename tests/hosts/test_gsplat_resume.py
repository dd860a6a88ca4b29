"""docs/hosts/gsplat.md: the lines that save and resume a training, with the real strategies."""

from __future__ import annotations

import os
import types
from pathlib import Path
from typing import Any

import pytest
import torch
from gsplat_host import Trainer, strategies
from hosts.trials import lines_that_resume_gsplat
from test_host_gsplat import build, make_strategy, start
from trainers import gsplat_optimizers

from opt3dgs_optim import PhaseScheduler

TOTAL, HALF = 60, 30

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def names_for(trainer: Trainer, path: Path) -> dict[str, Any]:
    runner = types.SimpleNamespace(
        splats=trainer.splats,
        optimizers=trainer.optimizers,
        strategy_state=trainer.state,
    )
    return {
        "torch": torch,
        "self": runner,
        "PATH": path,
        "device": "cpu",
        "phases": trainer.phases,
        "step": 4_999,  # an iteration in which the lines save
    }


@pytest.mark.parametrize("kind", ["mcmc", "default"])
def test_the_lines_save_and_resume_bit_for_bit(kind: str, tmp_path: Path) -> None:
    save, resume = lines_that_resume_gsplat()

    whole = build("1.5.3", kind, "step, strategy", PhaseScheduler(TOTAL))
    whole.run(0, TOTAL)

    half = build("1.5.3", kind, "step, strategy", PhaseScheduler(TOTAL))
    half.run(0, HALF)
    names = names_for(half, tmp_path / "resume.pt")
    exec(save, names)

    again = PhaseScheduler(TOTAL)
    splats = start(seed=1)  # of another start: everything must come from the file
    optimizers = again.upgrade(gsplat_optimizers(dict(splats)))
    host = types.SimpleNamespace(splats=splats, optimizers=optimizers)
    strategy = make_strategy(strategies("1.5.3"), kind)
    state = strategy.initialize_state(**({} if kind == "mcmc" else {"scene_scale": 1.0}))
    names = {
        **{"torch": torch, "os": os, "PATH": tmp_path / "resume.pt", "device": "cpu"},
        "phases": again,
        "self": types.SimpleNamespace(**vars(host), strategy_state=state),
    }
    exec(resume, names)
    assert names["init_step"] == HALF
    resumed = Trainer(splats, optimizers, strategy, total=TOTAL, phases=again)
    resumed.state = names["self"].strategy_state
    resumed.run(names["init_step"], TOTAL)

    assert len(whole.splats["means"]) != len(start()["means"])
    for name, value in whole.splats.items():
        assert torch.equal(resumed.splats[name], value), name
