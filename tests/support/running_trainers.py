"""Whole small trainers, written as text, run stock and edited with the real scheduler and Adam.

A script imports what it needs from `trainer`, and says by `saw(count, total)` in every iteration
where its own clock is, from 0. Noted is every step of a Gaussians' optimizer, and which iteration
the scheduler took it for.
"""

from __future__ import annotations

import types
import warnings
from dataclasses import dataclass, field
from typing import Any

import torch
from random_trainers import run_with
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

import opt3dgs_optim
from opt3dgs_optim import PhaseScheduler

NAMES = {"xyz": 3, "f_dc": 3, "opacity": 1, "scaling": 3, "rotation": 4}
POINTS = 6


@dataclass
class Ran:
    """What happened in a run.

    Attributes:
        clock: for every step of an optimizer, what the trainer said last: its count and total.
        scheduled: likewise what the scheduler said, or None where the step had no parts.
        end: the parameters' sum, to compare two runs with.
        warned: what the scheduler complained of.
    """

    clock: list[tuple[int, int]] = field(default_factory=list)
    scheduled: list[tuple[int, int] | None] = field(default_factory=list)
    end: float = 0.0
    warned: list[str] = field(default_factory=list)


class Runner:
    """The names of the module `trainer`, and the notes."""

    def __init__(self) -> None:
        self.ran, self._saw = Ran(), (-1, 0)
        self._scheduled: tuple[int, int] | None = None
        self.parameters: list[Parameter] = []
        torch.manual_seed(0)

    def saw(self, count: int, total: int) -> None:
        """The trainer's own clock."""
        self._saw = int(count), int(total)

    def adam(self, names: dict[str, int] | None = None, **options: Any) -> Adam:
        """An Adam over new Gaussians, as INRIA's model makes it."""
        groups = []
        for name, width in (names or NAMES).items():
            param = Parameter(torch.ones(POINTS, width))
            self.parameters.append(param)
            groups.append({"params": [param], "lr": 0.01, "name": name})
        return self.watch(Adam(groups, lr=0.0, eps=1e-15, **options))

    def watch(self, optimizer: Adam) -> Adam:
        """Note every step of an optimizer."""

        def stepped(*_: Any) -> None:
            self.ran.clock.append(self._saw)
            self.ran.scheduled.append(self._scheduled)
            self._scheduled = None

        optimizer.register_step_post_hook(stepped)
        return optimizer

    def optimizers(self) -> dict[str, Adam]:
        """A dict of Adams, as gsplat has it."""
        names = {"means": 3, "scales": 3, "quats": 4, "opacities": 1, "sh0": 3}
        return {name: self.adam({name: width}) for name, width in names.items()}

    def loss_of(self, *_: Any) -> Tensor:
        """A loss of every parameter that was made."""
        return torch.stack([(p * p).mean() for p in self.parameters]).sum()

    def model(self, *_: Any) -> Any:
        """INRIA's `GaussianModel`, as far as a loop uses it."""
        runner = self

        class GaussianModel:
            optimizer: Adam

            def training_setup(self, *_: Any) -> None:
                self.optimizer = runner.adam()

            def restore(self, saved: Any, *_: Any) -> None:
                self.training_setup()
                self.optimizer.load_state_dict(saved)

            def densify_and_prune(self, *_: Any) -> None:
                """Nothing."""

        return GaussianModel()

    def scheduler_class(self) -> type[PhaseScheduler]:
        """`PhaseScheduler`, whose steps are noted."""
        runner = self

        class Watched(PhaseScheduler):
            def stepping(self, closure_value: Any, optimizer: Any) -> bool:
                acting = super().stepping(closure_value, optimizer)
                if acting:
                    runner._scheduled = self.current, self.total_steps
                return acting

        return Watched


def run(source: bytes, **more: Any) -> Ran:
    """Run a script, stock or edited; `more` are names that it may import besides."""
    runner = Runner()
    trainer: Any = types.ModuleType("trainer")
    zeros = torch.zeros(2, 3, requires_grad=True)
    names = {
        "saw": runner.saw,
        "adam": runner.adam,
        "watch": runner.watch,
        "make_optimizers": runner.optimizers,
        "loss_of": runner.loss_of,
        "GaussianModel": runner.model,
        "l1_loss": lambda a, b: (a - b).abs().mean(),
        "render": lambda *_: (zeros, torch.ones(2, 3)),
        "loader": range(8),
        "opt": types.SimpleNamespace(iterations=8, accum=2),
        "tqdm": lambda source=None, **_: source,
        "trange": lambda *numbers, **_: range(*numbers),
        "parameters": runner.parameters,
        **more,
    }
    vars(trainer).update(names)
    ours: Any = types.ModuleType("opt3dgs_optim")
    vars(ours).update({name: getattr(opt3dgs_optim, name) for name in opt3dgs_optim.__all__})
    ours.PhaseScheduler = runner.scheduler_class()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        run_with({"trainer": trainer, "opt3dgs_optim": ours}, source)
    runner.ran.warned = [str(each.message) for each in caught]
    runner.ran.end = float(torch.stack([p.detach().sum() for p in runner.parameters]).sum())
    return runner.ran
