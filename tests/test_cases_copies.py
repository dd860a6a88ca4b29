"""Trainers that copy or pickle their model with its optimizer (MonoGS), logs and all."""

from __future__ import annotations

import contextlib
import copy
import io
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from placed_training import ARMS, distance
from torch.nn import Parameter

from opt3dgs_optim import PhaseScheduler, RunLog


def through_torch(value: Any) -> Any:
    torch.save(value, buffer := io.BytesIO())
    buffer.seek(0)
    return torch.load(buffer, weights_only=False)


WAYS: dict[str, Callable[[Any], Any]] = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "torch.save": through_torch,
}
QUIET = [arm for arm in ARMS if "Noise" not in arm and arm != "everything"]
SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": ()}


class Trainer:
    """A model and its optimizer, copied as one."""

    def __init__(self, arm: str, log: RunLog | None = None) -> None:
        draw = torch.Generator().manual_seed(0)
        self.splats = {
            name: Parameter(torch.randn(8, *shape, generator=draw))
            for name, shape in SHAPES.items()
        }
        groups = [{"params": [p], "name": n} for n, p in self.splats.items()]
        self.phases = PhaseScheduler(90, 60, list(ARMS[arm](None)), log=log)
        self.adam: Any = self.phases.upgrade(torch.optim.Adam(groups, lr=0.01, eps=1e-15))

    def run(self, first: int, last: int) -> Trainer:
        for i in range(first, last):
            for name, param in self.splats.items():
                seen = (torch.arange(8) % 3 != i % 3).reshape(-1, *[1] * (param.dim() - 1))
                goal = 1.0 if name == "means" else -1.0
                param.grad = torch.where(seen, param.detach() - goal, 0.0)
            self.phases.observe(0.1 + 0.01 * (i % 7))
            self.adam.step()
        return self

    def edit(self, order: list[int]) -> None:
        """INRIA's edit of rows: another Parameter, and of the state the two moments only."""
        for number, (name, param) in enumerate(self.splats.items()):
            state = self.adam.state.pop(param)
            self.splats[name] = new = Parameter(param.detach()[order].clone())
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = state[key][order]
            self.adam.param_groups[number]["params"][0] = new
            self.adam.state[new] = state


LOGGED = [(way, logged) for way in WAYS for logged in (False, True)]


@pytest.mark.parametrize("case", LOGGED)
@pytest.mark.parametrize("arm", QUIET)
def test_a_copy_goes_on_alike(arm: str, case: tuple[str, bool], tmp_path: Path) -> None:
    """And each on its own: the first is not changed by the other's steps."""
    way, logged = case
    with contextlib.ExitStack() as opened:
        log = opened.enter_context(RunLog(tmp_path / "run.jsonl")) if logged else None
        _goes_on_alike(way, Trainer(arm, log))


def _goes_on_alike(way: str, first: Trainer) -> None:
    second = WAYS[way](first.run(0, 70))
    before = {name: param.detach().clone() for name, param in first.splats.items()}
    second.run(70, 90)
    assert distance(first.splats, before) == 0.0
    first.run(70, 90)
    assert distance(second.splats, first.splats) == 0.0


@pytest.mark.parametrize("order", [[*range(7, -1, -1)], [3, 1]])
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("arm", QUIET)
def test_a_copy_between_an_edit_of_rows_and_the_step(arm: str, way: str, order: list[int]) -> None:
    """What was kept of the rows before is no more the copy's than the first one's."""
    first = Trainer(arm).run(0, 70)
    first.edit(order)
    second = WAYS[way](first)
    for each in (first, second):
        for param in each.splats.values():
            param.grad = param.detach() - 1.0
        each.phases.observe(0.1)
        each.adam.step()
    assert distance(second.splats, first.splats) == 0.0
    keys = [[set(state) for state in each.adam.state.values()] for each in (first, second)]
    assert keys[0] == keys[1]


@pytest.mark.parametrize("way", WAYS)
def test_the_optimizer_alone_is_copied(way: str, tmp_path: Path) -> None:
    """Its scheduler comes with it; what is logged afterwards is one file's, whole lines."""
    with RunLog(tmp_path / "run.jsonl") as log:
        first = Trainer("DEFAULTS", log).run(0, 10)
        WAYS[way](first.adam)
        first.run(10, 20)
    assert len((tmp_path / "run.jsonl").read_text().splitlines()) >= 10
