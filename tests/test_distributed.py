"""Several ranks share one nu: gloo, two processes on a CPU."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.multiprocessing as mp
from gaussians import adams_of, parameters, steps
from ranks import free_port
from torch import distributed

from opt3dgs_optim import EnergyHistogram, PhaseScheduler

WORLD, TOTAL, BAD = 2, 40, 25


def rank_main(rank: int, port: int, folder: str) -> None:
    """A shard of its own size and loss on each rank; rank 1 has a NaN at iteration BAD."""
    torch.set_num_threads(1)
    address = f"tcp://127.0.0.1:{port}"
    distributed.init_process_group("gloo", init_method=address, rank=rank, world_size=WORLD)
    histogram = EnergyHistogram(warmup=8)
    phases = PhaseScheduler(TOTAL, parts=[histogram], process_group=distributed.group.WORLD)
    params = parameters(9 + 5 * rank)
    optimizers = phases.upgrade(adams_of(params))
    generator = torch.Generator().manual_seed(rank)
    nus = []
    for iteration in range(TOTAL):
        loss = torch.rand((), generator=generator)
        bad = iteration == BAD and rank == 1
        phases.observe(loss * torch.nan if bad else loss)
        steps(optimizers, params, 1)
        nus.append(float(histogram.multiplier))
    torch.save({"nus": nus, "theta": histogram.weights}, f"{folder}/{rank}.pt")
    distributed.barrier()
    distributed.destroy_process_group()


@pytest.mark.processes
def test_two_ranks_have_one_nu_and_one_theta(tmp_path: Path) -> None:
    mp.spawn(rank_main, args=(free_port(), str(tmp_path)), nprocs=WORLD)  # pyright: ignore
    a, b = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(WORLD))
    assert a["nus"] == b["nus"]
    assert len(set(a["nus"])) > 3
    assert torch.equal(a["theta"], b["theta"])
    assert a["nus"][BAD] == a["nus"][BAD - 1]
