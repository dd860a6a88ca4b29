"""gsplat's real strategies around upgraded optimizers, and the lines of its page."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from gsplat_host import ORDERS, POINTS, RATES, VERSIONS, Trainer

from opt3dgs_optim import DEFAULTS_ADC, PhaseScheduler

PAGE = Path(__file__).resolve().parents[2] / "docs" / "hosts" / "gsplat.md"
TOTAL, HALF = 60, 30
KINDS = {"mcmc": None, "default": DEFAULTS_ADC}

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
each_kind = pytest.mark.parametrize("kind", KINDS)


def at_the_mean(trainer: Trainer, phases: PhaseScheduler) -> bool:
    """Whether the parameters are the running means; MCMC's noise comes after them."""
    states = {name: phases.state_of_param("", name) or {} for name in RATES}
    return all(
        torch.equal(states[name]["averaging.mean"], trainer.splats[name])
        for name in RATES
        if not (trainer.is_mcmc and name == "means")
    )


@pytest.mark.hosts
@each_kind
def test_without_parts_it_is_the_main_branchs_trainer(kind: str) -> None:
    ours, theirs = (Trainer("main", kind, total=TOTAL) for _ in range(2))
    ours.upgrade(TOTAL, parts=[])
    for trainer in (ours, theirs):
        trainer.run(0, TOTAL)
    assert len(ours.splats["means"]) != POINTS
    for name in RATES:
        assert torch.equal(ours.splats[name], theirs.splats[name]), name


@pytest.mark.parametrize(
    ("kind", "order"), [("mcmc", ORDERS[0]), ("mcmc", ORDERS[1]), ("default", ORDERS[0])]
)
@pytest.mark.parametrize("version", VERSIONS)
def test_a_training_ends_at_the_mean(version: str, kind: str, order: str) -> None:
    """Rows stay rows through every edit, the learning rates are the trainer's."""
    trainer = Trainer(version, kind, order, total=TOTAL)
    phases = trainer.upgrade(TOTAL, KINDS[kind])
    sizes = set()
    for step in range(TOTAL):
        trainer.run(step, step + 1)
        sizes.add(len(trainer.splats["means"]))
        for name, optimizer in trainer.optimizers.items():
            state = optimizer.state[trainer.splats[name]]
            for key in set(state) - {"step"}:
                assert len(state[key]) == len(trainer.splats["means"]), (name, key)
                assert state[key].dtype == torch.float32
            decay = 0.01 ** ((step + 1) / TOTAL) if name == "means" else 1.0
            assert optimizer.param_groups[0]["lr"] == pytest.approx(RATES[name] * decay)
        assert phases.iteration == step
    assert len(sizes) > 3
    assert min(sizes) > 20
    assert all(bool(torch.isfinite(p).all()) for p in trainer.splats.values())
    assert phases.end_line() is None
    assert at_the_mean(trainer, phases)


def test_finish_ends_early_at_the_mean() -> None:
    trainer = Trainer("1.5.3", "mcmc", total=TOTAL)
    phases = trainer.upgrade(2 * TOTAL)
    trainer.run(0, 2 * TOTAL - 2)  # two iterates of the last thirtieth
    assert phases.end_line() is not None
    assert not at_the_mean(trainer, phases)
    phases.finish()
    assert phases.end_line() is None
    assert at_the_mean(trainer, phases)


def lines_that_resume() -> dict[str, str]:
    """The page's lines that go on from a file, and those that save one, by the first one's word."""
    (block,) = re.findall(r"```py\n(# below `phases\.upgrade.*?)```", PAGE.read_text(), re.S)
    resume, save = re.split(r"\n\n(?=# )", block)
    return {"resume": resume, "save": save}


@each_kind
def test_the_pages_lines_save_and_resume_bit_for_bit(kind: str, tmp_path: Path) -> None:
    lines = lines_that_resume()
    whole, half = (Trainer("1.5.3", kind, total=TOTAL) for _ in range(2))
    for trainer, end in ((whole, TOTAL), (half, HALF)):
        trainer.upgrade(TOTAL, KINDS[kind])
        trainer.run(0, end)
    names: dict[str, Any] = {"torch": torch, "os": os, "PATH": tmp_path / "resume.pt"}
    exec(lines["save"], {**names, "self": half, "step": 4_999})  # an iteration in which it saves
    resumed = Trainer("1.5.3", kind, total=TOTAL, seed=1)  # all must come from the file
    phases = resumed.upgrade(TOTAL, KINDS[kind])
    names |= {"self": resumed, "device": "cpu", "phases": phases}
    exec(lines["resume"], names)
    assert names["init_step"] == HALF
    resumed.run(HALF, TOTAL)
    assert len(whole.splats["means"]) != POINTS
    for name in RATES:
        assert torch.equal(resumed.splats[name], whole.splats[name]), name
