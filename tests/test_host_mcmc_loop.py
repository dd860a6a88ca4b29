"""A real MCMC training, gsplat's strategy and a real rasterizer: the swap loses nothing."""

from __future__ import annotations

import statistics
import time

import pytest
from gsplat_host import strategies
from hosts.gsplat_mcmc_cpu import ARMS, gsplat_on_a_cpu, train

SEEDS = 3
# The seeds' own losses differ by 0.002 (standard deviation); another machine's rounding, which a
# training amplifies, is another seed.
NOISE = 0.002

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")


@pytest.mark.slow
def test_opt3dgs_finishes_at_or_below_the_stock_loss() -> None:
    strategies("1.5.3")  # skips without gsplat
    package, results, began = gsplat_on_a_cpu(), {}, time.perf_counter()
    for arm, make in ARMS.items():
        results[arm] = [train(package, seed, make) for seed in range(SEEDS)]
    seconds = (time.perf_counter() - began) / (SEEDS * len(ARMS))
    loss = {arm: statistics.mean(r.loss for r in rs) for arm, rs in results.items()}
    print(f"mean loss of {SEEDS} seeds: {loss}, {seconds:.1f} s a run")
    assert loss["opt3dgs"] <= loss["adam"] + NOISE
    assert all(r.points == 1_300 for rs in results.values() for r in rs)
    assert all(r.train_psnr > 17 for rs in results.values() for r in rs)
