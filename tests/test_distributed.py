"""Several ranks share one nu: gloo, two processes on a CPU. GradScaler, accumulation, compile."""

from __future__ import annotations

import contextlib
import socket
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.multiprocessing as mp
from torch import distributed
from torch.nn import Parameter
from trainers import (
    everything,
    gsplat_optimizers,
    make_splats,
    train,
    view_loss,
)

from opt3dgs_optim import AWSGLD, EnergyHistogram, PhaseScheduler

WORLD, TOTAL, BAD = 2, 40, 25


def free_port() -> int:
    with contextlib.closing(socket.socket()) as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def rank_main(rank: int, port: int, folder: str) -> None:
    """A shard of its own size and loss on each rank; rank 1 has a NaN at iteration BAD."""
    torch.set_num_threads(1)
    address = f"tcp://127.0.0.1:{port}"
    distributed.init_process_group("gloo", init_method=address, rank=rank, world_size=WORLD)
    histogram = EnergyHistogram(warmup=8, step_size=0.1)
    phases = everything(TOTAL, 30, multiplier=histogram, process_group=distributed.group.WORLD)
    splats = make_splats(9 + 5 * rank, seed=rank)  # uneven shards
    optimizers = phases.upgrade(gsplat_optimizers(splats))
    nus, stood_still = [], []
    for iteration in range(TOTAL):
        loss = (1.0 + rank) * view_loss(splats, iteration % 5, phases)
        loss.backward()
        bad = iteration == BAD and rank == 1
        phases.observe(loss * float("nan") if bad else loss)
        nus.append(float(histogram.multiplier))
        before = splats["means"].detach().clone()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        stood_still.append(torch.equal(before, splats["means"]))
    alone = EnergyHistogram(warmup=4, process_group=distributed.group.WORLD)
    nu = [float(alone.observe(float(rank + step))) for step in range(9)]
    result = {"nus": nus, "theta": histogram.weights, "still": stood_still, "alone": nu}
    torch.save({**result, "range": histogram.calibrated_range}, f"{folder}/{rank}.pt")
    distributed.barrier()
    distributed.destroy_process_group()


def test_two_ranks_have_one_nu_and_one_theta(tmp_path: Path) -> None:
    mp.spawn(rank_main, args=(free_port(), str(tmp_path)), nprocs=WORLD)  # pyright: ignore
    a, b = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(WORLD))
    assert a["nus"] == b["nus"]
    assert len(set(a["nus"])) > 3
    assert torch.equal(a["theta"], b["theta"])
    assert a["range"] == b["range"]
    assert a["still"] == b["still"] == [iteration == BAD for iteration in range(TOTAL)]
    assert a["alone"] == b["alone"]


def test_a_group_without_torch_distributed() -> None:
    for make in (PhaseScheduler, EnergyHistogram):
        with pytest.raises(ValueError, match=r"init_process_group first") as error:
            make(10, process_group="world")  # type: ignore[arg-type]
        assert make.__name__ in str(error.value)


# -- GradScaler -------------------------------------------------------------------------------


def scaled(fused: bool | None) -> tuple[Any, dict, Any, PhaseScheduler, EnergyHistogram]:
    splats = make_splats()
    histogram = EnergyHistogram(warmup=4)
    phases = everything(100, 50, multiplier=histogram)
    optimizers = phases.upgrade(gsplat_optimizers(splats, fused=fused))
    # like nerfstudio's Trainer; a first scale at which nothing overflows
    scaler = torch.amp.GradScaler("cpu", init_scale=8.0)  # pyright: ignore
    return scaler, splats, optimizers, phases, histogram


def scaled_step(scaler: Any, splats: dict, optimizers: Any, phases: Any, factor: float = 1) -> None:
    for p in splats.values():
        p.grad = None
    loss = view_loss(splats, 0, phases) * factor
    scaler.scale(loss).backward()
    phases.observe(loss)
    for optimizer in optimizers.values():
        scaler.step(optimizer)
    scaler.update()


@pytest.mark.parametrize("fused", [None, True])
@pytest.mark.parametrize("exploiting", [False, True])
def test_grad_scaler_skips_non_finite_steps(fused: bool | None, exploiting: bool) -> None:
    scaler, splats, optimizers, phases, histogram = scaled(fused)
    steps = 55 if exploiting else 9
    for _ in range(steps):
        scaled_step(scaler, splats, optimizers, phases)
    before = {name: p.detach().clone() for name, p in splats.items()}
    theta, seen = histogram.weights, histogram.num_observed
    scaled_step(scaler, splats, optimizers, phases, factor=float("inf"))
    assert all(torch.equal(before[name], p) for name, p in splats.items())
    assert torch.equal(histogram.weights, theta)
    assert histogram.num_observed == seen + (not exploiting)
    scaled_step(scaler, splats, optimizers, phases)
    assert not torch.equal(before["means"], splats["means"])


@pytest.mark.parametrize("fused", [None, True])
def test_a_gradient_that_overflows_at_a_finite_loss_is_skipped(fused: bool | None) -> None:
    scaler, splats, optimizers, phases, _ = scaled(fused)
    scaled_step(scaler, splats, optimizers, phases)
    before = {name: p.detach().clone() for name, p in splats.items()}
    scaler.update(new_scale=3e38)  # the loss is finite, its scaled gradient is not
    scaled_step(scaler, splats, optimizers, phases, factor=1e3)
    assert all(torch.equal(before[name], p) for name, p in splats.items())


@pytest.mark.parametrize("fused", [None, True])
def test_grad_scaler_gives_the_unscaled_steps(fused: bool | None) -> None:
    """A power of two as scale changes no bit, in both phases."""
    scaler, splats, optimizers, phases, _ = scaled(fused)
    plain = make_splats()
    other = everything(100, 50, multiplier=EnergyHistogram(warmup=4))
    own = other.upgrade(gsplat_optimizers(plain, fused=fused))
    for _ in range(60):
        scaled_step(scaler, splats, optimizers, phases)
        loss = view_loss(plain, 0, other)
        loss.backward()
        other.observe(loss)
        for optimizer in own.values():
            optimizer.step()
            optimizer.zero_grad()
    for name, p in splats.items():
        torch.testing.assert_close(p, plain[name], rtol=1e-6, atol=1e-7)


# -- gradient accumulation, torch.compile -----------------------------------------------------


def test_gradient_accumulation_observes_the_mean_once() -> None:
    """Four views per step: the means of losses and gradients, as of one batch."""
    results = []
    for together in (True, False):
        splats, histogram = make_splats(), EnergyHistogram(warmup=4)
        phases = everything(20, 12, multiplier=histogram)
        optimizers = phases.upgrade(gsplat_optimizers(splats))
        for _ in range(20):
            if together:
                energy = torch.stack([view_loss(splats, v, phases) for v in range(4)]).mean()
                energy.backward()
                energy = energy.detach()
            else:
                energy = torch.zeros(())
                for view in range(4):
                    loss = view_loss(splats, view, phases) / 4
                    loss.backward()
                    energy = energy + loss.detach()
            phases.observe(energy)
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
        assert phases.iteration == 20
        results.append((splats, float(histogram.multiplier)))
    (a, nu_a), (b, nu_b) = results
    # Sums in another order. A gradient of nearly 0 has any sign in Adam with eps 1e-15.
    assert nu_a == pytest.approx(nu_b, rel=2e-2)
    assert float((a["means"] - b["means"]).detach().abs().median()) < 1e-4


def test_compiled_step() -> None:
    """torch.compile of step() runs it as it is, and computes the same."""
    x, y = (Parameter(torch.linspace(-1, 1, 12).reshape(4, 3)) for _ in "ab")
    a, b = (
        AWSGLD([p], lr=0.05, histogram=EnergyHistogram(num_partitions=20, warmup=4)) for p in (x, y)
    )
    compiled = torch.compile(a.step, backend="eager")
    for _ in range(12):
        for p, optimizer, step in ((x, a, compiled), (y, b, b.step)):
            p.grad = p.detach().clone()
            assert optimizer.histogram is not None
            optimizer.histogram.observe((p.detach() ** 2).sum())
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                step()
    torch.testing.assert_close(x, y)


def test_compiled_step_in_both_phases() -> None:
    results = []
    for compiled in (False, True):
        splats = make_splats()
        phases = everything(12, 6, multiplier=EnergyHistogram(num_partitions=20, warmup=4))
        optimizers: Any = phases.upgrade(gsplat_optimizers(splats))
        if compiled:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                step = torch.compile(optimizers["means"].step, backend="eager")
                optimizers["means"].step = step
                train(splats, optimizers, phases, 0, 12)
        else:
            train(splats, optimizers, phases, 0, 12)
        results.append(splats["means"].detach())
    torch.testing.assert_close(*results)
