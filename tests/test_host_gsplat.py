"""gsplat's own MCMCStrategy and DefaultStrategy around our optimizers, on a CPU (HOSTS.md)."""

from __future__ import annotations

import io
from typing import Any

import pytest
import torch
from gsplat_host import ORDERS, VERSIONS, Trainer, scene_of_main, strategies
from placed_training import some_of
from torch.nn import Parameter, ParameterDict
from trainers import RATES, everything, gsplat_optimizers, make_splats

from opt3dgs_optim import EnergyHistogram, PhaseScheduler

TOTAL, SWITCH, POINTS = 60, 30, 40

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


def make_strategy(package: Any, kind: str) -> Any:
    """Edits from 5 to 50, so that they happen in both phases."""
    if kind == "mcmc":
        return package.MCMCStrategy(
            cap_max=70, refine_start_iter=5, refine_stop_iter=50, refine_every=7, noise_lr=1.0
        )
    return package.DefaultStrategy(
        refine_start_iter=5,
        refine_stop_iter=50,
        refine_every=7,
        reset_every=20,
        grow_grad2d=1e-3,
        grow_scale3d=0.6,
        prune_opa=0.3,
        prune_scale3d=1e9,
    )


def start(seed: int = 0) -> Any:
    splats = ParameterDict(make_splats(POINTS, seed))
    splats["opacities"].data[::6] = -9.0  # dead: to be relocated or pruned
    return splats


def phased() -> PhaseScheduler:
    return everything(TOTAL, SWITCH, nu=EnergyHistogram(warmup=8))


def build(version: str, kind: str, order: str, phases: PhaseScheduler | None) -> Trainer:
    strategy = make_strategy(strategies(version), kind)
    splats = start()
    optimizers: Any = gsplat_optimizers(dict(splats))
    if phases is not None:
        optimizers = phases.upgrade(optimizers)
    return Trainer(splats, optimizers, strategy, total=TOTAL, phases=phases, order=order)


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("kind", ["mcmc", "default"])
@pytest.mark.parametrize("order", ORDERS)
def test_off_is_bit_identical_to_the_trainer_with_adam(version: str, kind: str, order: str) -> None:
    ours = build(version, kind, order, PhaseScheduler(TOTAL, SWITCH, []))
    theirs = build(version, kind, order, None)
    ours.run(0, TOTAL)
    theirs.run(0, TOTAL)
    assert len(ours.splats["means"]) != POINTS
    for name in RATES:
        assert torch.equal(ours.splats[name], theirs.splats[name]), name


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("kind", ["mcmc", "default"])
@pytest.mark.parametrize("order", ORDERS)
def test_a_whole_run_with_the_switch_in_the_middle(version: str, kind: str, order: str) -> None:
    phases = phased()
    trainer = build(version, kind, order, phases)
    sizes, held = set(), False
    for step in range(TOTAL):
        trainer.run(step, step + 1)
        sizes.add(len(trainer.splats["means"]))
        for name, optimizer in trainer.optimizers.items():
            # 1 and 3: float32, rows first, whatever was edited; 8: learning rates are the host's
            state = optimizer.state[trainer.splats[name]]
            for key in set(state) - {"step"}:
                assert state[key].shape[0] == len(trainer.splats["means"]), (name, key)
                assert state[key].dtype == torch.float32
            decay = 0.01 ** ((step + 1) / TOTAL) if name == "means" else 1.0
            assert optimizer.param_groups[0]["lr"] == pytest.approx(RATES[name] * decay)
        held = "Curvature.history" in trainer.optimizers["means"].state[trainer.splats["means"]]
        # In the other order a refinement takes the gradients away: a no-op of the optimizer (10).
        assert held == (step >= SWITCH)
    assert len(sizes) > 3
    assert all(bool(torch.isfinite(p).all()) for p in trainer.splats.values())
    assert held
    histogram = phases.part(EnergyHistogram)
    assert histogram is not None
    assert histogram.num_observed == SWITCH


@pytest.mark.parametrize("kind", ["mcmc", "default"])
@pytest.mark.parametrize("at", some_of([SWITCH - 9, SWITCH, SWITCH + 9, 55], SWITCH.__eq__))
def test_checkpoint_and_resume_are_bit_exact(kind: str, at: int) -> None:
    whole = build("1.5.3", kind, ORDERS[0], phased())
    whole.run(0, TOTAL)
    first = build("1.5.3", kind, ORDERS[0], phased())
    first.run(0, at)
    buffer = io.BytesIO()
    saved = {
        "splats": {k: v.detach() for k, v in first.splats.items()},
        "optimizers": {k: o.state_dict() for k, o in first.optimizers.items()},
        "decay": first.decay.state_dict(),
        "strategy": first.state,
    }
    torch.save(saved, buffer)
    buffer.seek(0)
    loaded = torch.load(buffer, weights_only=True)
    phases = phased()
    splats = ParameterDict({k: Parameter(v) for k, v in loaded["splats"].items()})
    optimizers = phases.upgrade(gsplat_optimizers(dict(splats)))
    for name, optimizer in optimizers.items():
        optimizer.load_state_dict(loaded["optimizers"][name])
    second = Trainer(
        splats,  # type: ignore[arg-type]
        optimizers,
        make_strategy(strategies("1.5.3"), kind),
        total=TOTAL,
        phases=phases,
    )
    second.decay.load_state_dict(loaded["decay"])
    second.optimizers["means"].param_groups[0]["lr"] = second.decay.get_last_lr()[0]
    second.state = loaded["strategy"]
    second.run(at, TOTAL)
    for name in RATES:
        assert torch.equal(whole.splats[name], second.splats[name]), name


@pytest.mark.parametrize("version", VERSIONS)
def test_opacity_reset_zeroes_the_moments_and_keeps_the_pairs(version: str) -> None:
    """Opacity alone is exchanged; 1.5.3's own call never comes (`a == 0 & b > 0` is False)."""
    package = strategies(version)
    trainer = build(version, "default", ORDERS[0], phased())
    trainer.run(0, 53)
    held = trainer.optimizers["means"].state[trainer.splats["means"]]["Curvature.history"].clone()
    package.ops.reset_opa(trainer.splats, trainer.optimizers, trainer.state, value=0.1)
    assert bool((torch.sigmoid(trainer.splats["opacities"]) <= 0.1 + 1e-6).all())
    assert not bool(
        trainer.optimizers["opacities"].state[trainer.splats["opacities"]]["exp_avg"].any()
    )
    trainer.run(53, 54)
    now = trainer.optimizers["means"].state[trainer.splats["means"]]["Curvature.history"]
    assert now.shape == held.shape
    assert int((now != 0).sum()) >= int((held != 0).sum())


@pytest.mark.parametrize("version", VERSIONS)
def test_relocation_drops_the_pairs(version: str) -> None:
    """2: shape and storage stay and dead rows keep their state: the object tells."""
    trainer = build(version, "mcmc", ORDERS[0], phased())
    trainer.strategy.cap_max = POINTS
    trainer.run(0, 43)
    before = trainer.optimizers["means"].state[trainer.splats["means"]]["Curvature.history"].clone()
    assert bool(before.any())
    trainer.splats["opacities"].data[:5] = -9.0
    trainer.strategy._relocate_gs(trainer.splats, trainer.optimizers, trainer.state["binoms"])
    stale = trainer.optimizers["means"].state[trainer.splats["means"]]["Curvature.history"]
    assert bool(stale[:5].any())  # gsplat leaves it
    trainer.strategy.refine_every = 1000
    trainer.run(43, 44)
    after = trainer.optimizers["means"].state[trainer.splats["means"]]["Curvature.history"]
    # one visible step: the header of rows that were seen, and no pair in any row
    assert int((after != 0).sum()) < int((before != 0).sum()) / 2


def test_growth_before_the_first_step() -> None:
    """Optimizers without any state are edited too."""
    trainer = build("1.5.3", "mcmc", ORDERS[0], phased())
    trainer.strategy._relocate_gs(trainer.splats, trainer.optimizers, trainer.state["binoms"])
    trainer.strategy._add_new_gs(trainer.splats, trainer.optimizers, trainer.state["binoms"])
    trainer.run(0, 10)
    assert len(trainer.splats["means"]) > POINTS


@pytest.mark.parametrize("kind", ["mcmc", "default"])
def test_scene_of_main(kind: str) -> None:
    """gsplat 1.6 with its real GaussianScene and ops, through the switch."""
    phases = phased()
    strategy = make_strategy(strategies("main"), kind)
    scene = scene_of_main(start())
    optimizers = phases.upgrade(gsplat_optimizers(dict(scene.splats)), scene=scene)
    trainer = Trainer(scene.splats, optimizers, strategy, total=TOTAL, phases=phases, scene=scene)
    trainer.run(0, 43)
    scene.validate()
    trainer.splats["opacities"].data[:2] = -9.0
    trainer.run(43, TOTAL)
    assert all(bool(torch.isfinite(p).all()) for p in trainer.splats.values())
