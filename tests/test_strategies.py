"""gsplat's own MCMCStrategy and DefaultStrategy edit rows under upgraded optimizers, on a CPU."""

from __future__ import annotations

import io
from typing import Any

import pytest
import torch
from gaussians import RATES, adams_of, parameters, same_tensors
from gsplat_strategies import Training, gsplat_strategies
from torch.nn import Parameter, ParameterDict

from opt3dgs_optim import DEFAULTS, DEFAULTS_ADC, PhaseScheduler

TOTAL, POINTS = 240, 40

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def strategy_of(kind: str) -> Any:
    """Edits from 5 to 237: also in the last thirtieth, and while the mean is in place."""
    package = gsplat_strategies()
    often = {"refine_start_iter": 5, "refine_stop_iter": 238, "refine_every": 7}
    if kind == "mcmc":
        return package.MCMCStrategy(cap_max=90, noise_lr=1.0, **often)
    sizes = {"grow_grad2d": 1e-3, "grow_scale3d": 0.6, "prune_opa": 0.3, "prune_scale3d": 1e9}
    return package.DefaultStrategy(reset_every=60, **often, **sizes)


def start(kind: str, parts: Any, upgrade: bool = True) -> Training:
    strategy = strategy_of(kind)
    params = ParameterDict(parameters(POINTS, seed=0))
    params["opacities"].data[::6] = -9.0  # dead: to be relocated or pruned
    optimizers: Any = adams_of(dict(params))
    if upgrade:
        PhaseScheduler(TOTAL, parts=parts).upgrade(optimizers)
    return Training(strategy, params, optimizers, TOTAL)


@pytest.mark.parametrize("kind", ["mcmc", "default"])
def test_without_parts_it_is_the_stock_training(kind: str) -> None:
    ours, stock = start(kind, []), start(kind, [], upgrade=False)
    for training in (ours, stock):
        training.run(0, 60)
    assert len(ours.sizes) > 3
    assert same_tensors(dict(ours.params), dict(stock.params))


@pytest.mark.parametrize(("kind", "parts"), [("mcmc", DEFAULTS), ("default", DEFAULTS_ADC)])
def test_a_whole_training_and_its_resume(kind: str, parts: Any) -> None:
    """State by rows, float32; rates the trainer's; a resume in the last thirtieth ends alike."""
    whole = start(kind, parts)
    whole.run(0, 234)
    params, optimizers = whole.params, whole.optimizers
    for name, optimizer in optimizers.items():
        state = optimizer.state[params[name]]
        assert {"exp_avg", "exp_avg_sq", "averaging.mean", "averaging.began"} < set(state)
        for key in set(state) - {"step"}:
            assert len(state[key]) == len(params["means"]), (name, key)
            assert state[key].dtype == torch.float32
        decay = 0.01 ** (234 / TOTAL) if name == "means" else 1.0
        assert optimizer.param_groups[0]["lr"] == pytest.approx(RATES[name] * decay)
    buffer = io.BytesIO()
    saved = {
        "splats": {name: param.detach() for name, param in params.items()},
        "optimizers": {name: each.state_dict() for name, each in optimizers.items()},
        "strategy": whole.state,
        "decay": whole.decay.state_dict(),
    }
    torch.save(saved, buffer)
    whole.run(234, TOTAL)
    assert len(whole.sizes) > 3
    assert all(bool(torch.isfinite(param).all()) for param in whole.params.values())

    buffer.seek(0)
    loaded = torch.load(buffer, weights_only=True)
    params = ParameterDict({n: Parameter(each) for n, each in loaded["splats"].items()})
    optimizers = PhaseScheduler(TOTAL, parts=parts).upgrade(adams_of(dict(params)))
    second = Training(strategy_of(kind), params, optimizers, TOTAL)
    for name, optimizer in optimizers.items():
        optimizer.load_state_dict(loaded["optimizers"][name])
    second.decay.load_state_dict(loaded["decay"])
    second.state = loaded["strategy"]
    second.run(234, TOTAL)
    assert same_tensors(dict(whole.params), dict(second.params))


def test_rows_are_edited_before_the_first_step() -> None:
    """Optimizers without any state."""
    training = start("mcmc", DEFAULTS)
    training.strategy._relocate_gs(training.params, training.optimizers, training.state["binoms"])
    training.strategy._add_new_gs(training.params, training.optimizers, training.state["binoms"])
    training.run(0, 4)
    assert len(training.params["means"]) > POINTS
