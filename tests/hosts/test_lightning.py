"""The plugin of gaussian-splatting-lightning, with stand-ins for the trainer's two plugin classes.

What the trainer does around it is read from its sources, ee022aa: two Adams in a list, hooks after
each backward, a strategy that accumulates gradients and asks for the module of an optimizer.
"""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from opt3dgs_optim import DEFAULTS
from opt3dgs_optim.presets import paper_parts

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


class StrangeAdam(Adam):
    """An Adam of the trainer's own."""


def trainer(
    strategy: str = "VanillaOptStrategy",
    total: int = TOTAL,
    kind: type[Adam] = Adam,
) -> Any:
    """What the plugin sees of the trainer's `GaussianSplatting`."""
    torch.manual_seed(0)
    optimizers = [
        kind(
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
        trainer=types.SimpleNamespace(max_steps=total),
        gaussian_optimizers=optimizers,
        hparams={"opt_strategy": type(strategy, (), {})()},
        extra_train_metrics=[],
        on_after_backward_hooks=[],
        metric=types.SimpleNamespace(rgb_diff_loss_fn=lambda a, b: (a - b).abs().mean()),
        training=True,
    )


def set_up(lightning: Any, host: Any, **options: Any) -> Any:
    module = lightning.Opt3DGS(**options).instantiate()
    module.setup(host)
    return module


def backward(host: Any, step: int) -> Tensor:
    """An iteration of the trainer up to the hooks after backward; it counts from 1."""
    params = [g["params"][0] for o in host.gaussian_optimizers for g in o.param_groups]
    metrics = {"loss": torch.stack([(p * p).mean() for p in params]).sum()}
    for hook in host.extra_train_metrics:
        hook(None, None, None, step, host, metrics, {})
    metrics["loss"].backward()
    for hook in host.on_after_backward_hooks:
        hook(None, None, None, step, host)
    return metrics["loss"]


def test_the_defaults_notice_that_gaussians_are_removed(lightning: Any) -> None:
    """Whatever the trainer calls its density control."""
    host = trainer()
    module = set_up(lightning, host)
    assert list(module.phases.parts) == list(DEFAULTS)
    backward(host, 1)
    assert module.phases.switched_off == {}
    for optimizer in host.gaussian_optimizers:
        for group in optimizer.param_groups:
            group["params"][0] = torch.nn.Parameter(group["params"][0].detach()[1:])
    backward(host, 2)
    assert set(module.phases.switched_off) == {"Fading"}


def test_the_papers_parts(lightning: Any) -> None:
    host = trainer()
    module = set_up(lightning, host, paper=True, switch=0.5)
    assert [repr(p) for p in module.phases.parts] == [repr(p) for p in paper_parts(TOTAL)]
    render, photo = torch.full((2, 3), 0.5), torch.zeros(2, 3)
    assert float(host.metric.rgb_diff_loss_fn(render, photo)) == pytest.approx(0.5)
    for step in range(1, TOTAL // 2 + 1):
        backward(host, step)
        for optimizer in host.gaussian_optimizers:
            optimizer.step()
            optimizer.zero_grad()
    assert float(host.metric.rgb_diff_loss_fn(render, photo)) == pytest.approx(0.25)  # squared
    host.training = False  # validation goes on as it was
    assert float(host.metric.rgb_diff_loss_fn(render, photo)) == pytest.approx(0.5)


def test_the_clock_is_the_trainers(lightning: Any) -> None:
    host = trainer()
    module = set_up(lightning, host)
    for step in range(1, 6):
        backward(host, step)
        assert module.phases.current == step - 1
    backward(host, 31)  # resumed
    assert module.phases.current == 30
    assert module.phases.total_steps == TOTAL
    assert set_up(lightning, trainer(), total_steps=7).phases.total_steps == 7


def test_accumulated_gradients(lightning: Any) -> None:
    """`GradAccOptStrategy` steps torch's Adams every few iterations: they count as torch's."""
    host = trainer(strategy="GradAccOptStrategy")
    module = set_up(lightning, host)
    assert all(o.__module__.startswith("torch.optim.") for o in host.gaussian_optimizers)
    means = host.gaussian_optimizers[0].param_groups[0]["params"][0]
    seen = []
    for step in range(1, 11):
        before = means.detach().clone()
        backward(host, step)
        if step % 5 == 0:
            for optimizer in host.gaussian_optimizers:
                optimizer.step()
                optimizer.zero_grad()
        assert module.phases.current == step - 1
        seen.append(not torch.equal(means, before))
    assert seen == [step % 5 == 0 for step in range(1, 11)]
    assert float(host.gaussian_optimizers[0].state[means]["step"]) == 2


def test_an_optimizer_that_would_not_be_accumulated_is_refused(lightning: Any) -> None:
    with pytest.raises(ValueError, match="GradAccOptStrategy would not accumulate gradients"):
        set_up(lightning, trainer(strategy="GradAccOptStrategy", kind=StrangeAdam))
    set_up(lightning, trainer(kind=StrangeAdam))


@pytest.mark.parametrize("total", [-1, 0])
def test_a_number_of_iterations_is_needed(lightning: Any, total: int) -> None:
    with pytest.raises(ValueError, match="the number of iterations is needed"):
        set_up(lightning, trainer(total=total))
