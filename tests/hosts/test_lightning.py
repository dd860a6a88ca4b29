"""The plugin of gaussian-splatting-lightning, with stand-ins for the trainer's two plugin classes.

What the trainer does around it is read from its sources, ee022aa: two Adams in a list, hooks after
each backward, and Lightning loads the optimizers' states after that.
"""

from __future__ import annotations

import copy
import importlib
import sys
import types
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import DEFAULTS

TOTAL = 60
NAMES = (("means",), ("shs_dc", "shs_rest", "scales", "rotations", "opacities"))
WIDTHS = {"means": 3, "shs_dc": 3, "shs_rest": 9, "scales": 3, "rotations": 4, "opacities": 1}


@pytest.fixture
def lightning(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The plugin's module, imported beside stand-ins of the trainer's."""

    class PluginModule(torch.nn.Module):
        def __init__(self, config: Any) -> None:
            super().__init__()
            self.config = config

    plugin: Any = types.ModuleType("internal.plugins.plugin")
    plugin.Plugin, plugin.PluginModule = type("Plugin", (), {}), PluginModule
    for name in ("internal", "internal.plugins"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, plugin.__name__, plugin)
    sys.modules.pop("opt3dgs_optim.hosts.lightning", None)
    yield importlib.import_module("opt3dgs_optim.hosts.lightning")
    sys.modules.pop("opt3dgs_optim.hosts.lightning", None)


def trainer(strategy: str = "VanillaOptStrategy", total: int = TOTAL, epochs: int = -1) -> Any:
    """What the plugin sees of the trainer's `GaussianSplatting`."""
    torch.manual_seed(0)
    optimizers = [
        Adam(
            [
                {"params": [Parameter(torch.ones(6, WIDTHS[n]))], "lr": 1e-2, "name": n}
                for n in names
            ],
            lr=0.0,
            eps=1e-15,
        )
        for names in NAMES
    ]
    return types.SimpleNamespace(
        trainer=types.SimpleNamespace(max_steps=total, max_epochs=epochs),
        gaussian_optimizers=optimizers,
        hparams={"opt_strategy": type(strategy, (), {})()},
        on_after_backward_hooks=[],
    )


def set_up(lightning: Any, host: Any, **options: Any) -> Any:
    module = lightning.Opt3DGS(**options).instantiate()
    module.setup(host)
    return module


def run(host: Any, first: int, last: int) -> None:
    """Iterations of the trainer, which counts them from 1: hooks after backward, then steps."""
    for step in range(first, last + 1):
        torch.manual_seed(step)
        for optimizer in host.gaussian_optimizers:
            for group in optimizer.param_groups:
                param = group["params"][0]
                param.grad = torch.randn_like(param)
        for hook in host.on_after_backward_hooks:
            hook({}, None, None, step, host)
        for optimizer in host.gaussian_optimizers:
            optimizer.step()


def values(host: Any) -> list[torch.Tensor]:
    return [g["params"][0].detach() for o in host.gaussian_optimizers for g in o.param_groups]


def test_a_run_and_its_resume(lightning: Any) -> None:
    whole, half, again = (trainer() for _ in range(3))
    phases = set_up(lightning, whole).phases
    assert phases.parts == DEFAULTS
    run(whole, 1, TOTAL)
    assert phases.iteration == TOTAL - 1
    assert phases.end_line() is None  # it has ended, with the mean
    set_up(lightning, half)
    run(half, 1, 25)
    resumed = set_up(lightning, again)
    for mine, saved in zip(again.gaussian_optimizers, half.gaussian_optimizers, strict=True):
        for to, of in zip(mine.param_groups, saved.param_groups, strict=True):
            to["params"][0].data.copy_(of["params"][0])
        mine.load_state_dict(copy.deepcopy(saved.state_dict()))
    assert resumed.phases.iteration == 24
    run(again, 26, TOTAL)
    for one, other in zip(values(whole), values(again), strict=True):
        assert torch.equal(one, other)


def test_a_checkpoint_of_the_unchanged_trainer(lightning: Any) -> None:
    """Its Adam has made fewer steps than iterations: the trainer's count says the place."""
    stock, mine = trainer(), trainer()
    run(stock, 1, 20)
    module = set_up(lightning, mine)
    for to, of in zip(mine.gaussian_optimizers, stock.gaussian_optimizers, strict=True):
        to.load_state_dict(copy.deepcopy(of.state_dict()))
    run(mine, 31, 31)
    assert module.phases.iteration == 30


@pytest.mark.parametrize(("total", "epochs"), [(-1, -1), (TOTAL, 3), (-1, 3)])
def test_a_number_of_iterations_is_needed(lightning: Any, total: int, epochs: int) -> None:
    """Where epochs are given, the trainer has its 30,000 `max_steps` all the same."""
    host = trainer(total=total, epochs=epochs)
    with pytest.raises(ValueError, match="the number of iterations is needed"):
        set_up(lightning, host)
    assert set_up(lightning, host, total_steps=50).phases.total_steps == 50


def test_accumulated_gradients_are_refused(lightning: Any) -> None:
    with pytest.raises(ValueError, match="GradAccOptStrategy would not accumulate gradients"):
        set_up(lightning, trainer(strategy="GradAccOptStrategy"))


def test_without_the_trainer_the_import_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "opt3dgs_optim.hosts.lightning", raising=False)
    monkeypatch.setitem(sys.modules, "internal", None)
    with pytest.raises(ImportError, match=r"run its main\.py"):
        importlib.import_module("opt3dgs_optim.hosts.lightning")
