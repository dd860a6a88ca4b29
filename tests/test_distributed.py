"""Several ranks share one nu: gloo, two processes on a CPU; and means over ranks."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.multiprocessing as mp
from ranks import free_port
from torch import distributed
from trainers import everything, gsplat_optimizers, make_splats, step_all, view_loss

from opt3dgs_optim import EnergyHistogram
from opt3dgs_optim.phases import RankMean

WORLD, TOTAL, BAD = 2, 40, 25


def rank_main(rank: int, port: int, folder: str) -> None:
    """A shard of its own size and loss on each rank; rank 1 has a NaN at iteration BAD."""
    torch.set_num_threads(1)
    address = f"tcp://127.0.0.1:{port}"
    distributed.init_process_group("gloo", init_method=address, rank=rank, world_size=WORLD)
    histogram = EnergyHistogram(warmup=8)
    phases = everything(TOTAL, 30, nu=histogram, process_group=distributed.group.WORLD)
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
        step_all(optimizers)
        stood_still.append(torch.equal(before, splats["means"]))
    torch.save(
        {"nus": nus, "theta": histogram.weights, "still": stood_still}, f"{folder}/{rank}.pt"
    )
    distributed.barrier()
    distributed.destroy_process_group()


@pytest.mark.processes
def test_two_ranks_have_one_nu_and_one_theta(tmp_path: Path) -> None:
    mp.spawn(rank_main, args=(free_port(), str(tmp_path)), nprocs=WORLD)  # pyright: ignore
    a, b = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(WORLD))
    assert a["nus"] == b["nus"]
    assert len(set(a["nus"])) > 3
    assert torch.equal(a["theta"], b["theta"])
    assert a["still"] == b["still"] == [iteration == BAD for iteration in range(TOTAL)]


def test_a_process_that_is_not_in_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    from torch import distributed

    monkeypatch.setattr(distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(distributed, "get_rank", lambda group: -1)
    with pytest.raises(ValueError, match="call: this process does not belong to 'others'"):
        RankMean("call", "others")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_half_precision_energies_are_summed_in_float32(
    dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two ranks of 40,000: their sum is beyond float16."""
    from torch import distributed

    monkeypatch.setattr(distributed, "is_initialized", lambda: True)
    monkeypatch.setattr(distributed, "get_rank", lambda group: 0)
    monkeypatch.setattr(distributed, "get_world_size", lambda group: 2)
    monkeypatch.setattr(distributed, "all_reduce", lambda total, group: total.mul_(2))
    energy = torch.tensor(40_000.0, dtype=dtype)
    mean = RankMean("call", "all")(energy)
    assert mean.shape == ()
    assert float(mean) == float(energy)
    assert mean.dtype == (dtype if dtype.itemsize > 2 else torch.float32)
