"""gsplat's real strategies around upgraded optimizers, and the lines of its page."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from gaussians import RATES, same_tensors
from gsplat_host import ORDERS, POINTS, TOTAL, VERSIONS, Trainer

from opt3dgs_optim import OwnFrame, PhaseScheduler
from opt3dgs_optim.parts.own_frame import STEADY

PAGE = Path(__file__).resolve().parents[2] / "docs" / "hosts" / "gsplat.md"
KINDS = ("mcmc", "default")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")
each_kind = pytest.mark.parametrize("kind", KINDS)
each_version = pytest.mark.parametrize("version", VERSIONS)


def at_the_mean(trainer: Trainer, phases: PhaseScheduler) -> bool:
    """Whether the parameters are the running means; MCMC's noise comes after them."""
    states = {name: phases.state_of_param("", name) or {} for name in RATES}
    return all(
        torch.equal(states[name]["averaging.mean"], trainer.splats[name])
        for name in RATES
        if not (trainer.is_mcmc and name == "means")
    )


@each_kind
@each_version
def test_without_parts_it_is_gsplats_own_training(version: str, kind: str) -> None:
    ours, theirs = (Trainer(version, kind) for _ in range(2))
    ours.upgrade(parts=[])
    for trainer in (ours, theirs):
        trainer.run(0, TOTAL)
    assert len(ours.sizes) > 3
    assert same_tensors(dict(ours.splats), dict(theirs.splats))


@pytest.mark.parametrize(
    ("kind", "order"), [("mcmc", ORDERS[0]), ("mcmc", ORDERS[1]), ("default", ORDERS[0])]
)
@each_version
def test_a_training_ends_at_the_mean(version: str, kind: str, order: str) -> None:
    """Rows stay rows through every edit, the learning rates are the trainer's."""
    trainer = Trainer(version, kind, order)
    phases = trainer.upgrade()
    rate = RATES["means"]
    for step in range(TOTAL):
        trainer.run(step, step + 1)
        rate *= 0.01 ** (1 / TOTAL)
        for name, optimizer in trainer.optimizers.items():
            state = optimizer.state[trainer.splats[name]]
            for key in set(state) - {"step"}:
                assert len(state[key]) == len(trainer.splats["means"]), (name, key)
                assert state[key].dtype == torch.float32
            lr = optimizer.param_groups[0]["lr"]
            assert lr == pytest.approx(rate if name == "means" else RATES[name])
        assert phases.iteration == step
    assert len(trainer.sizes) > 3
    assert all(bool(torch.isfinite(p).all()) for p in trainer.splats.values())
    assert phases.end_line() is None
    assert at_the_mean(trainer, phases)


@each_kind
@each_version
def test_relocation_lifts_the_bound_on_long_axes_and_clone_and_split_does_not(
    version: str, kind: str
) -> None:
    trainer = Trainer(version, kind)
    phases = trainer.upgrade()
    if trainer.is_mcmc:
        trainer.strategy.cap_max = POINTS
    edited, lifted = 0, False
    for step in range(TOTAL // 2):
        before = trainer.splats["means"]
        trainer.splats["opacities"].data[::6] = -9.0
        trainer.run(step, step + 1)
        lifted = lifted or phases.unsaved[OwnFrame, ""].steady >= STEADY
        edited += trainer.splats["means"] is not before
    assert edited >= 4
    assert lifted == trainer.is_mcmc


def test_finish_ends_early_at_the_mean() -> None:
    trainer = Trainer("1.5.3", "mcmc")
    phases = trainer.upgrade(total=2 * TOTAL)
    trainer.run(0, 2 * TOTAL - 2)  # four iterates of the last thirtieth
    assert phases.end_line() is not None
    assert not at_the_mean(trainer, phases)
    phases.finish()
    assert phases.end_line() is None
    assert at_the_mean(trainer, phases)


def test_rows_are_edited_before_the_first_step() -> None:
    """Optimizers without any state."""
    trainer = Trainer("1.5.3", "mcmc")
    trainer.upgrade()
    edited = (trainer.splats, trainer.optimizers, trainer.strategy_state["binoms"])
    trainer.strategy._relocate_gs(*edited)
    trainer.strategy._add_new_gs(*edited)
    trainer.run(0, 4)
    assert len(trainer.splats["means"]) > POINTS


def lines_that_resume() -> dict[str, str]:
    """The page's lines that go on from a file, and those that save one, by the first one's word."""
    (block,) = re.findall(r"```py\n(# below `phases\.upgrade.*?)```", PAGE.read_text(), re.S)
    resume, save = re.split(r"\n\n(?=# )", block)
    return {"resume": resume, "save": save}


@pytest.mark.parametrize(
    ("kind", "at"),
    [(kind, at) for kind in ("mcmc", "default") for at in (TOTAL // 2, TOTAL - 1)],
)
def test_the_pages_lines_save_and_resume_bit_for_bit(kind: str, at: int, tmp_path: Path) -> None:
    """Also where the mean is in the parameters' place, and rows were edited since the last step."""
    lines = lines_that_resume()
    whole, first = (Trainer("1.5.3", kind) for _ in range(2))
    for trainer, end in ((whole, TOTAL), (first, at)):
        trainer.upgrade()
        trainer.run(0, end)
    names: dict[str, Any] = {"torch": torch, "os": os, "PATH": tmp_path / "resume.pt"}
    exec(lines["save"], {**names, "self": first, "step": 4_999})  # an iteration in which it saves
    resumed = Trainer("1.5.3", kind, seed=1)  # all must come from the file
    phases = resumed.upgrade()
    names |= {"self": resumed, "device": "cpu", "phases": phases}
    exec(lines["resume"], names)
    assert names["init_step"] == at
    resumed.run(at, TOTAL)
    assert len(whole.splats["means"]) != POINTS
    assert same_tensors(dict(resumed.splats), dict(whole.splats))
